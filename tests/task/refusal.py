"""Loads a task that must be refused, and returns its problem."""

from __future__ import annotations

from pathlib import Path

import pytest

from workbench.task.load import load_task
from workbench.task.problem import Problem, TaskError


def refused(reference: str | Path, **kwargs: dict[str, str]) -> Problem:
    with pytest.raises(TaskError) as caught:
        load_task(str(reference), **kwargs)
    return caught.value.problem

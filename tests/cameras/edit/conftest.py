"""Tests here load task files: the process is restored after each."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def restored_process(clean_process: None) -> None:
    """See `tests.drive.task_files`."""

"""Restore the process after each test: tests here load task files."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def restored_process(clean_process: None) -> None:
    """See `tests.drive.task_files`."""

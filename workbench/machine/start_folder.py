"""The folder that the process was started in, which stays the meaning of relative paths when a task calls ``os.chdir``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

_AT_FOLDER = os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC
_start = os.open(".", _AT_FOLDER)
"""By descriptor: a folder that is renamed meanwhile is the same."""


@contextmanager
def in_start_folder(*, stay: bool = False) -> Iterator[None]:
    """Be in the start folder during the block, and afterwards in the folder before.

    Args:
        stay: a folder that the block itself changes to stays the current one, unless it raises.
    """
    before = os.open(".", _AT_FOLDER)
    leave = True
    try:
        os.fchdir(_start)
        yield
        leave = not stay
    finally:
        if leave:
            os.fchdir(before)
        os.close(before)

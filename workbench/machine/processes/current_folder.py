"""Returns to a folder after a task has called ``os.chdir``."""

from __future__ import annotations

import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager

_AT_FOLDER = os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC


class CurrentFolder:
    """The folder that is current when this is made; by descriptor, so one that is renamed meanwhile is the same."""

    def __init__(self) -> None:
        self._fd = os.open(".", _AT_FOLDER)
        weakref.finalize(self, os.close, self._fd)

    @contextmanager
    def again(self, *, stay: bool = False) -> Iterator[None]:
        """Be there during the block, and afterwards in the folder before it.

        Args:
            stay: a folder that the block itself changes to stays the current one, unless it raises.
        """
        before = os.open(".", _AT_FOLDER)
        leave = True
        try:
            os.fchdir(self._fd)
            yield
            leave = not stay
        finally:
            if leave:
                os.fchdir(before)
            os.close(before)

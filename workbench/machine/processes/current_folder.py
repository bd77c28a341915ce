"""Returns to a folder after a task has called ``os.chdir``."""

from __future__ import annotations

import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager

_AT_FOLDER = os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC


class CurrentFolder:
    """The current folder at construction, by descriptor, so that it may be renamed."""

    def __init__(self) -> None:
        self._fd = os.open(".", _AT_FOLDER)
        weakref.finalize(self, os.close, self._fd)

    @contextmanager
    def again(self, *, stay: bool = False) -> Iterator[None]:
        """Within this it is the current folder; afterwards the previous one is.

        Args:
            stay: keep the folder in which the block ends, unless it raises.
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

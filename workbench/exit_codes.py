"""What the commands end with."""

from __future__ import annotations

from enum import IntEnum


class Exit(IntEnum):
    DONE = 0
    FAILED = 1
    """The author's code raised, or there is less than was asked for."""
    REFUSED = 2
    """Nothing was done, and it was said why: a wrong argument, a missing file."""
    NOT_TRUSTED = 4
    """Nothing was run, because recordings name code that nobody agreed to; ``--trust`` agrees."""

"""What went wrong in the author's file, in the words and at the line that the author needs.

A traceback of a broken task is mostly ManiSkill's own frames; the author wants the last line of
*their* code in it. `Problem` is that, as plain data that crosses the pipe from the worker.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Problem:
    stage: str
    """What was being done: ``syntax import build reset step evaluate reward observation returns
    policy worker``."""
    message: str
    """One line: exception type and text."""
    file: str | None
    """The author's file, or None when none of their lines is involved."""
    line: int | None
    """1-based line in `file`."""
    code: str | None
    """The text of that line, stripped."""
    traceback: str
    """The whole of it, as Python prints it; may be empty."""

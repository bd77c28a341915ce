"""Answers ``breakpoint()`` and ``pdb.set_trace()`` without a terminal."""

from __future__ import annotations

import os
import pdb
import sys
from typing import Any, NoReturn

OPEN_WITH_DEBUG = "remove this line, or open with --debug and attach a debugger"
ONE_PROCESS = "remove this line, or use --workers 1 in a terminal, where Python's own debugger answers"


class NoDebugger(RuntimeError):
    """The author's code calls a debugger where there is no terminal."""


def refuse_breakpoints(advice: str) -> None:
    """Make both raise `NoDebugger` at their own line, in this process.

    Python's debugger would read the end of its input and raise a bare ``BdbQuit`` at the next line. A ``PYTHONBREAKPOINT``
    that names another function, or 0, stays in effect.

    Args:
        advice: what to do instead, appended after a colon.
    """

    def refuse_breakpoint(*arguments: Any, **keywords: Any) -> NoReturn:
        raise NoDebugger(f"this line stops for a debugger, and there is no terminal to ask in: {advice}")

    if os.environ.get("PYTHONBREAKPOINT", "") in ("", "pdb.set_trace"):
        sys.breakpointhook = refuse_breakpoint
    pdb.set_trace = refuse_breakpoint


def pass_breakpoints() -> None:
    """Make both do nothing in this process, which runs in the background."""

    def pass_breakpoint(*arguments: Any, **keywords: Any) -> None:
        pass

    sys.breakpointhook = pdb.set_trace = pass_breakpoint

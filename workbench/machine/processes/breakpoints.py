"""Answers ``breakpoint()`` and ``pdb.set_trace()`` without a terminal."""

from __future__ import annotations

import os
import pdb
import sys
from typing import Any, NoReturn

OPEN_WITH_DEBUG = "remove this line, or open with --debug and attach a debugger"
ONE_PROCESS = "remove this line, or use --workers 1 in a terminal, where Python's own debugger answers"


class NoDebugger(RuntimeError):
    """The author's code stops for a debugger that cannot be there."""


def refuse_breakpoints(advice: str) -> None:
    """From now on both raise `NoDebugger` at their own line, in this process.

    Python's debugger would read the end of its input and raise ``BdbQuit`` at the line after, which says nothing. Where
    ``PYTHONBREAKPOINT`` names something else, or 0, ``breakpoint()`` does that.

    Args:
        advice: what to do instead, to go behind a colon.
    """

    def refuse_breakpoint(*arguments: Any, **keywords: Any) -> NoReturn:
        raise NoDebugger(f"this line stops for a debugger, and there is no terminal to ask in: {advice}")

    if os.environ.get("PYTHONBREAKPOINT", "") in ("", "pdb.set_trace"):
        sys.breakpointhook = refuse_breakpoint
    pdb.set_trace = refuse_breakpoint


def pass_breakpoints() -> None:
    """From now on both do nothing, in this process: nobody debugs what is done in the background."""

    def pass_breakpoint(*arguments: Any, **keywords: Any) -> None:
        pass

    sys.breakpointhook = pdb.set_trace = pass_breakpoint

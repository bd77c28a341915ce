"""A rule of GPU simulation that a task broke, told at the line that broke it.

What goes wrong shows later than it is done: at the fetch, after the write. So whoever notes a write keeps the
frames that led to it, and the error carries those as the innermost of its traceback.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence
from types import FrameType, TracebackType

_GENERAL_CODE = ("workbench.", "mani_skill.utils.", "mani_skill.envs.s")
"""``mani_skill.envs.sapien_env`` and ``.scene``: they write what they are told to."""
_FRAMES_KEPT = 12
_BASE_ENV, _OUTERMOST = "mani_skill.envs.sapien_env", ("step", "reset")
"""Where the frames end that are told with an error: above are those that the traceback has anyway."""

Frame = tuple[FrameType, int, int]
"""A frame with its last instruction and its line at the time."""


class BrokenRule(RuntimeError):
    """The task did what goes wrong, or is lost, in GPU simulation."""


class RuleWarning(UserWarning):
    """What would be a `BrokenRule`, in a task that is only to be reported on."""


def broken_at(message: str, frames: Sequence[Frame]) -> BrokenRule:
    """The error, with `frames` (innermost first) as the innermost of its traceback."""
    trace = None
    for frame, instruction, line in frames:
        trace = TracebackType(trace, frame, instruction, line)
    return BrokenRule(message).with_traceback(trace)


def frames_of_the_task(innermost: FrameType | None = None) -> tuple[Frame, ...]:
    """The frames that led here, innermost first, from the first that is not the core's own."""
    frame = sys._getframe(1) if innermost is None else innermost
    kept: list[Frame] = []
    while frame is not None and len(kept) < _FRAMES_KEPT:
        if not frame.f_globals.get("__name__", "").startswith("workbench.core."):
            kept.append((frame, frame.f_lasti, frame.f_lineno))
        if frame.f_code.co_name in _OUTERMOST and frame.f_globals.get("__name__") == _BASE_ENV:
            break
        frame = frame.f_back
    return tuple(kept)


def place_of_hook(task: type, hook: str) -> str:
    """The file and line of a hook's definition, in brackets; or nothing."""
    code = getattr(inspect.unwrap(getattr(task, hook)), "__code__", None)
    return "" if code is None else f" ({code.co_filename}:{code.co_firstlineno})"


def place_of(frames: Sequence[Frame]) -> str:
    """The file and line of the first frame that is not in ManiSkill's general code, in brackets; or nothing."""
    for frame, _, line in frames:
        if not frame.f_globals.get("__name__", "").startswith(_GENERAL_CODE):
            return f" ({frame.f_code.co_filename}:{line})"
    return ""

"""What went wrong in the author's file, in the words and at the line that the author needs.

A traceback of a broken task is mostly ManiSkill's own frames; the author wants the last line of
*their* code in it. `Problem` is that, as plain data that crosses the pipe from the worker, and
`problem_from_exception` finds it: it walks the exception, then what caused it, for the innermost
frame in the author's files; it names the hook of the task that was running, because "in the
reward" is how the author thinks of it and "in step" is not; and it keeps the whole traceback, but
bounded, because a `RecursionError` or an exception that prints a tensor can be megabytes.
"""

from __future__ import annotations

import inspect
import linecache
import re
import traceback as tracebacks
from bdb import BdbQuit
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

HOOK_STAGES: dict[str, str] = {
    "_load_agent": "build",
    "_load_scene": "build",
    "_load_lighting": "build",
    "_after_reconfigure": "build",
    "_setup_scene": "build",
    "_setup_sensors": "build",
    "_default_sim_config": "build",
    "_default_sensor_configs": "build",
    "_default_human_render_camera_configs": "build",
    "_default_viewer_camera_configs": "build",
    "_initialize_episode": "reset",
    "evaluate": "evaluate",
    "get_info": "evaluate",
    "_get_obs_extra": "observation",
    "_get_obs_agent": "observation",
    "_get_obs_state_dict": "observation",
    "_get_obs_with_sensor_data": "observation",
    "_flatten_raw_obs": "observation",
    "compute_dense_reward": "reward",
    "compute_normalized_dense_reward": "reward",
    "compute_sparse_reward": "reward",
    "get_reward": "reward",
    "_before_control_step": "step",
    "_after_control_step": "step",
    "_before_simulation_step": "step",
    "_after_simulation_step": "step",
}
"""Method of `BaseEnv` to the stage that an author knows it as. `get_info`, `get_reward` and
`_flatten_raw_obs` are ManiSkill's callers of the author's hooks: what they choke on is what a hook
returned (``evaluate()`` giving None raises in `get_info`)."""
_CALLERS = ("get_info", "get_reward", "_flatten_raw_obs")


def hooks_of(stage: str) -> tuple[str, ...]:
    """The author's hooks of a stage."""
    return tuple(name for name, of in HOOK_STAGES.items() if of == stage and name not in _CALLERS)


MESSAGE_LIMIT = 500
TRACEBACK_LINE_LIMIT = 1000
TRACEBACK_HEAD_LINES = 60
TRACEBACK_TAIL_LINES = 140

_LOCATION_IN_TEXT = re.compile(r" \([^()]*, line \d+\)$")
_MACHINERY = ("workbench", "importlib", "_frozen_importlib", "_frozen_importlib_external")
"""Packages whose frames, at the start of a traceback, only say who ran the author's code."""


class Interrupted(BaseException):
    """Somebody had enough of waiting. Not an Exception: ``except Exception`` in a loop must not swallow it."""


_person: tuple[type[BaseException], ...] = (KeyboardInterrupt,)


def nobody_presses_ctrl_c() -> None:
    """Of a process that has no terminal: a KeyboardInterrupt in it is the author's, and a failure like others."""
    global _person
    _person = ()


def is_ctrl_c(error: BaseException | None) -> bool:
    """Whether it is a person at the terminal who leaves; to be raised on, and never blamed on a task."""
    return isinstance(error, _person)


@dataclass(frozen=True)
class Problem:
    stage: str
    """What was being done: ``syntax import build reset step evaluate reward observation returns
    policy pictures worker``."""
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
    interrupted: bool = False
    """A person stopped it by hand."""


class TaskError(Exception):
    """The author's task cannot be had; `problem` says why in the author's terms.

    Args:
        classes: What can be chosen in the task's file, this one first; empty where it has nothing else.
    """

    def __init__(self, problem: Problem, classes: tuple[str, ...] = ()) -> None:
        super().__init__(problem)
        self.problem, self.classes = problem, classes

    def __str__(self) -> str:
        place = "" if self.problem.file is None else f"{self.problem.file}:{self.problem.line or 1}: "
        return place + self.problem.message


def refused(message: str, file: Path | None = None) -> TaskError:
    """A task that cannot be had for a reason that no line of its author's raised."""
    return TaskError(Problem("import", shorten(message), None if file is None else str(file), None, None, ""))


def problem_from_exception(
    exc: BaseException, stage: str, own_files: Collection[Path], cls: type | None = None
) -> Problem:
    """Say what `exc` means to the author of `own_files`.

    The place is the innermost frame in `own_files`, looked for in `exc` itself, then in what it was
    raised from. A hook of `HOOK_STAGES` on the traceback replaces `stage`, except while importing.
    Where the traceback has no frame of the author's but a hook is known, and `cls` (the task's
    class) is given, the place is that hook's ``def``.
    """
    own = {str(path) for path in own_files}
    if isinstance(exc, SyntaxError) and exc.filename in own and exc.lineno is not None:
        return _syntax_problem(exc)

    stage_found = stage if stage in ("import", "syntax", "policy", "worker") else _stage_of(exc, stage)
    message = _message(exc)
    for link in _chain(exc):
        if isinstance(link, SyntaxError) and link.filename in own and link.lineno is not None:
            place: tuple[str, int] | None = (str(link.filename), link.lineno)
        else:
            place = _innermost(link, own)
        if place is not None:
            if link is not exc:
                message = shorten(f"{message} (from {_message(link)})")
            break
    else:
        hooks = () if stage_found in ("build", "step") else hooks_of(stage_found)
        found = None if cls is None else hook_definition(cls, hooks, own_files)
        place = None if found is None else found[1]
    file, line = place if place is not None else (None, None)
    code = None
    if file is not None and line is not None:
        linecache.checkcache(file)  # of a module that was mended since a line of it was last shown
        code = linecache.getline(file, line).strip()
    if isinstance(exc, AssertionError) and not str(exc) and code:
        message = shorten(f"{message}: {code}")
    stopped = isinstance(exc, Interrupted)
    return Problem(stage_found, message, file, line, code or None, format_traceback(exc), stopped)


def shorten(text: str, limit: int = MESSAGE_LIMIT) -> str:
    """`text` on one line, with its end cut off where it is longer than `limit`."""
    line = " ".join(text[: 8 * limit].split())
    return line if len(line) <= limit else line[: limit - 1] + "…"


def format_traceback(exc: BaseException) -> str:
    """The traceback of `exc`, less the workbench's own frames at its start, bounded in size.

    Python already folds one function that calls itself; two that call each other (a property and
    its helper, say) still give two thousand lines, so the middle of a long traceback is left out.
    """
    trace = exc.__traceback__
    while trace is not None and trace.tb_next is not None and _is_machinery(trace.tb_frame):
        trace = trace.tb_next
    try:
        lines = "".join(tracebacks.format_exception(type(exc), exc, trace)).splitlines()
    except RecursionError:
        # The stack may still be nearly full where a RecursionError is caught deep down.
        lines = ["Traceback too deep to print", _message(exc)]
    if len(lines) > TRACEBACK_HEAD_LINES + TRACEBACK_TAIL_LINES:
        left_out = len(lines) - TRACEBACK_HEAD_LINES - TRACEBACK_TAIL_LINES
        lines[TRACEBACK_HEAD_LINES:-TRACEBACK_TAIL_LINES] = [f"  ... {left_out} lines left out ..."]
    return "\n".join(
        line if len(line) <= TRACEBACK_LINE_LIMIT else line[: TRACEBACK_LINE_LIMIT - 1] + "…"
        for line in lines
    )


def definition_line(function: object) -> tuple[str, int] | None:
    """File and 1-based line of the ``def`` of a function, method or property; None for others.

    A code object's first line is that of its first decorator, which is not where one looks.
    """
    if isinstance(function, property):
        function = function.fget
    function = getattr(function, "__func__", function)
    function = inspect.unwrap(function) if callable(function) else function
    code = getattr(function, "__code__", None)
    if code is None:
        return None
    for line in range(code.co_firstlineno, code.co_firstlineno + 20):
        if linecache.getline(code.co_filename, line).lstrip().startswith(("def ", "async def ", "lambda")):
            return code.co_filename, line
    return code.co_filename, code.co_firstlineno


def hook_definition(
    cls: type, hooks: Iterable[str], own_files: Collection[Path]
) -> tuple[str, tuple[str, int]] | None:
    """The first of these methods of `cls` that the author's files define, and where; None when they inherit all."""
    own = {str(path) for path in own_files}
    for name in hooks:
        method = next((vars(base)[name] for base in cls.__mro__ if name in vars(base)), None)
        place = definition_line(method)
        if place is not None and place[0] in own:
            return name, place
    return None


def _syntax_problem(exc: SyntaxError) -> Problem:
    assert exc.filename is not None
    text = exc.text or linecache.getline(exc.filename, exc.lineno or 1)
    # Python's own text for a SyntaxError ends in "(file.py, line 3)", which the place says already.
    message = _LOCATION_IN_TEXT.sub("", _message(exc))
    # Only the exception itself: the frames are those of whoever called the compiler.
    lines = "".join(tracebacks.format_exception_only(type(exc), exc)).rstrip("\n")
    return Problem("syntax", message, exc.filename, exc.lineno, shorten(text) or None, lines)


def _message(exc: BaseException) -> str:
    name = type(exc).__qualname__
    try:
        text = str(exc)
    except Exception as failure:  # an author's own __str__ may be what is broken
        text = f"<its __str__ raised {type(failure).__qualname__}>"
    if isinstance(exc, BdbQuit) and not text:
        text = "a debugger's prompt was left, or had no terminal to ask in; it was called just before this line: remove the call"
    return shorten(f"{name}: {text}" if text.strip() else name)


def _chain(exc: BaseException) -> Iterator[BaseException]:
    seen: set[int] = set()
    link: BaseException | None = exc
    while link is not None and id(link) not in seen:
        seen.add(id(link))
        yield link
        if link.__cause__ is not None:
            link = link.__cause__
        else:
            link = None if link.__suppress_context__ else link.__context__


def _innermost(exc: BaseException, own: Collection[str]) -> tuple[str, int] | None:
    places = [(frame.f_code.co_filename, line) for frame, line in tracebacks.walk_tb(exc.__traceback__)]
    return next((place for place in reversed(places) if place[0] in own), None)


def _stage_of(exc: BaseException, stage: str) -> str:
    for link in _chain(exc):
        names = [frame.f_code.co_name for frame, _ in tracebacks.walk_tb(link.__traceback__)]
        hooks = [name for name in names if name in HOOK_STAGES]
        if hooks:
            return HOOK_STAGES[hooks[-1]]
    return stage


def _is_machinery(frame: FrameType) -> bool:
    return str(frame.f_globals.get("__name__", "")).partition(".")[0] in _MACHINERY

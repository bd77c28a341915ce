"""Finds the author's line, hook and message of an exception, as plain data (`Problem`)."""

from __future__ import annotations

import difflib
import inspect
import linecache
import traceback as tracebacks
from bdb import BdbQuit
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TypeGuard

from workbench.envs.error_notes import CoreRefusal, ErrorNote, chain_of, notes_of
from workbench.machine.library_files import is_installed
from workbench.machine.parse_python import line_of_return

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
"""Maps a method of `BaseEnv` to the stage that the page names. `get_info`, `get_reward` and
`_flatten_raw_obs` are ManiSkill's callers of the author's hooks; they raise because of what a hook returned
(for example, `get_info` raises if ``evaluate()`` returned None)."""
_CALLERS = ("get_info", "get_reward", "_flatten_raw_obs")


def hooks_of(stage: str) -> tuple[str, ...]:
    """The author's hooks of a stage."""
    return tuple(name for name, of in HOOK_STAGES.items() if of == stage and name not in _CALLERS)


_REWARD_HOOKS = hooks_of("reward")

MAX_MESSAGE_CHARACTERS = 500
MAX_TRACEBACK_LINE_CHARACTERS = 1000
TRACEBACK_HEAD_LINES = 60
TRACEBACK_TAIL_LINES = 140

_MACHINERY = ("workbench", "importlib", "_frozen_importlib", "_frozen_importlib_external")
"""Packages whose frames are left out at the start of a traceback: they only run the author's code."""


class Interrupted(BaseException):
    """A person stopped the task. Not an Exception, so that ``except Exception`` in a loop does not swallow it."""


_ctrl_c: tuple[type[BaseException], ...] = (KeyboardInterrupt,)


def treat_ctrl_c_as_error() -> None:
    """Treat a KeyboardInterrupt as an error of the task: in a process without a terminal no person raises it."""
    global _ctrl_c
    _ctrl_c = ()


def is_ctrl_c(error: BaseException | None) -> bool:
    """Whether the exception comes from a person's Ctrl-C. The caller must reraise it, never report it as the task's error."""
    return isinstance(error, _ctrl_c)


@dataclass(frozen=True)
class Problem:
    """An error in the author's code. Crosses the pipe from the worker, so its texts are bounded: a RecursionError or an
    exception that prints a tensor can be megabytes."""

    stage: str
    """What failed: ``syntax import build reset step evaluate reward observation returns policy pictures worker``."""
    message: str
    """Exception type and text, on one line."""
    file: str | None
    """The author's file; None if no file of the author is known to be at fault."""
    line: int | None
    """1-based line in `file`; None if unknown."""
    code: str | None
    """The text of that line, stripped."""
    traceback: str
    """The traceback in Python's format, shortened; may be empty."""
    interrupted: bool = False
    """Whether a person stopped the code."""
    column: int | None = None
    """1-based column in `code` at which Python stops reading."""

    @property
    def what_failed(self) -> str:
        """What failed, as the beginning of a message in the terminal."""
        if self.stage == "syntax":
            return "not Python yet"
        return "not loaded" if self.has_no_place else f"{self.stage} failed"

    @property
    def has_no_place(self) -> bool:
        """Whether no line of the file failed: the file is empty, has no task, or does not exist."""
        return self.stage == "import" and self.line is None


class TaskError(Exception):
    """The author's code failed in a load, a step or a reset; `problem` has the reason.

    Args:
        classes: names of the classes of the file that can be opened, the failed one first; empty if there is
            no other.
    """

    def __init__(self, problem: Problem, classes: tuple[str, ...] = ()) -> None:
        super().__init__(problem)
        self.problem, self.classes = problem, classes

    def __str__(self) -> str:
        return place_text(self.problem.file, self.problem.line) + self.problem.message


def place_text(file: str | None, line: int | None) -> str:
    """Place at the beginning of a message, ``push.py:88: ``; without the line if it is unknown, empty without a file."""
    return "" if file is None else f"{file}: " if line is None else f"{file}:{line}: "


def task_error(message: str, file: Path | None = None) -> TaskError:
    """Error for a task that cannot be loaded, if no line of the author's code raised it."""
    return TaskError(Problem("import", shorten(message), None if file is None else str(file), None, None, ""))


def problem_from_exception(
    exc: BaseException,
    stage: str,
    own_files: Collection[Path],
    cls: type | None = None,
    otherwise: tuple[str, int] | None = None,
) -> Problem:
    """The problem of `exc` for the author of `own_files`.

    Its line is the first of these that exists:

    * the line that one of the core's notes names, unless the author's innermost line raised the exception;
    * the innermost frame, of `exc` or else of its causes, in an author's file: one of `own_files`, or any
      other file that is not installed;
    * with `cls` (the task's class), the ``def`` of an override that cannot take the failed call's arguments;
    * with `cls`, the ``def`` of the author's hook of the stage, except for the stages ``build`` and ``step``;
    * `otherwise` (file and line).

    If a hook of `HOOK_STAGES` is on the traceback, its stage replaces `stage`, unless `stage` is ``import``,
    ``syntax``, ``policy`` or ``worker``. The message begins with the core's notes about earlier errors, and
    with the first cause of `exc`.
    """
    own = {str(path) for path in own_files}
    chain = [*chain_of(exc)]
    if _is_authors_syntax(exc, own):
        return _syntax_problem(exc)

    stage_found = stage if stage in ("import", "syntax", "policy", "worker") else _stage_of(chain, stage)
    places = [(link, place) for link in chain if (place := _place_in(link, own)) is not None]
    source, place = places[0] if places else (exc, None)
    notes = [note if isinstance(note, ErrorNote) else ErrorNote(note) for note in notes_of(exc)]
    noted = next((n.place for n in notes if n.place and not n.before and _is_authors(n.place[0], own)), None)
    if noted is not None and not _is_raised_at(source, place):
        place = noted[:2]
    if place is None and cls is not None:
        place = _override_of_other_arguments(source, cls, own)
    if place is None:
        hooks = () if stage_found in ("build", "step") else hooks_of(stage_found)
        found = None if cls is None else hook_definition(cls, hooks, own_files)
        place = otherwise if found is None else found[1]
    file, line = place if place is not None else (None, None)
    code = None
    if file is not None and line is not None:
        linecache.checkcache(file)  # the file may have been edited since linecache read it
        code = linecache.getline(file, line).strip()
    message = _message(exc)
    if isinstance(exc, AssertionError) and not str(exc) and code:
        message = shorten(f"{message}: {code}")
    if place is None and not isinstance(exc, CoreRefusal):
        message += _raised_at(exc)
    elif file not in own and (called := _innermost(source, own.__contains__)) is not None:
        message += f" (called at {Path(called[0]).name}:{called[1]})"
    before = [shorten(note).rstrip(".") for note in notes if note.before]
    before += [_with_place(one, own) for one in dict.fromkeys((chain[-1], source)) if one is not exc]
    about = [shorten(note) for note in notes if not note.before]
    message = ". ".join(part.rstrip(".") for part in ("; then ".join([*before, message]), *about))
    stopped = isinstance(exc, Interrupted)
    return Problem(stage_found, message, file, line, code or None, format_traceback(exc), stopped)


def shorten(text: str, limit: int = MAX_MESSAGE_CHARACTERS) -> str:
    """`text` on one line of at most `limit` characters."""
    line = " ".join(text[: 8 * limit].split())
    return line if len(line) <= limit else line[: limit - 1] + "…"


def format_traceback(exc: BaseException) -> str:
    """The traceback of `exc` without the workbench's own frames at its start, and without its middle if it is long.

    Python folds a function that calls itself, but two functions that call each other still give two thousand lines.
    """
    trace = exc.__traceback__
    while trace is not None and trace.tb_next is not None and _is_machinery(trace.tb_frame):
        trace = trace.tb_next
    try:
        lines = "".join(tracebacks.format_exception(type(exc), exc, trace)).splitlines()
    except RecursionError:
        # A RecursionError caught deep down leaves too little stack to format it.
        lines = ["Traceback too deep to print", _message(exc)]
    if len(lines) > TRACEBACK_HEAD_LINES + TRACEBACK_TAIL_LINES:
        left_out = len(lines) - TRACEBACK_HEAD_LINES - TRACEBACK_TAIL_LINES
        lines[TRACEBACK_HEAD_LINES:-TRACEBACK_TAIL_LINES] = [f"  ... {left_out} lines left out ..."]
    return "\n".join(
        line
        if len(line) <= MAX_TRACEBACK_LINE_CHARACTERS
        else line[: MAX_TRACEBACK_LINE_CHARACTERS - 1] + "…"
        for line in lines
    )


def definition_line(function: object) -> tuple[str, int] | None:
    """File and 1-based line of the ``def`` of a function, method or property; None for any other object.

    The ``def`` is searched, because a code object's first line is that of its first decorator.
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
    """The first of `hooks` that a class of the author's files defines, with file and line; None if all are inherited."""
    own = {str(path) for path in own_files}
    for name in hooks:
        method = next((vars(base)[name] for base in cls.__mro__ if name in vars(base)), None)
        place = definition_line(method)
        if place is not None and place[0] in own:
            return name, place
    return None


# --- what hooks return ---------------------------------------------------------------------------


def check_step_returns(
    cls: type,
    num_envs: int,
    evaluate: object,
    reward: object | None,
    source_files: Collection[Path],
) -> Problem | None:
    """The problem of the first wrong type or shape that a step of `num_envs` envs of `cls` returned; or None.

    ManiSkill 3.0.1 does not check types and shapes. Some mistakes raise far from their cause (``success`` as
    a Python bool: "'bool' object has no attribute 'clone'", inside `BaseEnv.step`). Others are silent with
    several envs: ``success`` of shape ``()`` gives a ``terminated`` of shape ``()``; a reward of shape
    ``(N, 1)`` or ``()``, or a Python float, is returned and broadcasts against ``(N,)`` into ``(N, N)`` in a
    trainer. With one env, all these mistakes look right.

    Args:
        evaluate: what ``evaluate()`` returned: a dict with ``success`` and ``fail`` as bool tensors of shape (N,); other
            entries may be anything, ManiSkill passes them on.
        reward: (N,) real numbers, or bools, which the rule `reward-rows` reports; None if no reward was computed.

    With one env shape () is allowed too. Tensors may be on any device. The problem's stage is ``returns``; its place is in
    `source_files`, or None if the hook is inherited. NaN is not a problem here: `envs.outliers` reports it.
    """
    from workbench.envs.evaluate_entries import (  # imports torch, which the server must not
        no_reward,
        wrong_evaluate,
    )

    message = wrong_evaluate(evaluate, num_envs)
    if message is not None:
        return problem_from_return(cls, "evaluate", message, source_files)
    message = None if reward is None else no_reward(reward, num_envs)
    if message is not None:
        return problem_from_return(cls, _REWARD_HOOKS[0], message, source_files)
    return None


def problem_from_return(cls: type, hook: str, message: str, source_files: Collection[Path]) -> Problem:
    """Problem for a wrong return value of `hook` of `cls`; `message` describes it.

    File and line are those of the hook's only ``return``, or of its ``def`` if it has several. For a reward, the hook is
    the one that the author defined: ManiSkill calls the normalized hook, which may call the author's dense hook.
    """
    hooks = _REWARD_HOOKS if hook in _REWARD_HOOKS else (hook,)
    found = hook_definition(cls, hooks, source_files)
    if found is None:
        return Problem("returns", f"{hooks[0]}() {message}", None, None, None, "")
    name, (file, defined) = found
    line = line_of_return(file, defined)
    code = linecache.getline(file, line).strip() or None
    return Problem("returns", f"{name}() {message}", file, line, code, "")


def _syntax_problem(exc: SyntaxError) -> Problem:
    assert exc.filename is not None
    text = exc.text or linecache.getline(exc.filename, exc.lineno or 1)
    # Only the exception itself: the frames are those of the compiler's caller.
    lines = "".join(tracebacks.format_exception_only(type(exc), exc)).rstrip("\n")
    code = shorten(text)
    column = (exc.offset or 0) - (len(text) - len(text.lstrip()))
    if code != text.strip() or not 1 <= column <= len(code) + 1:
        column = None
    return Problem("syntax", _message(exc), exc.filename, exc.lineno, code or None, lines, column=column)


def _message(exc: BaseException) -> str:
    name = type(exc).__qualname__
    try:
        # Not str(exc) of a SyntaxError, which ends in "(file.py, line 3)", or "(<string>, line 3)" for a
        # parsed text.
        text = str(exc.msg if isinstance(exc, SyntaxError) else exc)
    except Exception as failure:  # the author's own __str__ may raise
        text = f"<its __str__ raised {type(failure).__qualname__}>"
    if isinstance(exc, BdbQuit) and not text:
        text = "a debugger prompt was quit or had no terminal: remove the call just before this line"
    return shorten(f"{name}: {text}{_suggestion(exc)}" if text.strip() else name)


def _suggestion(exc: BaseException) -> str:
    """Text that suggests a similar name, as Python's interactive prompt does; empty if there is none."""
    wanted = getattr(exc, "name", None)
    if not isinstance(wanted, str) or not isinstance(exc, (NameError, AttributeError)):
        return ""
    if isinstance(exc, AttributeError):
        try:
            known = dir(exc.obj)
        except Exception:  # the author's own __dir__ may raise
            return ""
    else:
        frame = next(reversed([frame for frame, _ in tracebacks.walk_tb(exc.__traceback__)]), None)
        known = [] if frame is None else [*frame.f_locals, *frame.f_globals, *frame.f_builtins]
    close = difflib.get_close_matches(wanted, [name for name in known if name != wanted], n=1, cutoff=0.75)
    return f". Did you mean {close[0]!r}?" if close and "Did you mean" not in str(exc) else ""


_Line = tuple[str, int]
"""File, and 1-based line."""


def _place_in(exc: BaseException, own: Collection[str]) -> _Line | None:
    """The author's innermost line; None if there is none, or if it only calls a base class's constructor."""
    if _is_authors_syntax(exc, own):
        return str(exc.filename), exc.lineno or 1
    if isinstance(exc, CoreRefusal) and exc.place is not None and _is_authors(exc.place[0], own):
        return exc.place[:2]
    frames = [*tracebacks.walk_tb(exc.__traceback__)]
    for i in reversed(range(len(frames))):
        frame, line = frames[i]
        if _is_authors(frame.f_code.co_filename, own):
            below = [inner for inner, _ in frames[i + 1 :]]
            return None if _hands_on(frame, below) else (frame.f_code.co_filename, line)
    return None


def _override_of_other_arguments(exc: BaseException, cls: type, own: Collection[str]) -> _Line | None:
    """The line of the author's method that cannot be called like the method that it overrides, if such a call
    raised `exc`. Python raises this TypeError in the caller, so the traceback does not show the method."""
    frames = [frame for frame, _ in tracebacks.walk_tb(exc.__traceback__)]
    if not isinstance(exc, TypeError) or not frames:
        return None
    for name in frames[-1].f_code.co_names:
        owners = [vars(base)[name] for base in cls.__mro__ if name in vars(base)]
        place = definition_line(owners[0]) if len(owners) > 1 else None
        if place is not None and place[0] in own and not _takes(owners[0], owners[-1]):
            return place
    return None


def _takes(method: object, overridden: object) -> bool:
    """Whether `method` can be called with all arguments of the method that it overrides, by name or in
    order."""
    try:
        mine, theirs = inspect.signature(method), inspect.signature(overridden)  # type: ignore[arg-type]
    except (TypeError, ValueError):  # no function
        return True
    named = [p.name for p in theirs.parameters.values() if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)][
        1:
    ]
    for args, kwargs in (([None] * len(named), {}), ([], dict.fromkeys(named))):
        try:
            mine.bind(None, *args, **kwargs)
            return True
        except TypeError:
            continue
    return False


def _innermost(exc: BaseException, fits: Callable[[str], bool]) -> _Line | None:
    frames = [(frame.f_code.co_filename, line) for frame, line in tracebacks.walk_tb(exc.__traceback__)]
    return next((place for place in reversed(frames) if fits(place[0])), None)


def _is_raised_at(exc: BaseException, place: _Line | None) -> bool:
    return place is not None and place == _innermost(exc, lambda file: True)


def _hands_on(frame: FrameType, below: list[FrameType]) -> bool:
    """Whether `frame` is a constructor that calls the base class's constructor, and the error is in another
    method of the object, which the base class's constructor called.

    ``BaseEnv.__init__`` builds the scene and resets, so the line that calls it does not show where the build
    or reset fails.
    """
    same = [
        one.f_code.co_name == "__init__"
        for one in below
        if one.f_locals.get("self") is frame.f_locals.get("self")
    ]
    return frame.f_code.co_name == "__init__" and same[:1] == [True] and not all(same)


def _is_authors(file: str, own: Collection[str]) -> bool:
    return file in own or not is_installed(file)


def _is_authors_syntax(exc: BaseException, own: Collection[str]) -> TypeGuard[SyntaxError]:
    """Whether `exc` is a SyntaxError of one of the author's files, not of a text that their code parses."""
    known = isinstance(exc, SyntaxError) and exc.filename and exc.lineno is not None
    return bool(known) and _is_authors(exc.filename, own)  # type: ignore[union-attr]


def _with_place(exc: BaseException, own: Collection[str]) -> str:
    place = _place_in(exc, own)
    return (
        f"{_message(exc)} ({Path(place[0]).name}:{place[1]})"
        if place
        else f"{_message(exc)}{_raised_at(exc)}"
    )


def _raised_at(exc: BaseException) -> str:
    place = _innermost(exc, lambda file: True)
    return "" if place is None else f" (raised at {place[0]}:{place[1]})"


def _stage_of(chain: Iterable[BaseException], stage: str) -> str:
    for link in chain:
        names = [frame.f_code.co_name for frame, _ in tracebacks.walk_tb(link.__traceback__)]
        hooks = [name for name in names if name in HOOK_STAGES]
        if hooks:
            return HOOK_STAGES[hooks[-1]]
    return stage


def _is_machinery(frame: FrameType) -> bool:
    return str(frame.f_globals.get("__name__", "")).partition(".")[0] in _MACHINERY

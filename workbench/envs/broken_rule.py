"""Reports broken rules at the line of the task that broke them."""

from __future__ import annotations

import ast
import inspect
import linecache
import re
import sys
import textwrap
import warnings
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import FrameType, TracebackType
from typing import Any, Literal

from mani_skill.envs.sapien_env import BaseEnv

from workbench.envs.error_notes import CoreRefusal, Place
from workbench.envs.gpu_rules import Degree, Finding, Silence, silence_of
from workbench.machine.library_files import is_installed
from workbench.machine.parse_python import line_of_return, parse_python

MAX_PLACES = 64
"""Maximum number of places that are kept; breaches at further places are only counted."""
OWN_CODE = ("workbench.envs.", "workbench.pictures.")
"""Prefixes of the core's own modules."""
_GENERAL_CODE = ("workbench.", "mani_skill.utils.", "mani_skill.envs.s")
"""Prefixes of modules that are never at fault, since they only write what a task passes. The last prefix
covers ``mani_skill.envs.sapien_env`` and ``mani_skill.envs.scene``."""
_FRAMES_KEPT = 12
_BASE_ENV, _OUTERMOST = "mani_skill.envs.sapien_env", ("step", "reset")
"""Module and names of the outermost functions whose frames are kept; the frames of their callers are in the
traceback anyway."""

Frame = tuple[FrameType, int, int]
"""A frame, and the index of its instruction and the line number when the frame was stored."""
Occasion = Literal["step", "reset"]
_Key = tuple[str, Hashable]
"""Id of a rule, and what identifies its breach: a subject, else the line, else the message."""


class BrokenRule(CoreRefusal, RuntimeError):
    """The task broke a rule of GPU simulation whose degree is *stop*."""

    def __init__(self, message: str, rule: str, place: Place | None = None) -> None:
        super().__init__(
            f"{message} (Rule {rule}; with --rules warn, or rules='warn', the task continues.)", place=place
        )
        self.rule = rule


class WrongReturn(BrokenRule):
    """A hook returned what ManiSkill cannot use: `hook` is its name, `problem` what is wrong."""

    def __init__(self, problem: str, hook: str, rule: str, place: Place | None) -> None:
        super().__init__(f"{hook}() {problem}{in_brackets(place)}.", rule, place)
        self.problem, self.hook = problem, hook


class NeedsOneEnv(CoreRefusal, RuntimeError):
    """The task uses something that exists for a single env only; the tools then open the task with one
    env."""

    def __init__(self, reason: str, instead: str, place: Place | None) -> None:
        """
        Args:
            reason: a sentence without its full stop.
            instead: further sentences, which begin with a space; or empty.
            place: the author's line.
        """
        super().__init__(
            f"{reason}{in_brackets(place)}. With one env it runs: num_envs=1, or --num-envs 1.{instead}",
            place=place,
        )
        self.reason = reason


class RuleWarning(UserWarning):
    """A broken rule that does not stop the task."""


def warn_of(finding: Finding) -> None:
    """Issue a Python warning at the author's line."""
    if finding.file is None or finding.line is None:
        warnings.warn(finding.message, RuleWarning, stacklevel=2)
    else:
        warnings.warn_explicit(finding.message, RuleWarning, finding.file, finding.line)


@dataclass(frozen=True)
class _KeptFinding:
    finding: Finding
    occasion: Occasion
    """What the env was doing when the rule was last broken."""
    exact: bool
    """False if the line is only probably the line at fault."""
    confirmed: bool = True
    """False for a finding of the file's previous version that the present version has not repeated yet."""


class BrokenRules:
    """The rules that one env checks, and where its task broke them.

    A lost write is noticed only at the next fetch. So callers keep the frames of the write, and the error carries them
    as the innermost frames of its traceback.
    """

    def __init__(
        self, degrees: Mapping[str, Degree], on_finding: Callable[[Finding], None] = warn_of
    ) -> None:
        """
        Args:
            degrees: degree of each rule; see `gpu_rules.degrees_of`.
            on_finding: called once for each place where a rule that does not stop the task is broken.
        """
        self._degrees, self._on_finding = degrees, on_finding
        self._rows: dict[_Key, _KeptFinding] = {}
        self._silenced: dict[_Key, tuple[Finding, Silence]] = {}
        self._now: Occasion = "reset"
        self.more = 0
        """Number of breaches at places beyond `MAX_PLACES`."""
        self.serial = 0
        """Increases with every change."""
        self.step: int = 0
        """Control steps made."""

    @property
    def rows(self) -> tuple[Finding, ...]:
        return tuple(row.finding for row in self._rows.values())

    @property
    def silenced(self) -> tuple[tuple[Finding, Silence], ...]:
        """Findings that a comment silences, each with its comment; their breaches are not counted."""
        return tuple(self._silenced.values())

    def degree(self, rule: str) -> Degree:
        return self._degrees[rule]

    def report_breach(
        self,
        rule: str,
        message: str,
        frames: Sequence[Frame] | None = (),
        place: Place | None = None,
        subject: Hashable = None,
    ) -> None:
        """Raise or note a breach, as the rule's degree says.

        Args:
            frames: frames at fault, which become the innermost of the traceback. An empty sequence means the
                frames of the present call. None means that there are no frames: no line is at fault, or the
                line is known only as `place`.
            subject: breaches with the same subject share a row; without a subject, breaches at the same line.
        """
        degree = self._degrees[rule]
        if degree == "off":
            return
        if frames is not None:
            frames = frames or frames_of_the_task()
            place = place_of(frames)
        if self._is_silenced(rule, message, place):
            return
        if degree == "stop":
            raise broken_at(BrokenRule(message, rule, place), frames or ())
        self._note(rule, message, place, subject, exact=frames is not None)

    def begin(self) -> None:
        """Set the step count and the first step of each row to zero, after the trial steps of the task."""
        self.step = 0
        self._rows = {
            key: replace(row, finding=replace(row.finding, first_step=0)) for key, row in self._rows.items()
        }

    def returned(self, rule: str, hook: str, problem: str, place: Place | None) -> None:
        """Report a wrong return value of a hook, like `report_breach`."""
        message = f"{hook}() {problem}."
        if self._degrees[rule] == "off" or self._is_silenced(rule, message, place):
            return
        if self._degrees[rule] == "stop":
            raise WrongReturn(problem, hook, rule, place)
        self._note(rule, message, place, hook, exact=False)

    def _is_silenced(self, rule: str, message: str, place: Place | None) -> bool:
        silence = None if place is None else silence_of(place[0], place[1], rule)
        if place is None or silence is None:
            return False
        found = Finding(rule, self._degrees[rule], message, None, None, "", "", 1, self.step)
        self._silenced.setdefault((rule, place), (_at(found, place), silence))
        return True

    def _note(self, rule: str, message: str, place: Place | None, subject: Hashable, exact: bool) -> None:
        self.serial += 1
        key = rule, place or message if subject is None else subject
        row = self._rows.get(key)
        if row is None and len(self._rows) >= MAX_PLACES:
            self.more += 1
            return
        if row is None:
            found = Finding(rule, self._degrees[rule], message, None, None, "", "", 1, self.step)
            found = found if place is None else _at(found, place)
            self._rows[key] = _KeptFinding(found, self._now, exact)
            self._on_finding(found)
            return
        found = replace(row.finding, count=row.finding.count + 1)
        if exact and place is not None and not row.exact:
            found, row = _at(found, place), replace(row, exact=True)
        self._rows[key] = _KeptFinding(found, self._now, row.exact)

    # --- an edited file ------------------------------------------------------------------------------

    @contextmanager
    def during(self, occasion: Occasion, confirms: bool = True) -> Iterator[None]:
        """Context in which breaches belong to `occasion`.

        At its end, it drops the rows of the occasion that no breach has confirmed since the file was edited.

        Args:
            confirms: whether every rule of this occasion can be broken in the context; if not, no row is
                dropped.
        """
        before, self._now = self._now, occasion
        try:
            yield
        finally:
            self._now = before
        kept = {key: row for key, row in self._rows.items() if row.confirmed or row.occasion != occasion}
        if confirms and len(kept) < len(self._rows):
            self._rows = kept
            self.serial += 1

    def edited(self, place_now: Callable[[Finding], tuple[str, int] | None]) -> None:
        """Continue with another version of the file: drop rows whose function changed, mark the others unconfirmed.

        Args:
            place_now: returns file and line of a row in the new version; None if the row's function changed.
        """
        rows, self._rows, self._silenced = self._rows, {}, {}
        self.serial += 1
        for (rule, subject), row in rows.items():
            was = row.finding
            place = place_now(was)
            if place is None:
                continue
            there = (*place, was.function)
            key = rule, there if subject == (was.file, was.line, was.function) else subject
            self._rows[key] = replace(row, finding=_at(was, there), confirmed=False)


def _at(row: Finding, place: Place) -> Finding:
    file, line, function = place
    code = linecache.getline(file, line).strip()
    return replace(row, file=file, line=line, code=code, function=function)


def broken_at(error: BrokenRule, frames: Sequence[Frame]) -> BrokenRule:
    """The error, with `frames` (innermost first) as the innermost frames of its traceback."""
    trace = None
    for frame, instruction, line in frames:
        trace = TracebackType(trace, frame, instruction, line)
    return error.with_traceback(trace)


def frames_of_the_task(innermost: FrameType | None = None) -> tuple[Frame, ...]:
    """The frames of the call stack, innermost first, without the core's own modules."""
    frame = sys._getframe(1) if innermost is None else innermost
    kept: list[Frame] = []
    while frame is not None and len(kept) < _FRAMES_KEPT:
        if not frame.f_globals.get("__name__", "").startswith(OWN_CODE):
            kept.append((frame, frame.f_lasti, frame.f_lineno))
        if frame.f_code.co_name in _OUTERMOST and frame.f_globals.get("__name__") == _BASE_ENV:
            break
        frame = frame.f_back
    return tuple(kept)


def place_of_hook(task: type, hook: str) -> Place | None:
    """Where a hook is defined."""
    code = getattr(inspect.unwrap(getattr(task, hook)), "__code__", None)
    return None if code is None else (code.co_filename, code.co_firstlineno, hook)


def place_of_return(task: type, hook: str) -> Place | None:
    """The only ``return`` of a hook; the line of its ``def`` or first decorator if it has several."""
    place = place_of_hook(task, hook)
    return None if place is None else (place[0], line_of_return(*place[:2]), hook)


def place_of_class(cls: type) -> Place | None:
    """Where a class is defined; None for a class without a file."""
    try:
        return inspect.getfile(cls), inspect.getsourcelines(cls)[1], cls.__name__
    except (TypeError, OSError):
        return None


def place_of(frames: Sequence[Frame]) -> Place | None:
    """The first line in `frames` outside `_GENERAL_CODE`; a line outside installed packages is preferred."""
    general = None
    for frame, _, line in frames:
        code = frame.f_code
        if frame.f_globals.get("__name__", "").startswith(_GENERAL_CODE):
            continue
        if not is_installed(code.co_filename):
            return code.co_filename, line, code.co_name
        general = general or (code.co_filename, line, code.co_name)
    return general


def in_brackets(place: Place | None) -> str:
    return "" if place is None else f" ({place[0]}:{place[1]})"


def class_is_installed(cls: type) -> bool:
    """Whether a class comes from an installed package, not from a user's file."""
    try:
        return is_installed(inspect.getfile(cls))
    except (TypeError, OSError):  # made in a notebook, or by type()
        return False


# --- the line that assigns ---------------------------------------------------------------------------


_NAME = re.compile(r"[^\W\d]\w*")
_NOT_IN_A_RESET = {"__init__", "_load_scene", "_load_agent", "_after_reconfigure"}


def find_assignment(task: type, path: str) -> Place | None:
    """The line of the task's source that assigns ``self.<path>``, preferably in ``_initialize_episode``.

    Args:
        path: what follows ``self.``, such as ``target``, ``memory.best``, ``targets['left']``,
        ``goal.raw_pose``.
    """
    names = _NAME.findall(re.sub(r"\[.*?\]", "", path))
    wanted = names[-2] if names[-1:] == ["raw_pose"] and len(names) > 1 else (names or [""])[-1]
    found: list[tuple[int, Place]] = []
    for order, (name, function) in enumerate(_methods(task)):
        if name in _NOT_IN_A_RESET:
            continue
        for line in _lines_that_assign(function, wanted):
            rank = order + (0 if name == "_initialize_episode" else 1000)
            found.append((rank, (function.__code__.co_filename, line, name)))
    return min(found, default=(0, None))[1]


def find_entry(task: type, hook: str, name: str) -> Place | None:
    """The line of a hook that names the entry `name` of its return value, as a key or a keyword; else the
    line of the hook's ``def``."""
    function = inspect.unwrap(getattr(task, hook))
    for node, line in _nodes(function):
        key = getattr(node, "value", None) if isinstance(node, ast.Constant) else getattr(node, "arg", None)
        if key == name and isinstance(node, ast.Constant | ast.keyword):
            return function.__code__.co_filename, line, hook
    return place_of_hook(task, hook)


def files_of_task(task: type) -> set[str]:
    """Source files of the task's methods, including those that it inherits from classes below BaseEnv."""
    return {function.__code__.co_filename for _, function in _methods(task)}


def _methods(task: type) -> Iterator[tuple[str, Any]]:
    for owner in task.__mro__:
        if not issubclass(owner, BaseEnv) or owner is BaseEnv:
            continue
        for name, member in vars(owner).items():
            member = member.fset if isinstance(member, property) else getattr(member, "__func__", member)
            member = inspect.unwrap(member) if callable(member) else member
            if inspect.isfunction(member):
                yield name, member


def _lines_that_assign(function: Any, wanted: str) -> Iterator[int]:
    for node, line in _nodes(function):
        if isinstance(node, ast.Assign):
            targets = node.targets
        elif isinstance(node, (ast.AugAssign, ast.AnnAssign)):
            targets = [node.target]
        else:
            continue
        if any(_names(target, wanted) for target in targets):
            yield line


def _nodes(function: Any) -> Iterator[tuple[ast.AST, int]]:
    """The nodes of a function's source that have a line, each with its line."""
    try:
        lines, first = inspect.getsourcelines(function)
        tree = parse_python(textwrap.dedent("".join(lines)))
    except (OSError, SyntaxError):  # made without source, or a lambda in the middle of a line
        return
    for node in ast.walk(tree):
        if (line := getattr(node, "lineno", None)) is not None:
            yield node, first + line - 1


def _names(target: ast.expr, wanted: str) -> bool:
    if isinstance(target, (ast.Tuple, ast.List)):
        return any(_names(item, wanted) for item in target.elts)
    if isinstance(target, (ast.Subscript, ast.Starred)):
        return _names(target.value, wanted)
    return isinstance(target, ast.Attribute) and target.attr == wanted

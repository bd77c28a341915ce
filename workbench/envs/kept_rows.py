"""Finds rows of a task's attributes that a partial reset changed for other envs, and the line at fault."""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Sequence
from types import FrameType
from typing import Any

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv

from workbench.envs.broken_rule import (
    BrokenRules,
    Frame,
    files_of_task,
    find_assignment,
    frames_of_the_task,
    place_of_hook,
)
from workbench.envs.maniskill_private import task_class
from workbench.envs.simulation.strict_system import envs_named
from workbench.envs.snapshots.task_attributes import Walk, walk_task_values
from workbench.envs.snapshots.task_state import is_per_env, version_of
from workbench.machine.library_files import is_installed

MAX_TRACED_LINES = 2000
"""Maximum number of the author's lines after which values are compared in one reset."""
_ROUNDING_TOLERANCE = 1e-5
"""Tolerance for values computed again from the same poses; rotations were seen to differ by 1e-7."""
_ITEM = re.compile(r"\[(\d+)\]")


class KeptRows:
    """Copy of the values that a task keeps for each env, to find rows that a partial reset changed for envs
    that it does not reset.

    A partial reset must change only the rows of ``env_idx``, in the task's tensors, arrays, lists and Poses,
    and in those inside its dicts and own objects. Nothing raises if other rows change: ``self.target =
    torch.rand((self.num_envs, 2))`` gives every env another target in the middle of its episode. Values are
    compared, so a value computed again with the same result is not a fault.

    Args:
        env: an env in the middle of an episode.
        chosen: the envs that are about to be reset.
    """

    def __init__(self, env: BaseEnv, chosen: Sequence[int]) -> None:
        self.env, self._count = env, len(chosen)
        self._elsewhere = np.setdiff1d(np.arange(env.num_envs), np.asarray(chosen, dtype=np.int64))
        walk = walk_task_values(env)
        self._single, self._groups = _paths(walk, env.num_envs)
        self.before = {path: _copy(value) for path, value in self._read(walk).items()}

    def changed_envs(self) -> dict[str, tuple[int, ...]]:
        """The envs that are not being reset and whose rows changed, by path (without ``self.``).

        Only paths with a change are included. The tuple is empty if the value now has rows for the envs being
        reset only.
        """
        now = self._read(walk_task_values(self.env))
        found = {path: self._difference(before, now.get(path)) for path, before in self.before.items()}
        return {path: envs for path, envs in found.items() if envs is not None}

    def changed_paths(self, seen: dict[str, tuple[Any, int, bool]]) -> set[str]:
        """The paths at which rows of other envs changed.

        Args:
            seen: values at the last call; this call updates them. A tensor that was not written since the
                last call is not compared again.
        """
        now = self._read(walk_task_values(self.env))
        for path, before in self.before.items():
            value = now.get(path)
            version = version_of(value) if isinstance(value, torch.Tensor) else -1
            last = seen.get(path)
            if version >= 0 and last is not None and last[0] is value and last[1] == version:
                continue
            seen[path] = value, version, self._difference(before, value) is not None
        return {path for path, (_, _, differs) in seen.items() if differs}

    def _read(self, walk: Walk) -> dict[str, Any]:
        """The present value at each path; for a group of paths, the list of their values."""
        now = {leaf.path: leaf.value for leaf in walk.leaves}
        read = {path: now[path] for path in self._single if path in now}
        for path, each in self._groups.items():
            if all(one in now for one in each):
                read[path] = [now[one] for one in each]
        return read

    def _difference(self, before: Any, now: Any) -> tuple[int, ...] | None:
        """The tuple of `changed_envs` for one value; None if the value counts as unchanged."""
        elsewhere = self._elsewhere
        if isinstance(before, list) and isinstance(now, list):
            if len(now) == len(before):
                return self._named([not _same(before[i], now[i]) for i in elsewhere])
            return () if len(now) == self._count else None
        if not isinstance(before, (torch.Tensor, np.ndarray)) or not isinstance(now, type(before)):
            return None  # the attribute now has another type
        if now.shape == before.shape:
            return self._named(_differ(_array(before)[elsewhere], _array(now)[elsewhere]))
        if now.ndim and len(now) == self._count and now.shape[1:] == before.shape[1:]:
            return ()
        return tuple(elsewhere.tolist()) if is_per_env(now, len(before)) else None

    def _named(self, differs: Any) -> tuple[int, ...] | None:
        rows = np.reshape(differs, (len(self._elsewhere), -1)).any(axis=1)
        return tuple(self._elsewhere[rows].tolist()) or None


def _is_outside_the_agent(path: str) -> bool:
    # ManiSkill resets robots and controllers (`partial_reset.KeptControllers`).
    return path != "agent" and not path.startswith(("agent.", "agent["))


def _paths(walk: Walk, num_envs: int) -> tuple[list[str], dict[str, list[str]]]:
    """(paths, groups). The paths are those of values with a row for each env. A group is N paths that differ only
    in a list index 0..N-1, such as the paths of N tensors in a list, one for each env."""
    single, items = [], {}
    for leaf in walk.leaves:
        if not _is_outside_the_agent(leaf.path):
            continue
        if is_per_env(leaf.value, num_envs):
            single.append(leaf.path)
        elif isinstance(leaf.value, (torch.Tensor, np.ndarray)) and (item := _ITEM.search(leaf.path)):
            around = leaf.path[: item.start()], leaf.path[item.end() :]
            items.setdefault(around, {})[int(item[1])] = leaf.path
    groups = {
        f"{before}[i]{after}": [paths[i] for i in range(num_envs)]
        for (before, after), paths in items.items()
        if paths.keys() == set(range(num_envs))
    }
    return single, groups


def _copy(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return value.detach().clone()
    if isinstance(value, list):
        return [_copy(item) for item in value]
    return value.copy() if isinstance(value, np.ndarray) else value


def _array(value: torch.Tensor | np.ndarray) -> np.ndarray:
    if isinstance(value, np.ndarray):
        return value
    value = value.detach()
    return (value.float() if value.dtype == torch.bfloat16 else value).cpu().numpy()


def _differ(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Mask of the numbers in which two arrays differ; NaN equals NaN."""
    if a.dtype.kind in "fc" and b.dtype.kind in "fc":
        return ~np.isclose(a, b, rtol=_ROUNDING_TOLERANCE, atol=_ROUNDING_TOLERANCE, equal_nan=True)
    return np.asarray((a != b) & ~((a != a) & (b != b)))


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, (torch.Tensor, np.ndarray)) and isinstance(b, type(a)):
        a, b = _array(a), _array(b)
        return a.shape == b.shape and not _differ(a, b).any()
    return type(a) is type(b) and (a is b or bool(a == b) or bool(a != a and b != b))


# --- lines -------------------------------------------------------------------------------------------


class _Lines:
    """Compares the rows after each line of the author's code, and keeps the line after which they differ.

    Lines are traced in the first partial reset of a class. If the line of a change is not found, they are
    traced in the next reset too, but in at most `_MAX_TRACED_RESETS` resets in all. If a debugger is already
    tracing, `find_assignment` reads the line from the source instead.
    """

    def __init__(self, rows: KeptRows) -> None:
        self.rows = rows
        self._files: Collection[str] = ()
        self._left = MAX_TRACED_LINES
        self._seen: dict[str, tuple[Any, int, bool]] = {}
        self._at: Frame | None = None
        """The running line."""
        self.found: dict[str, tuple[Frame, ...]] = {}

    def start(self) -> None:
        if sys.gettrace() is not None or not self.rows.before:
            return  # a debugger or coverage is tracing
        self._files = files_of_task(task_class(self.rows.env))
        frame: FrameType | None = sys._getframe(1)
        while frame is not None:  # trace the callers too: a task's own `reset` runs more lines later
            if self._runs_task_code(frame):
                frame.f_trace = self._traced
                self._at = self._at or (frame, frame.f_lasti, frame.f_lineno)
            frame = frame.f_back
        sys.settrace(self._called)

    def stop(self) -> None:
        if sys.gettrace() == self._called:
            self._look()
            sys.settrace(None)

    def _runs_task_code(self, frame: FrameType) -> bool:
        file = frame.f_code.co_filename
        return file in self._files or not is_installed(file)

    def _called(self, frame: FrameType, event: str, argument: Any) -> Any:
        return self._traced if self._runs_task_code(frame) else None

    def _traced(self, frame: FrameType, event: str, argument: Any) -> Any:
        if event == "line":
            self._look()
            self._at = frame, frame.f_lasti, frame.f_lineno
        elif event == "return":
            self._look()
            back = frame.f_back
            while back is not None and back.f_trace != self._traced:
                back = back.f_back
            self._at = None if back is None else (back, back.f_lasti, back.f_lineno)
        return self._traced

    def _look(self) -> None:
        if self._at is None or self._left == 0:
            return
        self._left -= 1
        changed = self.rows.changed_paths(self._seen)
        frame = self._at[0]
        for path in changed - self.found.keys():
            self.found[path] = (self._at, *frames_of_the_task(frame.f_back))
        for path in self.found.keys() - changed:
            del self.found[path]


# --- reports -----------------------------------------------------------------------------------------


_MAX_TRACED_RESETS = 3
"""Maximum number of partial resets of a class in which lines are traced."""


class ResetWatch:
    """Watches the partial resets of one env, from `start` to `report` or `stop`.

    Args:
        rules: receives the breaches.
    """

    def __init__(self, rules: BrokenRules) -> None:
        self._rules = rules
        self._lines: _Lines | None = None
        self._chosen: tuple[int, ...] = ()
        self._task: type | None = None
        self._tries = 0
        """Number of further resets in which lines may be traced; at first `_MAX_TRACED_RESETS`."""
        self._seeks = False
        """Whether to trace lines in the next reset."""
        self.whole = False
        """Whether a task's own ``reset`` is being watched as a whole."""

    @property
    def looks(self) -> bool:
        return self._lines is not None

    def start(self, env: BaseEnv, task: type, chosen: Sequence[int]) -> None:
        """Start watching; the envs `chosen` are about to be reset."""
        if self._task is not task:
            self._task, self._tries, self._seeks = task, _MAX_TRACED_RESETS, True
        self._chosen = tuple(chosen)
        self._lines = _Lines(KeptRows(env, chosen))
        if self._seeks:
            self._lines.start()

    def go_on(self, env: BaseEnv) -> None:
        """Start again within the same reset, after code that is allowed to change rows of all envs."""
        assert self._task is not None
        self.start(env, self._task, self._chosen)

    def stop(self) -> None:
        """Stop watching, without a report."""
        if self._lines is not None:
            self._lines.stop()
            self._lines = None

    def report(self, over: bool = True) -> None:
        """Report what the reset changed, or has changed so far if it is not `over`.

        Raises:
            BrokenRule: a rule whose degree is *stop* was broken.
        """
        lines = self._lines
        if lines is None:
            return
        self.stop()
        found = lines.rows.changed_envs()
        if over or found:
            # Tracing slows a reset down, so trace only if a line is missing.
            self._tries -= self._seeks
            self._seeks = self._tries > 0 and not found.keys() <= lines.found.keys()
        for path, envs in found.items():
            self._report(path, envs, lines.found.get(path, ()), lines.rows.env.num_envs)

    def _report(self, path: str, envs: tuple[int, ...], frames: tuple[Frame, ...], total: int) -> None:
        assert self._task is not None
        shown = path.removesuffix(".raw_pose")
        if not envs:
            rule = "rows-lost"
            message = (
                f"self.{shown} now has rows for only {len(self._chosen)} of {total} envs, those being reset: write "
                f"`self.{path}[env_idx] = ...` instead of replacing it."
            )
        else:
            rule = "rows-rewritten"
            index = path if "[i]" in path else f"{path}[env_idx]"
            of = " for each i of env_idx" if "[i]" in path else ""
            message = (
                f"self.{shown} is changed in {envs_named(envs)}, which {_are(envs)} not being reset and "
                f"in the middle of an episode. Change the rows of env_idx only: `self.{index} = ...`{of}."
            )
        place = None
        if not frames:
            place = find_assignment(self._task, path) or place_of_hook(self._task, "_initialize_episode")
        self._rules.report_breach(rule, message, frames or None, place, subject=path)


def _are(envs: Sequence[int]) -> str:
    return "is" if len(envs) == 1 else "are"

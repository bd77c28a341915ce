"""Times a control step by hook, and by line of the author's files."""

from __future__ import annotations

import linecache
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from types import FrameType
from typing import Any

import numpy as np
from mani_skill.envs.sapien_env import BaseEnv

from workbench.checks.evidence.collect import Checkup
from workbench.checks.results import HookTime, LineTime, StepProfile
from workbench.envs import action_vector as actions
from workbench.envs.task_env import TaskEnv

EVERY_STEP = (
    "evaluate", "_get_obs_extra", "_get_obs_agent", "compute_dense_reward", "compute_normalized_dense_reward",
    "compute_sparse_reward", "_before_control_step", "_after_control_step", "_before_simulation_step",
    "_after_simulation_step", "step", "get_info", "get_obs", "get_reward",
)  # fmt: skip
"""Hooks that run at every step."""

STEPS = 200
"""Number of control steps that are timed."""
NUM_ENVS = 64
"""Number of envs whose steps are timed."""
_WARM_UP_STEPS = 5
_REST = "the rest of step"
"""Name for the time of `step` outside hooks and `_PARTS`."""
_PARTS = (
    ("scene", "step", "physics"),
    ("agent", "set_action", "controller"),
    ("agent", "before_simulation_step", "controller"),
    ("agent", "get_proprioception", "the robot's observation"),
)
"""Attribute of the env, method of that object, and name in the profile."""


def profile_step(checkup: Checkup, num_envs: int | None = None, steps: int = STEPS) -> StepProfile:
    """Time steps with random actions, on separate envs (`NUM_ENVS` by default).

    Hooks are timed in every second step. Lines are timed in the other steps, which the tracer slows down: so
    the times of a hook's lines are scaled to add up to the time of the hook. Raises TaskError if the task
    raises.
    """
    num_envs = num_envs or checkup.at_most(NUM_ENVS)
    with checkup.env(num_envs) as task:
        checkup.reset(task, checkup.seeds[0])
        rng = np.random.default_rng(0)
        clock = _Clock({str(file) for file in checkup.loaded.source_files})
        own = [hook for hook in EVERY_STEP if _is_authors(checkup, hook)]
        _wrap(clock, task, own)
        for step in range(_WARM_UP_STEPS + steps):
            clock.begin_step(measured=step >= _WARM_UP_STEPS, traced=step % 2 == 1)
            checkup.step(task, actions.random_action(task.parts, num_envs, rng))
    return _profile_of(checkup, clock, num_envs, steps, own)


def _is_authors(checkup: Checkup, hook: str) -> bool:
    return getattr(checkup.loaded.cls, hook, None) is not getattr(BaseEnv, hook, None)


def _wrap(clock: _Clock, task: TaskEnv, own: list[str]) -> None:
    env: Any = task.env
    for hook in own:
        if hook != "step":
            setattr(env, hook, clock.timing(getattr(env, hook), hook, traces=True))
    for owner, method, name in _PARTS:
        thing = getattr(env, owner, None)
        if hasattr(thing, method):
            setattr(thing, method, clock.timing(getattr(thing, method), name))
    env.step = clock.timing(env.step, "step" if "step" in own else _REST, traces="step" in own)


def _profile_of(checkup: Checkup, clock: _Clock, num_envs: int, steps: int, own: list[str]) -> StepProfile:
    timed = max(1, clock.timed_steps)
    total = sum(clock.hooks.values()) or 1e-9
    hooks = [
        HookTime(
            name, 1e3 * seconds / timed, seconds / total, checkup.places.hook(name) if name in own else None
        )
        for name, seconds in sorted(clock.hooks.items(), key=lambda hook: -hook[1])
    ]
    by_hook: defaultdict[str, float] = defaultdict(float)
    for (hook, _, _), seconds in clock.lines.items():
        by_hook[hook] += seconds
    lines = []
    for (hook, file, line), seconds in clock.lines.items():
        part = seconds / by_hook[hook] * clock.hooks[hook]
        code = linecache.getline(file, line).strip()
        lines.append(LineTime(hook, file, line, code, 1e3 * part / timed, part / total))
    lines.sort(key=lambda line: -line.milliseconds)
    return StepProfile(num_envs, steps, 1e3 * total / timed, tuple(hooks), tuple(lines))


class _Clock:
    """Adds up the times of lines and of wrapped functions. The time of a function excludes the wrapped
    functions that it calls."""

    def __init__(self, files: set[str]) -> None:
        self.hooks: defaultdict[str, float] = defaultdict(float)
        """Seconds in the steps without a tracer."""
        self.lines: defaultdict[tuple[str, str, int], float] = defaultdict(float)
        """Seconds by hook, file and line in the steps with a tracer."""
        self.timed_steps = 0
        self._files = files
        self._measured = self._traced = False
        self._running: list[str] = []
        self._since = 0.0
        self._at: list[tuple[str, str, int]] = []
        """The lines that run, the innermost last."""
        self._line_since = 0.0

    def begin_step(self, measured: bool, traced: bool) -> None:
        self._measured, self._traced = measured, traced
        self.timed_steps += measured and not traced

    def timing(self, function: Callable[..., Any], name: str, traces: bool = False) -> Callable[..., Any]:
        """The function, timed under a name.

        Args:
            traces: whether the function's lines are timed too; only for the author's functions.
        """

        def timed(*args: Any, **kwargs: Any) -> Any:
            self._switch(name)
            before = sys.gettrace()
            if self._traced and self._measured and traces:
                sys.settrace(self._trace)
            try:
                return function(*args, **kwargs)
            finally:
                sys.settrace(before)
                self._switch(None)

        return timed

    def _switch(self, name: str | None) -> None:
        """Begin to time a function; None ends the timing of the current one."""
        now = time.perf_counter()
        if self._running and self._measured and not self._traced:
            self.hooks[self._running[-1]] += now - self._since
        if name is None:
            self._running.pop()
        else:
            self._running.append(name)
        self._since = time.perf_counter()

    def _trace(self, frame: FrameType, event: str, argument: Any) -> Any:
        if frame.f_code.co_filename not in self._files:
            return None
        self._move(None)
        self._at.append((self._running[-1], frame.f_code.co_filename, frame.f_lineno))
        return self._trace_line

    def _trace_line(self, frame: FrameType, event: str, argument: Any) -> Any:
        if event == "line":
            self._move((self._running[-1], frame.f_code.co_filename, frame.f_lineno))
        elif event == "return":
            self._move(None)
            self._at.pop()
        return self._trace_line

    def _move(self, place: tuple[str, str, int] | None) -> None:
        now = time.perf_counter()
        if self._at:
            self.lines[self._at[-1]] += now - self._line_since
            if place is not None:
                self._at[-1] = place
        self._line_since = time.perf_counter()

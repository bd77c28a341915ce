"""Episodes recorded in memory from envs that run in this process, as a recording would hold them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from workbench.envs import action_vector as actions
from workbench.envs.recorded_run import RecordedRun
from workbench.envs.step_result import StepResult
from workbench.episodes.recorded_state import read_states
from workbench.task.description import TaskOptions
from workbench.task.open import OpenedTask, open_task

States = dict[str, np.ndarray]


def opened(task: str, num_envs: int = 3, **kwargs: object) -> OpenedTask:
    """Without a renderer: nothing here looks at pictures."""
    return open_task(task, TaskOptions(num_envs, "cpu", 0, {"render_backend": "none", **kwargs}))


@dataclass
class Recorded:
    """What every env of a batch lived through: T steps and T + 1 states."""

    steps: list[StepResult]
    states: list[States]
    seeds: list[int]

    def run(self, env: int, name: str = "a recording") -> RecordedRun:
        after = self.steps[1:]
        return RecordedRun(
            name,
            self.seeds[env],
            {},
            np.stack([s.action[env] for s in after]),  # pyright: ignore[reportOptionalSubscript]
            {n: np.stack([state[n][env] for state in self.states]) for n in self.states[0]},
            {n: np.stack([_entry(s, n, env) for s in self.steps]) for n in self.steps[-1].evaluate},
            np.array([s.reward[env] for s in after], np.float32),
        )


def _entry(step: StepResult, name: str, env: int) -> np.ndarray:
    """NaN where a state lacks it: the terms of a reward in the first."""
    return np.asarray(step.evaluate[name][env]) if name in step.evaluate else np.array(np.nan)


def record(
    task: OpenedTask,
    steps: int,
    seeds: list[int] | None = None,
    act: Callable[[int], np.ndarray] | None = None,
) -> Recorded:
    """Reset every env by itself with its seed (or all at once with 0, 1 ... if None), and make steps."""
    env, rng = task.env, np.random.default_rng(0)
    if seeds is None:
        first = env.reset(0)
    else:
        for i, seed in enumerate(seeds):
            first = env.reset([seed], [i])
    said, states = [first], [read_states(env.env)]
    for t in range(steps):
        action = actions.random_action(env.parts, env.num_envs, rng) if act is None else act(t)
        said.append(env.step(action))
        states.append(read_states(env.env))
    return Recorded(said, states, [int(seed) for seed in env.episode_seeds])


def reaching(steps: int, num_envs: int) -> Callable[[int], np.ndarray]:
    """Actions of a Panda's joints that press its hand down to the table, and then wander: contacts on the way."""
    rng = np.random.default_rng(1)
    down = np.array([0.0, 1.0, 0.0, 0.2, 0.0, 0.6, 0.0, -1.0], np.float32)
    noise = rng.uniform(-0.3, 0.3, (steps, num_envs, 8)).astype(np.float32)
    return lambda t: np.clip((down if t < steps // 2 else 0 * down) + noise[t], -1, 1)

"""Episodes recorded in memory from envs in this process, with the contents of a recording."""

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
    """Open the task without a renderer: no test here needs pictures."""
    return open_task(task, TaskOptions(num_envs, "cpu", 0, {"render_backend": "none", **kwargs}))


@dataclass
class Recorded:
    """The trajectory of every env of a batch: T steps and T + 1 states."""

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
    """The entry's value, NaN where a state lacks it: reward terms in the first state."""
    return np.asarray(step.evaluate[name][env]) if name in step.evaluate else np.array(np.nan)


def record(
    task: OpenedTask,
    steps: int,
    seeds: list[int] | None = None,
    act: Callable[[int], np.ndarray] | None = None,
) -> Recorded:
    """Reset each env with its seed (all at once with 0, 1 ... if None), then step."""
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
    """Joint actions that press a Panda's hand onto the table and then move randomly, to make contacts."""
    rng = np.random.default_rng(1)
    down = np.array([0.0, 1.0, 0.0, 0.2, 0.0, 0.6, 0.0, -1.0], np.float32)
    noise = rng.uniform(-0.3, 0.3, (steps, num_envs, 8)).astype(np.float32)
    return lambda t: np.clip((down if t < steps // 2 else 0 * down) + noise[t], -1, 1)

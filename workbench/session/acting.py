"""What the envs do next: the source of the actions, and the random numbers of the player.

The random actions and the seeds of new episodes come from one generator, so that a reset with the session's seed
repeats everything that follows it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.authoring.problem import TaskError, problem_from_exception
from workbench.core import actions
from workbench.core.task_env import TaskEnv
from workbench.session.interrupts import Interrupted
from workbench.session.messages import ActionSource
from workbench.session.policy import Policy, load_policy


class Acting:
    """Chooses the action of every control step."""

    def __init__(self) -> None:
        self._source: ActionSource = "random"
        self._policy: Policy | None = None
        self._rng = np.random.default_rng(0)
        self.sliders: tuple[float, ...] = ()
        """(A,) what every env is given while the source is ``sliders``; another length is no action."""

    def seed(self, seed: int) -> None:
        """Begin the random numbers anew."""
        self._rng = np.random.default_rng(seed)

    def fresh_seeds(self, count: int) -> list[int]:
        # Each episode has a seed of its own, or a recording of it could not say how to start it again.
        return [int(seed) for seed in self._rng.integers(2**31, size=count)]

    def use(self, source: ActionSource, policy: str | None) -> None:
        """Take the actions from there.

        Raises:
            TaskError: the policy cannot be imported; the envs then hold still.
        """
        self._source = source
        if source != "policy" or policy is None:
            return
        try:
            self._policy = load_policy(policy)
        except (Exception, SystemExit, Interrupted) as error:
            self._policy = None
            raise TaskError(problem_from_exception(error, "policy", ())) from error

    def next_action(self, task: TaskEnv) -> NDArray[np.float32]:
        """(N, A), within the bounds but for a policy's.

        Raises:
            TaskError: the policy raised, or gave no action.
        """
        if self._source == "random":
            return actions.random_action(task.parts, task.num_envs, self._rng)
        if self._source == "policy" and self._policy is not None:
            try:
                return actions.to_flat_action(task.env, task.parts, self._policy(task.obs))
            except (Exception, SystemExit, Interrupted) as error:
                raise TaskError(problem_from_exception(error, "policy", ())) from error
        low, high = actions.bounds(task.parts)
        if self._source == "zero":
            return _same_for_all(np.clip(0.0, low, high), task)
        if self._source == "sliders" and len(self.sliders) == len(low):
            return _same_for_all(np.clip(np.asarray(self.sliders, np.float32), low, high), task)
        return actions.hold_action(task.parts, task.num_envs)


def _same_for_all(action: NDArray[Any], task: TaskEnv) -> NDArray[np.float32]:
    return np.broadcast_to(action, (task.num_envs, len(action))).astype(np.float32)

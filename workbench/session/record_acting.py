"""What the envs of a recording do: so that an episode is the same whatever env it runs in, and beside which others.

The page draws its random actions for the whole batch at once, so what env 3 does depends on how many envs there are.
A recording is to hold the same episodes on any number of envs and processes. So each episode draws from a generator
of its own, begun with its seed; and where actions are given by a file, each has its place in its own.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from workbench.core import actions
from workbench.core.task_env import TaskEnv
from workbench.session.acting import Acting
from workbench.session.given_actions import GivenEpisode


class RecordActing:
    """Chooses the actions of every control step; an env without an episode holds still."""

    def __init__(self, acting: Acting | None) -> None:
        """
        Args:
            acting: asked for whatever is neither random nor given; None for those.
        """
        self._acting = acting
        self._rng: dict[int, np.random.Generator] = {}
        self._given: dict[int, GivenEpisode] = {}

    def begin(self, env: int, seed: int, given: GivenEpisode | None) -> str:
        """An episode begins in this env; returns what will choose its actions, as its recording says it."""
        self._rng[env] = np.random.default_rng(seed)
        self._given.pop(env, None)
        if given is not None:
            self._given[env] = given
            return given.name
        return "random" if self._acting is None else self._acting.name

    def end(self, env: int) -> None:
        """Nothing is to be done in this env any more."""
        self._rng.pop(env, None)

    def next_action(self, task: TaskEnv, steps: Mapping[int, int]) -> NDArray[np.float32]:
        """(N, A); `steps` says how many were made, of each env with an episode.

        Raises:
            TaskError: the policy raised, or gave no action.
            ValueError: actions of another size were given.
        """
        action = actions.hold_action(task.parts, task.num_envs)
        if self._acting is not None:
            # Asked for the whole batch, as a policy is written for.
            chosen = self._acting.next_action(task)
            for env in steps:
                action[env] = chosen[env]
            return action
        for env, step in steps.items():
            given = self._given.get(env)
            if given is None:
                action[env] = actions.random_action(task.parts, 1, self._rng[env])[0]
                continue
            if given.actions.shape[1] != action.shape[1]:
                raise ValueError(
                    f"the file's actions have {given.actions.shape[1]} dimensions, and this task's {action.shape[1]} "
                    f"({', '.join(name for part in task.parts for name in part.names)}): another control mode or robot?"
                )
            action[env] = given.actions[step]
        return action

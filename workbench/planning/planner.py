"""``workbench.Planner``: actions for an env of `workbench.make`, planned with rollouts of its own task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.envs import action_vector as actions
from workbench.envs.indices import envs_of_batch
from workbench.envs.maniskill_private import episode_seeds, open_env
from workbench.envs.snapshots.snapshot import take_snapshot
from workbench.planning.options import PlanOptions
from workbench.planning.rollouts import Plan, RolloutPlanner, make_rollout_env, require_plannable


class Planner:
    """Plans the actions of an env of `workbench.make`, with rollouts of its task and its own reward::

        env = workbench.make("PickCube-v1", control_mode="pd_ee_delta_pose")
        planner = workbench.Planner(env, rollouts=64)
        env.reset(seed=0)
        planner.reset()
        for _ in range(50):
            obs, reward, terminated, truncated, info = env.step(planner.actions())
        planner.close()

    The same seeds, options and earlier actions of the env give the same actions to the last bit. The env
    itself is only read, and the state of the process's random generators is preserved.
    """

    def __init__(
        self,
        env: gym.Env,
        *,
        threads: int | None = None,
        exact: bool = True,
        made_with: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        """
        Args:
            env: an env of `workbench.make`, wrapped or not.
            threads: threads that step the rollouts on the CPU; None for one per core that the process may use.
            exact: False restores faster, but plans may differ because contacts differ in the last bits.
            made_with: keyword arguments that the env was made with; None for those of its ``spec``.
            options: fields of `PlanOptions`: ``method``, ``rollouts``, ``horizon`` (seconds), ``knots``, ``noise``,
                ``temperature``, ``elites``, ``rounds``, ``every``.

        Raises:
            TypeError: `env` is not a ManiSkill env, or an option does not exist.
            NothingToPlan: the task has no actions, or no reward.
            ValueError: an option is out of its range.
            Exception: raised by the author's class while the envs for the rollouts are built.
        """
        self._live = open_env(env)
        require_plannable(self._live)
        self.options = PlanOptions(**options)
        given: Mapping[str, Any] = made_with or (env.spec.kwargs if env.spec is not None else {})
        rolled = make_rollout_env(self._live, given, self.options.rollouts, threads)
        try:
            self._rollouts = RolloutPlanner(rolled, self.options, exact)
        except BaseException:
            rolled.close()
            raise
        self._parts = actions.action_parts(self._live)
        self.plans: dict[int, Plan] = {}
        """Last plan of each env, with the results of its rollouts."""
        self._taken: dict[int, int] = {}
        """Number of actions of each plan that were returned already."""

    def reset(self, env_idx: Sequence[int] | int | None = None, seed: int | None = None) -> None:
        """Begin an episode in these envs (None for all): their old plans are dropped.

        Args:
            seed: seed of the candidates in each of these envs; None for the seed of each env's episode.
        """
        seeds = episode_seeds(self._live)
        for env in self._chosen(env_idx):
            own = 0 if seeds is None else int(seeds[env])
            self._rollouts.begin(env, own if seed is None else seed)
            self.plans.pop(env, None)
            self._taken[env] = 0

    @property
    def horizon(self) -> int:
        """H, control steps of a plan."""
        return self._rollouts.horizon

    @property
    def rollout_env(self) -> BaseEnv:
        """The batch of K envs in which the rollouts run."""
        return self._rollouts.env

    def actions(self, env_idx: Sequence[int] | int | None = None) -> Any:
        """The next action for ``env.step``: a tensor (N, A), or a dict of tensors for several robots.

        Begins an episode, as `reset` does, in each chosen env that has none.

        Args:
            env_idx: the envs to plan for, one after the other; None for all. The other envs hold still.

        Raises:
            NotAlike: the task builds different bodies in each env, so that no env can stand for another.
            IndexError: there is no such env.
            Exception: raised by the author's task in a step of a rollout.
        """
        chosen = list(range(self._live.num_envs)) if env_idx is None else env_idx
        return actions.to_env_action(self._live, self._parts, self.flat_actions(chosen))

    def flat_actions(self, env_idx: Sequence[int] | int) -> NDArray[np.float32]:
        """Next actions as in `actions`, as one array (N, A) with the robots' dimensions concatenated."""
        chosen = self._chosen(env_idx)
        self.reset([env for env in chosen if env not in self._taken])
        flat = actions.hold_action(self._parts, self._live.num_envs)
        due = [env for env in chosen if env not in self.plans or self._taken[env] >= self.options.every]
        for env in due:
            self.require_alike(env)
        if due:
            snapshot = take_snapshot(self._live, due)
            for env in due:
                self.plans[env], self._taken[env] = self._rollouts.plan(snapshot, env), 0
        for env in chosen:
            flat[env] = self.plans[env].actions[self._taken[env]]
            self._taken[env] += 1
        return flat

    def require_alike(self, env: int) -> None:
        """Raise NotAlike if the rollouts' envs are built differently from this env; see `RolloutPlanner.require_alike`."""
        self._rollouts.require_alike(self._live, env)

    def close(self) -> None:
        """Close the envs of the rollouts, but not the env that is planned for."""
        self._rollouts.close()

    def _chosen(self, env_idx: Sequence[int] | int | None) -> list[int]:
        if env_idx is None:
            return list(range(self._live.num_envs))
        return envs_of_batch(env_idx, self._live.num_envs) if np.size(env_idx) else []

"""Strict mode: what would go wrong on the GPU goes wrong here, with a sentence that says so.

The batched CPU core runs a task through the code that the GPU runs, so most mistakes that the GPU does not
forgive stop here too. The rest are silent: a write that the next fetch takes back, a neighbour's episode
changed by a partial reset, a reward of shape (). In strict mode they raise `BrokenRule`:

* state set and not applied, applied or read without a fetch after a step, links read before their
  articulation's new qpos reached them (`strict_system`, at the line that wrote or read);
* SAPIEN's own setters, which the GPU does not look at (`behind_tensors`, at the line that called);
* in a partial reset: state of other envs written, the simulation stepped, a tensor that the task keeps on
  itself left with the rows of the reset envs only (here, at the line where it is known, else at the hook);
* returns of ``evaluate``, the reward and the observation hooks without a row for each env (`returns`).

What the GPU refuses in any case (a pose of another batch size, a static actor moved, two applies without a
fetch, state touched while the scene is loaded) is refused in every mode, see `struct_access`.

Only what goes wrong is refused, by comparing values: ManiSkill's own tasks hear nothing, but for five that
break a rule (``tests/core/test_strict.py`` lists them). ``strict="warn"`` makes every broken rule a
`RuleWarning` with its place, once, for a task that is not the reader's to mend.

It costs about 0.3 ms a control step, whatever the number of envs: of PickCube-v1 with state observations
5 per cent at 16 envs (6.4 ms without) and 1 to 2 per cent at 64 (20.7 ms), on two cores.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from workbench.core.behind_tensors import guard_scenes
from workbench.core.broken_rule import BrokenRule, RuleWarning, place_of_hook
from workbench.core.returns import wrong_evaluate, wrong_observation, wrong_reward
from workbench.core.strict_system import StrictCpuSystem

__all__ = ["BrokenRule", "RuleWarning", "StrictMixin", "WrongReturn"]


class WrongReturn(BrokenRule):
    """What a hook returned is not what ManiSkill takes it for: `hook` is its name, `said` the failing."""

    def __init__(self, said: str, hook: str, place: str) -> None:
        super().__init__(f"{hook}() {said}{place}")
        self.said, self.hook = said, hook


_REWARD_HOOK = {
    "dense": "compute_dense_reward",
    "normalized_dense": "compute_normalized_dense_reward",
    "sparse": "compute_sparse_reward",
}


class StrictMixin:
    """Goes in front of a batched task class; see the module's text."""

    num_envs: int
    scene: Any
    _workbench_task: type
    _system_class = StrictCpuSystem
    _strict_only_warns = False

    def _setup_scene(self) -> None:
        super()._setup_scene()  # type: ignore[misc]
        self._strict_system.only_warn = self._strict_only_warns
        guard_scenes(self._strict_system)

    @property
    def _strict_system(self) -> StrictCpuSystem:
        return self.scene.px

    # --- partial resets ------------------------------------------------------------------------------

    def _clear_sim_state(self) -> None:
        reset = self.scene._reset_mask
        if not bool(reset.all()):
            self._strict_system.refuse_standing_writes(reset)
        super()._clear_sim_state()  # type: ignore[misc]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict[str, Any]) -> None:
        system, reset = self._strict_system, self.scene._reset_mask.clone()
        if bool(reset.all()):
            return super()._initialize_episode(env_idx, options)  # type: ignore[misc]
        state, kept = system.copy_of_state(), self._own_tensors()
        system.being_reset, system.stepped_in_reset = reset, False
        try:
            super()._initialize_episode(env_idx, options)  # type: ignore[misc]
        finally:
            system.being_reset = None
        system.refuse_changes_elsewhere(state, reset)
        self._refuse_replaced_tensors(kept, reset)

    def _own_tensors(self) -> dict[str, torch.Tensor]:
        """Copies of the tensors that the task keeps on itself with a row for each env."""
        return {
            name: value.clone()
            for name, value in vars(self).items()
            if isinstance(value, torch.Tensor) and value.ndim > 0 and len(value) == self.num_envs
        }

    def _refuse_replaced_tensors(self, before: Mapping[str, torch.Tensor], reset: torch.Tensor) -> None:
        count = int(reset.sum())
        for name, old in before.items():
            now = vars(self).get(name)
            if not isinstance(now, torch.Tensor) or now.shape == old.shape:
                continue
            if now.shape == (count, *old.shape[1:]):
                self._strict_system.break_rule(
                    f"_initialize_episode left self.{name} with a row for each of the {count} envs that were "
                    f"reset, where it had one for each of {self.num_envs}: write self.{name}[env_idx] = ... "
                    f"instead of replacing it{place_of_hook(self._workbench_task, '_initialize_episode')}.",
                    None,
                )

    # --- returns -------------------------------------------------------------------------------------

    def evaluate(self) -> dict[str, Any]:
        evaluated = super().evaluate()  # type: ignore[misc]
        self._refuse_return(wrong_evaluate(evaluated, self.num_envs), "evaluate")
        return evaluated

    def get_reward(self, obs: Any, action: torch.Tensor, info: dict[str, Any]) -> torch.Tensor:
        reward = super().get_reward(obs=obs, action=action, info=info)  # type: ignore[misc]
        hook = _REWARD_HOOK.get(self.reward_mode)  # type: ignore[attr-defined]
        if hook is not None:
            self._refuse_return(wrong_reward(reward, self.num_envs, info), hook)
        return reward

    def _get_obs_extra(self, info: dict[str, Any]) -> Any:
        obs = super()._get_obs_extra(info)  # type: ignore[misc]
        self._refuse_return(wrong_observation(obs, self.num_envs), "_get_obs_extra")
        return obs

    def _get_obs_agent(self) -> Any:
        obs = super()._get_obs_agent()  # type: ignore[misc]
        self._refuse_return(wrong_observation(obs, self.num_envs), "_get_obs_agent")
        return obs

    def _refuse_return(self, said: str | None, hook: str) -> None:
        if said is None:
            return
        place = place_of_hook(self._workbench_task, hook)
        if self._strict_only_warns:
            self._strict_system.break_rule(f"{hook}() {said}{place}", None)
        else:
            raise WrongReturn(said, hook, place)

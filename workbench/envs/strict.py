"""Checks the rules of GPU simulation while a task runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import torch
from mani_skill.envs.sapien_env import BaseEnv

from workbench.envs.broken_rule import (
    BrokenRule,
    BrokenRules,
    WrongReturn,
    find_entry,
    in_brackets,
    place_of_class,
    place_of_hook,
    place_of_return,
    warn_of,
)
from workbench.envs.error_notes import CoreRefusal, ErrorNote
from workbench.envs.evaluate_entries import (
    without_rows,
    wrong_evaluate,
    wrong_flags,
    wrong_observation,
    wrong_reward,
)
from workbench.envs.gpu_rules import Degree, Finding, degrees_of
from workbench.envs.kept_rows import ResetWatch
from workbench.envs.partial_reset import TARGET_FLAGS, untouched_envs, without_target_flags
from workbench.envs.simulation.strict_system import StrictCpuSystem

_REWARD_HOOK = {
    "dense": "compute_dense_reward",
    "normalized_dense": "compute_normalized_dense_reward",
    "sparse": "compute_sparse_reward",
}


class StrictMixin:
    """Mixin that checks the rules of GPU simulation; the first base of a batched task class.

    The batched CPU core does what a stock CPU env does. If a GPU would behave differently, this mixin reports
    the author's line. It reports:

    * state set but not applied; state applied or read without a fetch after a step; links read before their
      articulation's new qpos reached them (`strict_system`);
    * what the GPU refuses: state read or set during the build of the scene, static actors moved, masses set
      after the build (`accessors`);
    * SAPIEN's own setters, which the GPU ignores (`accessors`);
    * in a partial reset: state of other envs written, the simulation stepped, and rows of other envs lost or
      changed (this module and `kept_rows`);
    * return values of ``evaluate``, the reward and the observation hooks that lack a row for each env
      (`evaluate_entries`).

    Values are compared, so only actual differences are reported. ``tests/envs/test_strict.py`` lists the
    ManiSkill tasks that break a rule.
    """

    num_envs: int
    scene: Any
    _workbench_task: type[BaseEnv]
    _system_class = StrictCpuSystem
    _rule_choice: Degree | None = None
    """The degree of all rules; None if each rule has its own degree."""
    _on_finding: Callable[[Finding], None] = staticmethod(warn_of)
    _wrong_obs: tuple[str, str] | None = None
    """Hook and problem of the observation that is being assembled."""

    @cached_property
    def broken_rules(self) -> BrokenRules:
        """Breaches so far. The object belongs to the env: it stays when the env gets a new scene or class."""
        return BrokenRules(degrees_of(self._rule_choice), self._on_finding)

    def _make_scene(self) -> None:
        super()._make_scene()  # type: ignore[misc]
        self._strict_system.rules = self.broken_rules

    @property
    def _strict_system(self) -> StrictCpuSystem:
        return self.scene.px

    def step(self, action: Any) -> Any:
        with self.broken_rules.during("step"):
            stepped = super().step(action)  # type: ignore[misc]
        self.broken_rules.step += 1
        return stepped

    def _step_action(self, action: Any) -> Any:
        for controller in without_target_flags(self):
            cls = type(controller)
            self.broken_rules.report_breach(
                "controller-targets",
                f"{cls.__name__} lacks {' and '.join(flag for flag in TARGET_FLAGS if not hasattr(controller, flag))}: "
                "on the GPU each step raises AttributeError. Give the class both attributes.",
                frames=None,
                place=place_of_class(cls),
                subject=cls,
            )
        return super()._step_action(action)  # type: ignore[misc]

    # --- partial resets ------------------------------------------------------------------------------

    def reset(self, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        untouched, watch = untouched_envs(self, options), self._watch
        partial = bool(untouched)
        with self.broken_rules.during("reset", confirms=partial or self.num_envs == 1):
            watch.whole = partial and self._workbench_task.reset is not BaseEnv.reset
            try:
                if watch.whole:
                    chosen = sorted(set(range(self.num_envs)).difference(untouched))
                    watch.start(self, self._workbench_task, chosen)  # type: ignore[arg-type]
                made = super().reset(seed=seed, options=options)  # type: ignore[misc]
                watch.report()
                return made
            finally:
                watch.stop()
                watch.whole = False

    @cached_property
    def _watch(self) -> ResetWatch:
        return ResetWatch(self.broken_rules)

    def _clear_sim_state(self) -> None:
        reset = self.scene._reset_mask
        if not bool(reset.all()):
            self._strict_system.refuse_unapplied_writes(reset)
        super()._clear_sim_state()  # type: ignore[misc]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict[str, Any]) -> None:
        system, reset = self._strict_system, self.scene._reset_mask.clone()
        if bool(reset.all()):
            return super()._initialize_episode(env_idx, options)  # type: ignore[misc]
        state = system.copy_of_state()
        system.being_reset = reset
        system.reported_elsewhere.clear()
        system.hook_of_reset = place_of_hook(self._workbench_task, "_initialize_episode")
        watch = self._watch
        if not watch.looks:
            watch.start(self, self._workbench_task, torch.nonzero(reset)[:, 0].tolist())  # type: ignore[arg-type]
        try:
            super()._initialize_episode(env_idx, options)  # type: ignore[misc]
            system.being_reset = None
            system.refuse_changes_elsewhere(state, reset)
            watch.report(over=not watch.whole)
        finally:
            system.being_reset = None
            watch.stop()

    # --- returns -------------------------------------------------------------------------------------

    def evaluate(self) -> dict[str, Any]:
        evaluated = super().evaluate()  # type: ignore[misc]
        self._returned("evaluate-rows", "evaluate", wrong_evaluate(evaluated, self.num_envs))
        self._returned("evaluate-flags", "evaluate", wrong_flags(evaluated))
        return evaluated

    def get_reward(self, obs: Any, action: torch.Tensor, info: dict[str, Any]) -> torch.Tensor:
        with self._noting_rows(info, obs):
            reward = super().get_reward(obs=obs, action=action, info=info)  # type: ignore[misc]
        hook = _REWARD_HOOK.get(self.reward_mode)  # type: ignore[attr-defined]
        if hook is not None:
            self._returned("reward-rows", hook, wrong_reward(reward, self.num_envs, info))
        return reward

    def _get_obs_extra(self, info: dict[str, Any]) -> Any:
        obs = super()._get_obs_extra(info)  # type: ignore[misc]
        self._observed("_get_obs_extra", obs)
        return obs

    def _get_obs_agent(self) -> Any:
        obs = super()._get_obs_agent()  # type: ignore[misc]
        self._observed("_get_obs_agent", obs)
        return obs

    def get_obs(self, info: Any = None, *args: Any, **kwargs: Any) -> Any:
        self._wrong_obs = None
        try:
            with self._noting_rows(info):
                obs = super().get_obs(info, *args, **kwargs)  # type: ignore[misc]
        except Exception as error:
            if self._wrong_obs is None or isinstance(error, BrokenRule):
                raise
            # ManiSkill fails with "Sizes of tensors must match": the rule's message is clearer.
            hook, problem = self._wrong_obs  # type: ignore[misc]
            place = place_of_return(self._workbench_task, hook)
            raise WrongReturn(problem, hook, "observation-rows", place) from error
        finally:
            self._wrong_obs = None
        if self._watch.whole and not self._watch.looks:
            # `evaluate` may store values for all envs, which is not a mistake: compare only later changes.
            self._watch.go_on(self)  # type: ignore[arg-type]
        return obs

    @contextmanager
    def _noting_rows(self, info: Any, obs: Any = None) -> Iterator[None]:
        """If a hook raises, add notes to the error: the entries of ``evaluate`` and ``_get_obs_extra``
        without a row per env."""
        try:
            yield
        except CoreRefusal:
            raise
        except (
            RuntimeError,
            ValueError,
            TypeError,
            IndexError,
        ) as error:  # what torch and numpy raise if shapes do not fit
            extra = obs.get("extra") if isinstance(obs, Mapping) else None
            for hook, returned in (("evaluate", info), ("_get_obs_extra", extra)):
                for name, what in (
                    without_rows(returned, self.num_envs) if isinstance(returned, Mapping) else ()
                ):
                    place = find_entry(self._workbench_task, hook, name.rpartition("/")[2])
                    error.add_note(
                        ErrorNote(
                            f"{hook}() returned {name!r} as a {what}, for {self.num_envs} envs{in_brackets(place)}."
                        )
                    )
            raise

    def _observed(self, hook: str, obs: Any) -> None:
        problem = wrong_observation(obs, self.num_envs)
        if problem is not None:
            self._wrong_obs = hook, problem
            self._returned("observation-rows", hook, problem)

    def _returned(self, rule: str, hook: str, problem: str | None) -> None:
        if problem is not None:
            self.broken_rules.returned(rule, hook, problem, place_of_return(self._workbench_task, hook))

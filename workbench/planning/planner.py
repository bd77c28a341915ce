"""Plans actions for an env by rollouts of the same task from its present state."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from mani_skill.agents.controllers.pd_joint_pos import PDJointPosController
from numpy.typing import NDArray

from workbench.core.env import actions
from workbench.core.env.task_env import TaskEnv
from workbench.core.snapshots.rng import read_shared_rng, write_shared_rng
from workbench.core.snapshots.snapshot import Snapshot, restore_snapshot
from workbench.planning.sampling import PlanOptions, Sampler


@dataclass(frozen=True)
class Plan:
    """What was found for one env, and what all its rollouts earned."""

    actions: NDArray[np.float32]
    """(H, A) flat actions, the next one first."""
    rewards: NDArray[np.float32]
    """(K, H) of all rollouts of the last round; 0 after a fail."""
    best: int
    """The rollout that earned most."""
    success_at: NDArray[np.int32]
    """(K,) the step at which each rollout succeeded, from 1 on; 0 if it did not."""
    seconds: float


class Planner:
    """Plans for any env of a task, one after the other, on a batch of K envs of the same task.

    The author's reward decides, unchanged: a rollout is worth the sum of its rewards over the horizon, up to a fail.
    The envs keep their own state, so a rollout is a restored snapshot and control steps.
    """

    def __init__(self, task: TaskEnv, options: PlanOptions, exact: bool = True) -> None:
        """
        Args:
            task: K envs of the task, used by this alone.
            exact: restore exactly, so that the same snapshot, options and seed give the same plan to the last bit.
        """
        if task.num_envs != options.rollouts:
            raise ValueError(f"{options.rollouts} rollouts need as many envs, not {task.num_envs}")
        self._task, self._options, self._exact = task, options, exact
        self._steps = options.steps(task.control_dt)
        self._samplers: dict[int, tuple[Sampler, int]] = {}
        low, high = actions.bounds(task.parts)
        bounded = np.isfinite(low) & np.isfinite(high)
        self._low = torch.from_numpy(np.where(bounded, low, -1.0).astype(np.float32))
        self._high = torch.from_numpy(np.where(bounded, high, 1.0).astype(np.float32))
        self._switches = torch.tensor([_switches(p) for p in task.parts for _ in p.names], dtype=torch.bool)
        self._scale = torch.tensor(
            [_noise_scale(p, i) for p in task.parts for i in range(len(p.names))], dtype=torch.float32
        )

    def begin(self, env: int, seed: int) -> None:
        """Begin an episode in this env: forget its plan."""
        sampler = Sampler(self._options, self._steps, self._switches, self._scale, seed)
        self._samplers[env] = (sampler, seed)

    def plan(self, snapshot: Snapshot, env: int) -> Plan:
        """Plan from the state of this env in the snapshot, going on from its last plan."""
        began = time.perf_counter()
        sampler, seed = self._samplers[env]
        device = self._task.env.device
        shared = read_shared_rng(device)
        rewards, succeeded = torch.zeros(0), torch.zeros(0)
        try:
            for _ in range(self._options.rounds):
                self._restore(snapshot, env)
                # What a task draws in a step is drawn in the same way for the same plan.
                torch.manual_seed(seed)
                knots = sampler.candidates(self._hold())
                rewards, succeeded = self._roll_out(self._from_unit(sampler.sequences(knots)))
                sampler.improve(knots, rewards.sum(1))
        finally:
            write_shared_rng(shared, device)
        sequence = self._from_unit(sampler.sequences(sampler.plan[None]))[0]
        plan = Plan(
            sequence.numpy(),
            rewards.numpy(),
            int(rewards.sum(1).nan_to_num(-torch.inf).argmax()),
            succeeded.numpy(),
            time.perf_counter() - began,
        )
        sampler.shift(self._options.every)
        return plan

    def _restore(self, snapshot: Snapshot, env: int) -> None:
        every = range(self._task.num_envs)
        restore_snapshot(self._task.env, snapshot, every, source=env, fresh_physics=self._exact)

    def _hold(self) -> torch.Tensor:
        return self._to_unit(torch.from_numpy(actions.hold_action(self._task.parts, self._task.num_envs)[0]))

    def _to_unit(self, action: torch.Tensor) -> torch.Tensor:
        return (2 * action - self._high - self._low) / (self._high - self._low)

    def _from_unit(self, action: torch.Tensor) -> torch.Tensor:
        return self._low + (action + 1) / 2 * (self._high - self._low)

    def _roll_out(self, sequences: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(K, H) rewards and (K,) the step of success, of actions (K, H, A) from the present state."""
        task = self._task
        rewards = torch.zeros(sequences.shape[:2])
        alive = torch.ones(len(sequences), dtype=torch.bool)
        succeeded = torch.zeros(len(sequences), dtype=torch.int32)
        for h in range(sequences.shape[1]):
            action = actions.to_env_action(task.env, task.parts, sequences[:, h].numpy())
            _, reward, _, _, info = task.env.step(action)
            rewards[:, h] = torch.where(alive, torch.as_tensor(reward).float().cpu(), 0.0)
            if (success := info.get("success")) is not None:
                now = torch.as_tensor(success).bool().cpu() & alive & (succeeded == 0)
                succeeded[now] = h + 1
            if (fail := info.get("fail")) is not None:
                alive &= ~torch.as_tensor(fail).bool().cpu()
        return rewards, succeeded


def _switches(part: actions.ActionPart) -> bool:
    """Whether a controller is a gripper's: what is between open and closed is of no use to it."""
    controller: Any = part.controller
    return isinstance(controller, PDJointPosController) and type(controller).__name__.startswith("PDJointPosMimic")


def _noise_scale(part: actions.ActionPart, i: int) -> float:
    """Factor on the noise of a dimension: absolute joint positions range over the whole joint, which no plan crosses."""
    controller: Any = part.controller
    absolute = isinstance(controller, PDJointPosController) and not getattr(controller.config, "use_delta", False)
    return 0.2 if absolute and not _switches(part) else 1.0

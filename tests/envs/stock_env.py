"""Tasks without a robot, and ManiSkill's own single CPU env as the reference for one env of a batch."""

# ManiSkill annotates an env's members as the widest thing they may be in any task.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv

from workbench.envs.cpu_scene import batched_class

STATE_ONLY = {"obs_mode": "none", "reward_mode": "none", "render_backend": "none"}


class Bare(BaseEnv):
    """A task without a robot. Env i of a batch is built like the single env with ``first_env=i``."""

    SUPPORTED_ROBOTS = ["none"]

    def __init__(self, *args: Any, first_env: int = 0, **kwargs: Any) -> None:
        self.first_env = first_env
        super().__init__(*args, robot_uids="none", **kwargs)

    def env_numbers(self) -> list[int]:
        """Return the batch index of each of this env's sub-envs."""
        return list(range(self.first_env, self.first_env + self.num_envs))

    def get_state_dict(self) -> Any:
        # BaseEnv's version reads the agent's state; this task has no agent.
        return self.scene.get_sim_state()

    def _get_obs_agent(self) -> dict:
        return {}

    def apply(self) -> None:
        """Apply and fetch, as the GPU requires after state is set outside `_initialize_episode`."""
        if self.scene.gpu_sim_enabled:
            self.scene._gpu_apply_all()
            self.scene.px.gpu_update_articulation_kinematics()
            self.scene._gpu_fetch_all()


def batch_of(task: type[BaseEnv], num_envs: int, **kwargs: Any) -> Any:
    return batched_class(task)(num_envs=num_envs, **{**STATE_ONLY, **kwargs})


def single(task: type[BaseEnv], **kwargs: Any) -> Any:
    """Return ManiSkill's own single CPU env of `task`."""
    return task(num_envs=1, sim_backend="physx_cpu", **{**STATE_ONLY, **kwargs})


def put_in_same_state(stock: Any, batch: Any, env: int) -> None:
    """Copy the state of the batch's env `env` into the stock env, bit for bit.

    Both sides unpack the same state, since unpacking may round (PhysX stores a root pose at the centre of mass).
    """
    state = batch.scene.px.systems[env].pack()
    for system in (batch.scene.px.systems[env], stock.scene.px):
        system.unpack(state)
    batch.scene.px.note_change()
    batch.scene._gpu_fetch_all()
    for side in (stock, batch):
        if side.agent is not None:
            several = side.agent.controller
            for controller in several.values() if isinstance(several, dict) else [several]:
                controller.reset()


def follow(
    task: type[Bare],
    num_envs: int = 3,
    steps: int = 30,
    look: Callable[[Any], dict[str, torch.Tensor]] | None = None,
    **kwargs: Any,
) -> Any:
    """Run `task` as a batch and as stock single envs, and compare each env after every step.

    Args:
        look: returns the tensors, each (N, ...), that must be equal to the last bit. By default the packed
            physics state is compared.

    Returns:
        the batch, for further checks.
    """
    batch = batch_of(task, num_envs, **kwargs)
    stocks = [single(task, first_env=env, **kwargs) for env in range(num_envs)]
    seeds = list(range(num_envs))
    batch.reset(seed=seeds)
    for env, stock in enumerate(stocks):
        stock.reset(seed=seeds[env])
        put_in_same_state(stock, batch, env)
    for step in range(steps):
        batch.step(None)
        for env, stock in enumerate(stocks):
            stock.step(None)
            if look is None:
                assert batch.scene.px.systems[env].pack() == stock.scene.px.pack(), f"env {env}, step {step}"
                continue
            ours, theirs = look(batch), look(stock)
            assert ours.keys() == theirs.keys()
            for name, value in theirs.items():
                got, want = ours[name][env].numpy(), value[0].numpy()
                assert np.array_equal(got[..., : want.shape[-1]] if want.ndim else got, want), (
                    f"{name} of env {env} at step {step}: {got}, stock {want}"
                )
    for stock in stocks:
        stock.close()
    return batch

"""The private names of ManiSkill 3.0.1 that the core leans on, all of them, in one place.

ManiSkill's structs ask a body for ``gpu_pose_index`` and an articulation for ``gpu_index``; bodies of
a CPU system raise on both. The structs are made deep inside ManiSkill's builders, so the four cached
properties that ask are replaced, once a process, by ones that ask our system when (and only when) the
struct belongs to a batched CPU scene. A stock scene in the same process gets the original code.

``tests/core/test_seams.py`` names every attribute used here, so that an upgrade fails loudly there
and not in the middle of an author's task.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG
from mani_skill.utils.structs.articulation import Articulation
from mani_skill.utils.structs.articulation_joint import ArticulationJoint
from mani_skill.utils.structs.base import PhysxRigidBodyComponentStruct
from mani_skill.utils.structs.link import Link

from workbench.core.cpu_system import BatchedCpuSystem

_installed = False


def batched_system(scene: Any) -> BatchedCpuSystem | None:
    """The batched CPU system of a ManiSkillScene, or None for any other scene.

    Not isinstance: `BatchedCpuSystem` answers that question as a ``PhysxGpuSystem`` would.
    """
    return scene.px if type(scene.px) is BatchedCpuSystem else None


def install_index_seams() -> None:
    """Let ManiSkill's structs find their rows in a batched CPU system. Safe to call again."""
    global _installed
    if _installed:
        return
    stock_body_index = PhysxRigidBodyComponentStruct.__dict__["_body_data_index"].func
    stock_body_data = PhysxRigidBodyComponentStruct.__dict__["_body_data"].fget
    stock_articulation_index = Articulation.__dict__["_data_index"].func
    stock_joint_index = ArticulationJoint.__dict__["_data_index"].func

    def body_index(self: Any) -> torch.Tensor:
        system = batched_system(self.scene)
        if system is None:
            return stock_body_index(self)
        return torch.tensor([system.row_of(body) for body in self._bodies], device=self.device)

    def link_data(self: Any) -> torch.Tensor:
        # Only velocities are read this way (`Link.pose` reads the system's tensor itself), and the
        # root's are fetched with every step: a root alone must not pay for all links.
        system = batched_system(self.scene)
        if system is not None and not self.is_root.all():
            system.fetch_link_velocities()
        return stock_body_data(self)

    def articulation_index(self: Any) -> torch.Tensor:
        system = batched_system(self.scene)
        if system is None:
            return stock_articulation_index(self)
        indices = [system.index_of(articulation) for articulation in self._objs]
        return torch.tensor(indices, device=self.device, dtype=torch.int32)

    def joint_index(self: Any) -> torch.Tensor:
        system = batched_system(self.scene)
        if system is None:
            return stock_joint_index(self)
        indices = [system.index_of(articulation) for articulation in self._physx_articulations]
        return torch.tensor(indices, device=self.device, dtype=torch.int32)

    _replace(PhysxRigidBodyComponentStruct, "_body_data_index", cached_property(body_index))
    _replace(Articulation, "_data_index", cached_property(articulation_index))
    _replace(ArticulationJoint, "_data_index", cached_property(joint_index))
    Link._body_data = property(link_data)  # type: ignore[method-assign,assignment]
    _installed = True


def _replace(owner: type, name: str, value: cached_property) -> None:
    # A cached_property assigned after the class body has no name, and raises when it is first read.
    value.__set_name__(owner, name)
    setattr(owner, name, value)


def episode_seeds(env: BaseEnv) -> np.ndarray | None:
    """(N,) the seeds that the envs were last reset with; None before the first reset."""
    return env._episode_seed


def set_episode_seeds(env: BaseEnv, env_idx: list[int], seeds: list[int]) -> None:
    """Seed the numpy randomness of some envs, and leave the others' as it is.

    ``BaseEnv.reset(seed=[...], options={"env_idx": ...})`` takes the list for all envs: the seeds of a
    subset would replace, and shorten, the seeds of the whole batch.
    """
    every = np.array(env._episode_seed, dtype=np.int64)
    every[env_idx] = seeds
    env._episode_seed = every
    env._batched_episode_rng[env_idx] = BatchedRNG.from_seeds(seeds, backend=env._batched_rng_backend)
    env._episode_rng = env._batched_episode_rng[0]

"""The batched CPU system has every member of SAPIEN's GPU system, or refuses it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import sapien.physx as physx
import torch

from tests.envs.collision import Collision
from tests.envs.stock_env import batch_of
from workbench.envs.broken_rule import NeedsOneEnv

MEMBERS = sorted(name for name in dir(physx.PhysxGpuSystem) if not name.startswith("_"))
REFUSED = {"device", "gpu_set_cuda_stream", "set_scene_offset"}
"""Members that ManiSkill never uses and that no CPU system has."""


@pytest.fixture(scope="module")
def px() -> Iterator[Any]:
    env = batch_of(Collision, 3)
    env.reset(seed=[0, 1, 2])
    yield env.scene.px
    env.close()


def test_every_member_of_the_gpu_system_exists_or_is_refused(px: Any) -> None:
    for name in MEMBERS:
        if name in REFUSED:
            with pytest.raises(NotImplementedError, match=name):
                getattr(px, name)
        else:
            getattr(px, name)
    assert not hasattr(px, "gpu_fetch_everything")
    for name in ("get_contacts", "pack", "raycast", "unpack"):
        with pytest.raises(NeedsOneEnv):
            getattr(px, name)
    applies = [
        name for name in MEMBERS if name.startswith("gpu_apply_") and not name.endswith(("force", "torque"))
    ]
    for name in applies:
        getattr(px, name)(px.cuda_rigid_body_data)  # requires an index buffer
        for fetch in (member for member in MEMBERS if member.startswith("gpu_fetch_")):
            getattr(px, fetch)()
        getattr(px, name)()


def test_members_of_the_whole_batch_cover_all_envs(px: Any) -> None:
    px.timestep = 0.005
    assert [system.timestep for system in px.systems] == pytest.approx([0.005] * 3)
    px.timestep = 0.01
    assert px.timestep == px.systems[2].timestep == pytest.approx(0.01)
    assert len(px.rigid_dynamic_components) == 2 * 3
    assert len(px.rigid_static_components) == 1 * 3
    assert len(px.articulation_link_components) == 3 * 3
    assert px.cuda_rigid_dynamic_force.shape == px.cuda_rigid_body_force.shape


@pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")
def test_a_batch_of_one_env_has_the_members_of_its_cpu_system() -> None:
    env = batch_of(Collision, 1)
    env.reset(seed=[0])
    one = env.scene.px
    before = env.a.pose.raw_pose.clone()
    state = one.pack()
    for _ in range(5):
        one.step()
    assert len(one.get_contacts()) == len(one.systems[0].get_contacts()) > 0
    one.unpack(state)
    assert torch.equal(env.a.pose.raw_pose, before), "tensors must show the restored state"
    assert one.raycast([0, 0, 2], [0, 0, -1], 10) is not None
    env.close()


def test_step_start_and_finish_are_one_substep(px: Any) -> None:
    before = [system.pack() for system in px.systems]
    px.step_start()
    px.step_finish()
    stepped = [system.pack() for system in px.systems]
    for system, state in zip(px.systems, before):
        system.unpack(state)
    px.note_change()
    px.step()
    assert [system.pack() for system in px.systems] == stepped != before

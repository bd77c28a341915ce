"""Actors and articulations, as the tutorials build them, batched on the CPU and against stock single envs."""

# ManiSkill annotates an env's members as the widest thing they may be, and vectors as tuples.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalIterable=false

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.utils.structs.pose import Pose

from tests.envs.by_hand import BOX, box, by_hand
from tests.envs.stock_env import Bare, follow


class Table(Bare):
    """A static slab, a kinematic pusher that moves on every control step, and the box that it pushes."""

    def _load_scene(self, options: dict) -> None:
        p = torch.tensor([[0.03 * i, 0.02 * i, 0.2 + 0.01 * i] for i in self.env_numbers()])
        self.box = box(self, "box", pose=Pose.create_from_pq(p))
        self.slab = box(self, "slab", [1, 1, 0.1], sapien.Pose([0, 0, -0.1]), "static")
        self.pusher = box(self, "pusher", BOX, sapien.Pose([-0.13, 0, 0.06]), "kinematic")

    def _before_control_step(self) -> None:
        pose = self.pusher.pose.raw_pose.clone()
        pose[:, 0] += 0.02
        self.pusher.set_pose(Pose.create(pose))
        self.apply()


def test_dynamic_kinematic_and_static_actors_move_as_in_a_stock_env() -> None:
    def look(env: Any) -> dict[str, torch.Tensor]:
        return {
            "box": env.box.pose.raw_pose,
            "velocity": env.box.linear_velocity,
            "spin": env.box.angular_velocity,
            "is_static": env.box.is_static(),
            "pusher": env.pusher.pose.raw_pose,
        }

    env = follow(Table, look=look)
    assert [env.box.px_body_type, env.slab.px_body_type, env.pusher.px_body_type] == [
        "dynamic",
        "static",
        "kinematic",
    ]
    assert bool((env.box.pose.p[:, 0] > 0.3).all()), (
        "the pusher never reached the box, so the test proved nothing"
    )
    assert env.slab.pose.raw_pose.shape[-1] == 7


URDF = """<robot name="lever">
<link name="base"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
<link name="arm"><inertial><mass value="0.5"/><inertia ixx="0.01" iyy="0.02" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0.3 0 0"/><geometry><box size="0.4 0.05 0.05"/></geometry></collision></link>
<link name="tip"><collision><origin xyz="0.1 0 0"/><geometry><sphere radius="0.05"/></geometry></collision></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-1.5" upper="1.5" effort="10" velocity="10"/></joint>
<joint name="slide" type="prismatic"><origin xyz="0.5 0 0"/><parent link="arm"/><child link="tip"/>
<axis xyz="1 0 0"/><limit lower="0" upper="0.2" effort="10" velocity="10"/></joint>
</robot>"""
MJCF = """<mujoco model="pendulum"><worldbody><body name="cart" pos="0 0 1">
<joint name="rail" type="slide" axis="1 0 0" range="-1 1" limited="true" damping="0.1"/>
<geom name="cart" type="box" size="0.1 0.1 0.05" mass="1"/>
<body name="pole"><joint name="hinge" type="hinge" axis="0 1 0" damping="0.01"/>
<geom name="pole" type="capsule" fromto="0 0 0 0.1 0 0.5" size="0.03" mass="0.2"/></body>
</body></worldbody></mujoco>"""


class Swinging(Bare):
    """One articulation, built from `source`, that starts with a velocity and falls."""

    source = "builder"
    folder = Path()

    def _load_scene(self, options: dict) -> None:
        if self.source == "builder":
            self.thing = by_hand(self, 2)
            return
        loader = self.scene.create_urdf_loader() if self.source == "urdf" else self.scene.create_mjcf_loader()
        file = self.folder / f"thing.{self.source}"
        file.write_text(URDF if self.source == "urdf" else MJCF)
        parsed = loader.parse(str(file))
        builder = parsed["articulation_builders"][0]
        builder.initial_pose = sapien.Pose([0, 0, 1])
        self.thing = builder.build("thing", **({"fix_root_link": True} if self.source == "urdf" else {}))

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        qvel = self._batched_episode_rng[env_idx].uniform(0.2, 1.0, (2,))
        self.thing.set_qpos(torch.full((len(env_idx), 2), 0.1))
        self.thing.set_qvel(torch.from_numpy(np.asarray(qvel)).float())


def joints_and_links(env: Any) -> dict[str, torch.Tensor]:
    thing = env.thing
    numbers = {
        "qpos": thing.get_qpos(),
        "qvel": thing.get_qvel(),
        "qacc": thing.qacc,
        "qf": thing.get_qf(),
        "qlimits": thing.get_qlimits(),
        "root": thing.pose.raw_pose,
        "forces": thing.get_link_incoming_joint_forces(),
        "state": thing.get_state(),
    }
    for link in thing.links:
        numbers[f"pose of {link.name}"] = link.pose.raw_pose
        numbers[f"velocity of {link.name}"] = link.linear_velocity
        numbers[f"spin of {link.name}"] = link.angular_velocity
    for name, joint in thing.active_joints_map.items():
        numbers[f"qpos of {name}"] = joint.qpos
        numbers[f"qvel of {name}"] = joint.qvel
    return numbers


@pytest.mark.parametrize("source", ["urdf", "mjcf", "builder"])
def test_articulations_of_every_source_move_as_in_a_stock_env(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Swinging, "source", source)
    monkeypatch.setattr(Swinging, "folder", tmp_path)
    env = follow(Swinging, steps=8, look=joints_and_links)
    assert float(env.thing.get_qpos().std(dim=0).max()) > 1e-3, "all envs moved alike"

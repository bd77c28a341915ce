"""An articulated object that is built in code: pull a drawer open.

An articulation is a tree of links. Each link is built like an actor, and a joint ties it to its parent.
The drawer slides along the x axis of its joint's frame; the frame is turned by half a turn here, so that
a larger `qpos` is a drawer that is further out, towards the robot.

- the root link's joint is "fixed": the cabinet does not move;
- the joint has damping, or the drawer would glide on for ever after a push;
- `qpos` is a batch: (N, 1), since there is one joint. At a reset it is set with b rows;
- a place on a link, as the handle, is the link's pose times the place in the link's frame;
- reward and success read `qpos`: an open drawer counts, however it was opened.

To change: `HALF`, `TRAVEL` and `OPEN`; a door has a "revolute" joint, which turns about the x axis of its
frame, has its limits in radians, and its two poses put that axis at the hinge. Another drawer is another
link on `body` with a joint of its own, and `qpos` gets one more column.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose
from transforms3d.euler import euler2quat

NEAREST = 0.26
"""Least x of the cabinet. From 0.35 on a hand that points down does not reach behind the handle."""
HALF = [0.12, 0.14, 0.1]
"""Half sizes of the cabinet, metres; its walls are 1 cm thick."""
TRAVEL = 0.18
OPEN = 0.12
"""The drawer counts as open from here."""
HANDLE = [-HALF[0] - 0.06, 0, 0]
"""In the frame of the drawer: far enough from the front that a hand fits between them."""
WOOD, FRONT, METAL = [0.5, 0.35, 0.2, 1], [0.75, 0.6, 0.4, 1], [0.25, 0.25, 0.28, 1]


def add_box(link: Any, half_size: list[float], place: list[float], color: list[float]) -> None:
    pose = sapien.Pose(p=place)
    link.add_box_collision(pose, half_size=half_size)
    link.add_box_visual(pose, half_size=half_size, material=sapien.render.RenderMaterial(base_color=color))


@register_env("WorkbenchArticulated-v1", max_episode_steps=100)
class ArticulatedEnv(BaseEnv):
    """Success: the drawer is open by `OPEN`. It begins almost shut."""

    SUPPORTED_ROBOTS = ["panda"]
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")
    agent: Panda

    def __init__(self, *args: Any, robot_uids: str = "panda", **kwargs: Any):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))

    def _load_scene(self, options: dict) -> None:
        build_ground(self.scene)
        builder = self.scene.create_articulation_builder()
        x, y, z = HALF
        body = builder.create_link_builder()  # without a parent: the root
        body.set_name("body")
        body.set_joint_properties("fixed", [], sapien.Pose(), sapien.Pose())
        # A link may have any number of shapes: here walls, bottom, top and back. The front is open.
        for side in (-1, 1):
            add_box(body, [x, 0.005, z], [0, side * (y - 0.005), 0], WOOD)
            add_box(body, [x, y - 0.01, 0.005], [0, 0, side * (z - 0.005)], WOOD)
        add_box(body, [0.005, y - 0.01, z - 0.01], [x - 0.005, 0, 0], WOOD)

        drawer = builder.create_link_builder(body)
        drawer.set_name("drawer")
        drawer.set_joint_name("slide")
        # The joint's frame in the parent and in the child. They are equal, so at `qpos` 0 the frames of both
        # links coincide, and the drawer's boxes are placed in the frame of the body.
        outwards = sapien.Pose(q=euler2quat(0, 0, np.pi))
        drawer.set_joint_properties("prismatic", [[0, TRAVEL]], outwards, outwards, damping=20)
        # A little smaller than the space for it: PhysX pushes apart what overlaps.
        add_box(drawer, [x - 0.02, y - 0.02, 0.005], [-0.01, 0, -z + 0.02], FRONT)
        for side in (-1, 1):
            add_box(drawer, [x - 0.02, 0.005, 0.04], [-0.01, side * (y - 0.02), -z + 0.065], FRONT)
        add_box(drawer, [0.005, y - 0.015, z - 0.015], [-x + 0.005, 0, 0], FRONT)
        add_box(drawer, [0.008, 0.06, 0.008], HANDLE, METAL)
        for side in (-1, 1):
            add_box(drawer, [0.028, 0.006, 0.006], [HANDLE[0] + 0.028, side * 0.05, 0], METAL)

        # The body stands on the ground: an articulation's pose is that of its root's frame.
        builder.initial_pose = sapien.Pose(p=[NEAREST, 0, z])
        self.cabinet = builder.build(name="cabinet", fix_root_link=True)
        self.drawer = self.cabinet.links_map["drawer"]

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[-0.3, 0.6, 0.6], target=[0.1, 0, 0.1])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            rest = torch.tensor(self.agent.keyframes["rest"].qpos, dtype=torch.float32)
            self.agent.reset(rest.repeat(b, 1))
            place = torch.zeros((b, 3))
            place[:, 0] = NEAREST + 0.04 * torch.rand(b)
            place[:, 1] = 0.2 * torch.rand(b) - 0.1
            place[:, 2] = HALF[2]
            self.cabinet.set_pose(Pose.create_from_pq(place))
            # Joints are set, never the pose of a link: physics would not see it.
            self.cabinet.set_qpos(0.02 * torch.rand((b, 1)))
            self.cabinet.set_qvel(torch.zeros((b, 1)))

    @property
    def handle(self) -> torch.Tensor:
        """Where the middle of the handle is: (N, 3)."""
        return (self.drawer.pose * sapien.Pose(p=HANDLE)).p

    def evaluate(self) -> dict[str, torch.Tensor]:
        opened = self.cabinet.qpos[:, 0]
        return {"success": opened > OPEN, "opened": opened}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tcp_pose": self.agent.tcp.pose.raw_pose}
        if self.obs_mode_struct.use_state:
            obs["handle"] = self.handle
            obs["opened"] = info["opened"]
        return obs

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        distance = torch.linalg.norm(self.handle - self.agent.tcp.pose.p, dim=1)
        # Reaching is worth 1 and pulling is worth 1, and both grow all the way: each step can be better.
        reward = 1 - torch.tanh(4 * distance) + (info["opened"] / OPEN).clamp(0, 1)
        return torch.where(info["success"], 3.0, reward)

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info) / 3


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

"""Push a cube along the table into a target: a whole ManiSkill task, to read and to copy.

A task is one class that inherits `BaseEnv`. ManiSkill calls its methods ("hooks") at three times:

    once            _load_agent, _load_scene, the camera properties     what is there
    every reset     _initialize_episode                                 where it is
    every step      evaluate, _get_obs_extra, compute_dense_reward      what it means

Everything that a hook reads or returns is a batch, one row for each environment, also when there
is only one: that is how the same file runs one env on a laptop and thousands on a GPU. Below, N is
the number of environments and b the number of those that are being reset. Lengths are metres, z is
up, z = 0 is the top of the table, quaternions are (w, x, y, z).

    env = gym.make("WorkbenchPushCube-v1", obs_mode="state")     # after importing this file
"""

from __future__ import annotations

from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.robots import Fetch, Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import register_env
from mani_skill.utils.scene_builder.table import TableSceneBuilder
from mani_skill.utils.structs import Pose
from transforms3d.euler import euler2quat

CUBE_HALF_SIZE = 0.02
GOAL_RADIUS = 0.1
GOAL_HEIGHT = 0.001
"""The target lies just above the table: two surfaces at one height flicker in pictures."""
SPAWN_HALF_WIDTH = 0.1
"""The cube starts in a square of twice this width around the origin."""


@register_env("WorkbenchPushCube-v1", max_episode_steps=50)
class PushCubeEnv(BaseEnv):
    """Push the blue cube forward (+x) until its centre is over the red and white target.

    Success: the centre is within `GOAL_RADIUS` of the target's, and the cube lies on the table.
    Fail: the cube has fallen off the table, from where it cannot be pushed back.
    Random at each reset: the cube's place, and the robot's joints by a little noise. The target is
    always the same way ahead of the cube.
    """

    SUPPORTED_ROBOTS = ["panda", "fetch"]
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")
    agent: Panda | Fetch

    def __init__(
        self, *args: Any, robot_uids: str = "panda", robot_init_qpos_noise: float = 0.02, **kwargs: Any
    ):
        """Take the task's own options and hand the rest on.

        `BaseEnv.__init__` builds the scene and resets it, so whatever the hooks need must be set
        before it is called. Every argument here can be given to ``gym.make``.
        """
        self.robot_init_qpos_noise = robot_init_qpos_noise
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    # --- what is there: once -------------------------------------------------------------------

    def _load_agent(self, options: dict) -> None:
        """Build the robot. Runs first when the scene is built.

        The pose is only where it stands until the first reset; it must touch nothing there, or the
        GPU simulation starts with bodies that push each other apart.
        """
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))

    def _load_scene(self, options: dict) -> None:
        """Build everything else. Runs once, for all environments together.

        A builder makes one `Actor` that stands for N bodies. Every builder has an initial pose, and
        no state (poses, velocities) is set here: that is `_initialize_episode`'s.
        """
        self.table_scene = TableSceneBuilder(self, robot_init_qpos_noise=self.robot_init_qpos_noise)
        self.table_scene.build()

        # Dynamic: moved by what touches it. Collision is what physics sees, visual what cameras see.
        builder = self.scene.create_actor_builder()
        builder.add_box_collision(half_size=[CUBE_HALF_SIZE] * 3)
        builder.add_box_visual(
            half_size=[CUBE_HALF_SIZE] * 3,
            material=sapien.render.RenderMaterial(base_color=[0.05, 0.2, 0.75, 1]),
        )
        builder.initial_pose = sapien.Pose(p=[0, 0, CUBE_HALF_SIZE])
        self.cube = builder.build(name="cube")

        # Kinematic: stays where it is put, and can be put elsewhere at a reset. No collision shape:
        # it is a mark on the table. Rings are discs, each smaller and a little higher. A cylinder's
        # axis is its x axis, so its visuals are turned to lie flat.
        builder = self.scene.create_actor_builder()
        for ring in range(5):
            builder.add_cylinder_visual(
                pose=sapien.Pose(q=euler2quat(0, np.pi / 2, 0)),
                radius=GOAL_RADIUS * (5 - ring) / 5,
                half_length=0.0005 + 0.0002 * ring,
                material=sapien.render.RenderMaterial(
                    base_color=[0.75, 0.1, 0.1, 1] if ring % 2 == 0 else [1, 1, 1, 1]
                ),
            )
        builder.initial_pose = sapien.Pose(p=[0.2, 0, GOAL_HEIGHT])
        self.goal = builder.build_kinematic(name="goal")

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        """Cameras whose pictures are observations. Asked for once, after the scene is built.

        Small, because every step of every environment renders them. Over the table it sees cube and
        target wherever they may be, and nothing beyond: depths of a far floor are hard to learn
        from. `fov` is the vertical field of view in radians. A robot may bring cameras of its own.
        """
        pose = sapien_utils.look_at(eye=[0.45, 0, 0.6], target=[0.08, 0, 0])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]

    @property
    def _default_human_render_camera_configs(self) -> list[CameraConfig]:
        """Cameras for people: what ``env.render()`` and recorded videos show. Never observations."""
        pose = sapien_utils.look_at(eye=[0.7, 0.7, 0.6], target=[0.0, 0.0, 0.2])
        return [CameraConfig("render_camera", pose=pose, width=512, height=512, fov=1.0, near=0.01, far=100)]

    # --- where it is: every reset --------------------------------------------------------------

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        """Place everything for a new episode of the b environments `env_idx`, and of no others.

        Setters such as `set_pose` take b rows and reach those environments only. Random numbers
        come from torch, which is seeded for this call: `reset(seed=s)` twice gives the same state.
        """
        with torch.device(self.device):
            b = len(env_idx)
            self.table_scene.initialize(env_idx)

            cube = torch.zeros((b, 3))
            cube[:, :2] = (2 * torch.rand((b, 2)) - 1) * SPAWN_HALF_WIDTH
            cube[:, 2] = CUBE_HALF_SIZE
            self.cube.set_pose(Pose.create_from_pq(p=cube, q=[1, 0, 0, 0]))

            # Ahead of the cube by more than its radius, so that no episode starts in success.
            goal = cube + torch.tensor([GOAL_RADIUS + 0.1, 0, 0])
            goal[:, 2] = GOAL_HEIGHT
            self.goal.set_pose(Pose.create_from_pq(p=goal, q=[1, 0, 0, 0]))

    # --- what it means: every step -------------------------------------------------------------

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Say how each environment stands. Runs at each step and reset, before obs and reward.

        ``success`` and ``fail`` are bool (N,); either of them ends the episode (``terminated``).
        Further entries, of any shape (N, ...), are for observations, rewards, logs and curves:
        here the distance in the plane from the cube to the target's centre, and the height of the
        cube's centre above where it rests.
        """
        distance = torch.linalg.norm(self.cube.pose.p[:, :2] - self.goal.pose.p[:, :2], dim=1)
        height = self.cube.pose.p[:, 2] - CUBE_HALF_SIZE
        return {
            "success": (distance < GOAL_RADIUS) & (height.abs() < 0.005),
            "fail": height < -0.1,
            "cube_to_goal": distance,
            "cube_height": height,
        }

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        """Add what the task knows to the robot's own joint positions and velocities.

        `info` is what `evaluate` returned. Each entry is (N, ...). Where the gripper is and where
        to push to are always told: a real robot has them too. Where the cube is would be cheating
        for a policy that is to see it in pictures, so that needs an observation mode with state.
        """
        obs = {
            "tcp_pose": self.agent.tcp.pose.raw_pose,  # (N, 7); tcp is the point between the fingers
            "goal_pos": self.goal.pose.p,  # (N, 3)
        }
        if self.obs_mode_struct.use_state:
            obs["cube_pose"] = self.cube.pose.raw_pose  # (N, 7)
            obs["tcp_to_cube"] = self.cube.pose.p - self.agent.tcp.pose.p  # (N, 3)
        return obs

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """Tell good from better at every step: (N,), at least 0, and 3 is the most.

        Up to 1 for a gripper that is behind the cube, and, while it is there, up to 1 more for a cube
        that is near the target. Success is 3 whatever else, so that nothing is gained by waiting
        before the goal. Fail is 0. ``info["reward_terms"]`` is left for whoever shows the parts.
        """
        behind_cube = self.cube.pose.p.clone()
        behind_cube[:, 0] -= CUBE_HALF_SIZE + 0.005
        distance = torch.linalg.norm(behind_cube - self.agent.tcp.pose.p, dim=1)
        reach = 1 - torch.tanh(5 * distance)
        push = (1 - torch.tanh(5 * info["cube_to_goal"])) * (distance < 0.03)
        reward = reach + push
        reward[info["success"]] = 3
        reward[info["fail"]] = 0
        # The parts, for people: whoever shows or logs `info` can tell which of them is stuck.
        info["reward_terms"] = {"reach": reach, "push": push, "end": reward - reach - push}
        return reward

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """The same, divided by the most it can be: (N,) in 0..1. What ``env.step`` gives by default."""
        return self.compute_dense_reward(obs, action, info) / 3


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

"""Observations with history: stop a rolling ball, which is seen as where it was at the last steps.

Velocities are left out of the task's observation here; a policy has to read them from the places of
the last steps. Where to keep such a history is easy to get wrong:

- not in `_get_obs_extra`: that is asked for as often as somebody likes, also twice in a step;
- in `_before_control_step`, which runs once a step, before anything moves. On the GPU the places have
  been fetched by then; in `_after_control_step` they have not;
- at a reset only the rows of `env_idx` are filled, with the first place, so no zeros are in it;
- it belongs to the state: without it a restored state gives another observation.
"""

from __future__ import annotations

from typing import Any

import sapien
import torch
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose

RADIUS = 0.035
PAST = 3
"""Steps that are remembered."""


@register_env("WorkbenchObsHistory-v1", max_episode_steps=60)
class ObsHistoryEnv(BaseEnv):
    """Success: the hand is at the ball, and the ball lies still. It rolls slowly from left to right."""

    SUPPORTED_ROBOTS = ["panda"]
    SUPPORTED_REWARD_MODES = ("sparse", "none")
    agent: Panda

    def __init__(self, *args: Any, robot_uids: str = "panda", **kwargs: Any):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))

    def _load_scene(self, options: dict) -> None:
        build_ground(self.scene)
        builder = self.scene.create_actor_builder()
        builder.add_sphere_collision(radius=RADIUS)
        builder.add_sphere_visual(
            radius=RADIUS, material=sapien.render.RenderMaterial(base_color=[0.9, 0.75, 0.1, 1])
        )
        builder.initial_pose = sapien.Pose(p=[0, 0, RADIUS])
        self.ball = builder.build(name="ball")
        self.past = torch.zeros((self.num_envs, PAST, 3), device=self.device)

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.6, 0, 0.6], target=[0, 0, 0])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            rest = torch.tensor(self.agent.keyframes["rest"].qpos, dtype=torch.float32)
            self.agent.reset(rest.repeat(b, 1))
            place = torch.zeros((b, 3))
            place[:, 0] = 0.1 * torch.rand(b)
            place[:, 1] = -0.2
            place[:, 2] = RADIUS
            speed = torch.zeros((b, 3))
            speed[:, 1] = 0.1 + 0.1 * torch.rand(b)
            self.ball.set_pose(Pose.create_from_pq(place))
            self.ball.set_linear_velocity(speed)
            # A ball that rolls to +y turns about -x, once in each of its circumferences.
            turn = torch.zeros((b, 3))
            turn[:, 0] = -speed[:, 1] / RADIUS
            self.ball.set_angular_velocity(turn)
            self.past[env_idx] = place[:, None]

    def _before_control_step(self) -> None:
        self.past = torch.cat([self.past[:, 1:], self.ball.pose.p[:, None]], dim=1)

    def get_state_dict(self) -> dict[str, Any]:
        state: dict[str, Any] = super().get_state_dict()  # type: ignore[assignment]
        state["task"] = {"past": self.past.flatten(1)}
        return state

    def set_state_dict(self, state: dict[str, Any], env_idx: torch.Tensor | None = None) -> None:
        super().set_state_dict(state, env_idx)
        if "task" in state:
            rows = slice(None) if env_idx is None else env_idx
            past = torch.as_tensor(state["task"]["past"], device=self.device)
            self.past[rows] = past.reshape(-1, PAST, 3)

    def evaluate(self) -> dict[str, torch.Tensor]:
        distance = torch.linalg.norm(self.ball.pose.p - self.agent.tcp.pose.p, dim=1)
        speed = torch.linalg.norm(self.ball.linear_velocity, dim=1)
        return {"success": (distance < 0.06) & (speed < 0.01), "distance": distance, "speed": speed}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tcp_pose": self.agent.tcp.pose.raw_pose}
        if self.obs_mode_struct.use_state:
            # Oldest first, the place of now last: (N, (PAST + 1) * 3).
            obs["ball_places"] = torch.cat([self.past, self.ball.pose.p[:, None]], dim=1).flatten(1)
        return obs


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

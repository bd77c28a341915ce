"""Every observation, reward, control and render mode equals ManiSkill's own single CPU env.

Both envs unpack the same state, so results are equal to the last bit and the last pixel unless a test sets a tolerance.
"""

# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportIndexIssue=false, reportOptionalSubscript=false, reportCallIssue=false

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import torch
from mani_skill.agents.robots.panda.panda import Panda
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import common, sapien_utils
from mani_skill.utils.geometry.rotation_conversions import matrix_to_euler_angles, quaternion_to_matrix
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.structs.pose import Pose

import workbench
from tests.drive.render_device import RENDER_BACKEND
from tests.envs import stock_env

pytestmark = pytest.mark.thorough

N, ENV = 2, 1
"""Batch size, and index of the compared env."""
SMALL = {"width": 32, "height": 24}
NO_PICTURES = {"render_backend": "none"}
CAMERA_TOLERANCE = 2e-7
"""Absolute, for camera matrices: stock reads them from SAPIEN, the batch multiplies poses (max 1.2e-7 measured)."""


def pair(task: Any = PickCubeEnv, num_envs: int = N, **kwargs: Any) -> tuple[Any, Any]:
    """Return the task as a batch and as ManiSkill's single env, unwrapped."""
    if kwargs.get("render_backend") != "none":
        kwargs["render_backend"] = RENDER_BACKEND
    cls = REGISTERED_ENVS[task].cls if isinstance(task, str) else task
    batch = workbench.make(task, num_envs, backend="cpu", **deepcopy(kwargs)).unwrapped
    stock = cls(sim_backend="physx_cpu", **deepcopy(kwargs))
    return batch, stock


def put_in_same_state(batch: Any, stock: Any, env: int = ENV, seed: int = 0) -> None:
    batch.reset(seed=[seed + i for i in range(batch.num_envs)])
    stock.reset(seed=seed + env)
    for each in (batch, stock):
        for hidden in each._hidden_objects:
            hidden.show_visual()  # a batch moves hidden objects far away, stock does not
    stock_env.put_in_same_state(stock, batch, env)


def assert_same(batched: Any, single: Any, path: str, env: int = ENV) -> None:
    """Compare env `env` of nested batched tensors with the only env of the others."""
    if isinstance(single, dict):
        assert list(batched) == list(single), path
        for key in single:
            assert_same(batched[key], single[key], f"{path}/{key}", env)
        return
    # Stock ManiSkill leaves images on the render GPU and states on the CPU.
    ours, theirs = batched[env], single[0].cpu()
    assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape), path
    computed_from_camera_poses = path.endswith(("extrinsic_cv", "cam2world_gl", "xyzw"))
    tolerance = CAMERA_TOLERANCE if computed_from_camera_poses else 0.0
    torch.testing.assert_close(ours, theirs, atol=tolerance, rtol=0, msg=lambda text: f"{path}: {text}")


# --- observations ----------------------------------------------------------------------------------

draws, slow = pytest.mark.render, pytest.mark.slow


@pytest.mark.parametrize(
    "obs_mode",
    [
        "state",
        "state_dict",
        "none",
        pytest.param("rgb+depth+segmentation", marks=slow),
        pytest.param("pointcloud", marks=draws),
        pytest.param("depth+state_dict", marks=slow),
        pytest.param("position", marks=slow),
        pytest.param("pointcloud+state", marks=slow),
        pytest.param("normal+albedo", marks=slow),
    ],
)
def test_observations(obs_mode: str) -> None:
    cameras: dict[str, Any] = dict(SMALL)
    if "normal" in obs_mode:
        cameras["shader_pack"] = "default"
    # A robot with a camera on its hand, which moves.
    kwargs: dict[str, Any] = {"obs_mode": obs_mode, "robot_uids": "panda_wristcam", "sensor_configs": cameras}
    if obs_mode in ("state", "state_dict", "none"):
        kwargs |= NO_PICTURES
    batch, stock = pair(**kwargs)
    assert batch.single_observation_space == stock.single_observation_space
    put_in_same_state(batch, stock)
    assert_same(batch.get_obs(), stock.get_obs(), "reset")
    rng = np.random.default_rng(0)
    for step in range(2):
        action = rng.uniform(-1, 1, (N, 8)).astype(np.float32)
        obs = batch.step(action)[0]
        assert_same(obs, stock.step(action[ENV : ENV + 1])[0], f"step {step}")
    assert batch.observation_space.contains(common.to_numpy(obs))
    batch.close()
    stock.close()


def test_the_next_step_does_not_change_a_kept_observation(renderer: None) -> None:
    env = workbench.make("PickCube-v1", N, backend="cpu", obs_mode="rgb+state", sensor_configs=dict(SMALL))
    kept, _ = env.reset(seed=0)
    copied = common.torch_clone_dict(kept)
    for _ in range(3):
        env.step(env.action_space.sample())
    assert torch.equal(kept["state"], copied["state"])
    now = env.unwrapped.get_obs()["sensor_data"]["base_camera"]["rgb"]
    assert torch.equal(kept["sensor_data"]["base_camera"]["rgb"], copied["sensor_data"]["base_camera"]["rgb"])
    assert not torch.equal(now, copied["sensor_data"]["base_camera"]["rgb"])
    env.close()


# --- rewards ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("reward_mode", ["normalized_dense", "dense", "sparse", "none"])
def test_rewards(reward_mode: str) -> None:
    batch, stock = pair("PushCube-v1", num_envs=3, reward_mode=reward_mode, **NO_PICTURES)
    put_in_same_state(batch, stock)
    for each, env in ((batch, slice(None)), (stock, slice(ENV, ENV + 1))):
        # Near the goal, so that the sparse reward is 1 in this env and 0 in the other.
        goal = batch.goal_region.pose.p[env].clone()
        goal[:, 0] -= torch.tensor([0.4, 0.0, 0.0])[env]
        goal[:, 2] = batch.obj.pose.p[env][:, 2]
        raw = torch.cat([goal, torch.tensor([[1.0, 0, 0, 0]]).expand(len(goal), 4)], dim=1)
        each.obj.set_pose(Pose.create(raw))
    batch.scene._gpu_apply_all()
    batch.scene._gpu_fetch_all()
    rng = np.random.default_rng(0)
    for _ in range(3):
        action = rng.uniform(-1, 1, (3, 8)).astype(np.float32)
        _, reward, _, _, info = batch.step(action)
        _, other, _, _, other_info = stock.step(action[ENV : ENV + 1])
        assert reward.shape == (3,) and reward.dtype == other.dtype
        assert float(reward[ENV]) == pytest.approx(float(other[0]), abs=1e-6)
        assert info["success"].tolist() == [False, True, True] and bool(other_info["success"][0])
    if reward_mode == "sparse":
        assert reward.tolist() == [0, 1, 1]
    if reward_mode == "none":
        assert reward.tolist() == [0, 0, 0]
    batch.close()
    stock.close()


# --- control ---------------------------------------------------------------------------------------


def body_frame_configs(panda: Any) -> dict[str, Any]:
    """Two modes in body frames, which ManiSkill's GPU inverse kinematics lacks: it supports root axes only."""
    configs = PANDA_CONFIGS(panda)
    configs["pd_ee_delta_pos"]["arm"].frame = "body_translation"
    configs["pd_ee_delta_pose"]["arm"].frame = "body_translation:body_aligned_body_rotation"
    return configs


PANDA_CONFIGS: Any = Panda.__dict__["_controller_configs"].fget
CONTROL_MODES = [
    "pd_joint_delta_pos",
    "pd_joint_pos",
    "pd_ee_delta_pos",
    "pd_ee_delta_pose",
    "pd_ee_pose",
    "pd_joint_target_delta_pos",
    "pd_ee_target_delta_pos",
    "pd_ee_target_delta_pose",
    "pd_joint_vel",
    "pd_joint_pos_vel",
    "pd_joint_delta_pos_vel",
]


def an_action(batch: Any, rng: np.random.Generator) -> np.ndarray:
    """Draw an action (N, A) within the mode's bounds; absolute modes get targets near the arm."""
    action = rng.uniform(-1, 1, (batch.num_envs, *batch.single_action_space.shape)).astype(np.float32)
    if batch.control_mode in ("pd_joint_pos", "pd_joint_pos_vel"):
        action[:, :7] = batch.agent.robot.get_qpos()[:, :7].numpy() + 0.1 * action[:, :7]
    if batch.control_mode == "pd_ee_pose":
        at = batch.agent.controller.controllers["arm"].ee_pose_at_base
        angles = matrix_to_euler_angles(quaternion_to_matrix(at.q), "XYZ")
        action[:, :6] = torch.hstack([at.p, angles]).numpy() + 0.05 * action[:, :6]
        if rng.random() < 0.3:  # out of reach: IK has no solution, in this env only
            action[ENV, :3] = 1.9
    return action


@pytest.mark.parametrize("control_mode", CONTROL_MODES)
def test_control(control_mode: str) -> None:
    follow_under_control(control_mode)


def interpolating_configs(panda: Any) -> dict[str, Any]:
    """Modes whose controllers set a target before each substep."""
    configs = PANDA_CONFIGS(panda)
    for mode in ("pd_ee_delta_pos", "pd_joint_delta_pos"):
        configs[mode]["arm"].interpolate = True
    return configs


@pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")
@pytest.mark.parametrize(
    ("configs", "control_mode"),
    [
        (body_frame_configs, "pd_ee_delta_pos"),
        (body_frame_configs, "pd_ee_delta_pose"),
        (interpolating_configs, "pd_ee_delta_pos"),
        (interpolating_configs, "pd_joint_delta_pos"),
    ],
)
def test_control_in_the_hands_frame_and_with_targets_between_substeps(
    configs: Any, control_mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Panda, "_controller_configs", property(configs))
    follow_under_control(control_mode)


def follow_under_control(control_mode: str) -> None:
    batch, stock = pair(control_mode=control_mode, **NO_PICTURES)
    assert batch.single_action_space == stock.single_action_space
    put_in_same_state(batch, stock)
    begin = batch.agent.robot.get_qpos().clone()
    rng = np.random.default_rng(2)
    for step in range(15):
        action = an_action(batch, rng)
        batch.step(action)
        stock.step(action[ENV : ENV + 1])
        assert torch.equal(batch.get_state()[ENV], stock.get_state()[0]), f"step {step}"
    moved = (batch.agent.robot.get_qpos() - begin).abs().max(dim=1).values
    assert (moved > 0.01).all(), "the arm did not move, so the test proved nothing"
    batch.close()
    stock.close()


def test_the_control_mode_can_change_on_a_running_env() -> None:
    batch, stock = pair(**NO_PICTURES)
    put_in_same_state(batch, stock)
    rng = np.random.default_rng(0)
    for mode in ("pd_ee_delta_pose", "pd_joint_delta_pos", "pd_ee_target_delta_pos"):
        for each in (batch, stock):
            each.agent.set_control_mode(mode)
            each.agent.controller.reset()
        action = rng.uniform(-1, 1, (N, *batch.agent.single_action_space.shape)).astype(np.float32)
        batch.step({"control_mode": mode, "action": action})
        stock.step({"control_mode": mode, "action": action[ENV : ENV + 1]})
        assert torch.equal(
            batch.scene.get_sim_state()["articulations"]["panda"][ENV],
            stock.scene.get_sim_state()["articulations"]["panda"][0],
        ), mode
    batch.close()
    stock.close()


# --- rendering -------------------------------------------------------------------------------------


class TwoCameras(PickCubeEnv):
    """Adds a second human render camera; the goal is hidden from sensors and visible to human render cameras."""

    @property
    def _default_human_render_camera_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at([0.4, -0.5, 0.4], [0.0, 0.0, 0.2])
        first: Any = super()._default_human_render_camera_configs
        return [first, CameraConfig("from_the_side", pose, 32, 24, 1.0, 0.01, 100)]


@pytest.fixture(scope="module", params=[PickCubeEnv, TwoCameras], ids=["one-camera", "two-cameras"])
def rendered(renderer: None, request: pytest.FixtureRequest) -> Iterator[tuple[Any, Any]]:
    batch, stock = pair(
        request.param,
        obs_mode="rgb+segmentation",
        render_mode="rgb_array",
        sensor_configs=dict(SMALL),
        human_render_camera_configs=dict(SMALL),
    )
    yield batch, stock
    batch.close()
    stock.close()


@pytest.mark.parametrize("render_mode", [pytest.param("rgb_array", marks=slow), "sensors", "all"])
def test_rendering(rendered: tuple[Any, Any], render_mode: str) -> None:
    batch, stock = rendered
    put_in_same_state(batch, stock)
    for each in rendered:
        each.render_mode = render_mode
    action = np.zeros((N, 8), np.float32)
    for _ in range(2):
        ours, theirs = batch.render(), stock.render()
        assert ours.shape == (N, *theirs.shape[1:]) and ours.dtype == torch.uint8
        assert torch.equal(ours[ENV], theirs[0]) and not torch.equal(ours[0], ours[ENV])
        assert int(ours[ENV].max()) > 100
        batch.step(action)
        stock.step(action[:1])

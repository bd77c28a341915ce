"""Arms of ManiSkill's robots: found, solved within their limits, and led by the action in one env."""

# SAPIEN and ManiSkill annotate vectors and poses as what they become.
# pyright: reportArgumentType=false

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.agents.controllers.pd_ee_pose import PDEEPosControllerConfig
from mani_skill.agents.robots import Panda
from mani_skill.utils.structs import Pose

from tests.drive.envs import batched
from workbench.envs.action_vector import hold_action
from workbench.envs.arms import Arm, find_arms, reaches, solve, steer, without_arms
from workbench.envs.maniskill_private import apply_and_fetch, objects_of
from workbench.envs.task_env import TaskEnv

pytestmark = pytest.mark.thorough

ENV = 1
WAY = np.array([-0.03, 0.04, 0.05, 0, 0, 0, 0])


def opened(robot: str, mode: str, task: str = "Empty-v1", num_envs: int = 2) -> TaskEnv:
    env = TaskEnv(batched(task, num_envs, control_mode=mode, robot_uids=robot))
    env.reset(0)
    return env


def tool(arm: Arm, env: int = ENV) -> np.ndarray:
    """(7,) pose of the end effector."""
    return arm.link.pose.raw_pose[env].numpy().astype(float)


def angle(one: np.ndarray, other: np.ndarray) -> float:
    """Degrees between two rotations."""
    return float(np.rad2deg(2 * np.arccos(min(1.0, abs(one[3:] @ other[3:])))))


def apart(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one[:3] - other[:3]))


@pytest.mark.parametrize(
    ("robot", "ends"),
    [
        ("panda", {"panda/panda_hand_tcp": 7}),
        ("panda_stick", {"panda_stick/panda_hand_tcp": 7}),
        ("fetch", {"fetch/gripper_link": 7}),
        ("so100", {"so100/Fixed_Jaw_tip": 5}),
        ("koch-v1.1", {"koch-v1.1/gripper_tcp": 5}),
        ("floating_panda_gripper", {"floating_panda_gripper/panda_hand_tcp": 6}),
        (
            "unitree_g1_simplified_upper_body_with_head_camera",
            {
                "unitree_g1_simplified_upper_body_with_head_camera/right_tcp_link": 5,
                "unitree_g1_simplified_upper_body_with_head_camera/left_tcp_link": 5,
            },
        ),
        ("allegro_hand_right", {}),
    ],
)
def test_each_end_effector_has_the_joints_that_move_it_alone(robot: str, ends: dict[str, int]) -> None:
    env = opened(robot, "pd_joint_pos", num_envs=1).env
    assert {arm.name: len(arm.joints) for arm in find_arms(env)} == ends
    assert without_arms(env) == (() if ends else (robot,))


def test_wrong_names_in_a_mode_that_is_not_used_are_no_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    """ManiSkill opens the task, since it reads only the mode in use."""
    odd = PDEEPosControllerConfig(["no_joint"], -0.1, 0.1, 1e3, 1e2, ee_link="no_link")
    own: Any = Panda.__dict__["_controller_configs"].fget
    monkeypatch.setattr(Panda, "_controller_configs", property(lambda panda: {**own(panda), "odd": odd}))
    env = opened("panda", "pd_joint_pos", num_envs=1).env
    assert [len(arm.joints) for arm in find_arms(env)] == [7]


@pytest.mark.parametrize(
    ("robot", "mode"),
    [
        ("panda", "pd_joint_delta_pos"),
        ("panda", "pd_ee_delta_pos"),
        ("panda", "pd_joint_vel"),
        ("panda", "pd_joint_pos_vel"),
        ("fetch", "pd_joint_pos"),
        ("fetch", "pd_ee_delta_pose"),
        ("so100", "pd_joint_delta_pos"),
    ],
)
def test_the_action_leads_the_arm_of_one_env_to_the_target(robot: str, mode: str) -> None:
    task = opened(robot, mode, "PickCube-v1")
    (arm,) = find_arms(task.env)
    target, still = tool(arm) + WAY, tool(arm, 0)
    held = hold_action(task.parts, 2)
    goal = solve(arm, ENV, target)
    for _ in range(60):
        action = held.copy()
        assert steer(task.env, arm, ENV, goal, action[ENV])
        task.step(action)
    assert apart(tool(arm), target) < 0.01
    assert apart(tool(arm, 0), still) < 2e-3


def unlike(mode: str, num_envs: int = 3) -> TaskEnv:
    """Envs whose robots stand, turn and bend differently."""
    task = opened("panda", mode, "PickCube-v1", num_envs)
    own, number = task.env.agent.robot, torch.arange(num_envs)
    half = 0.3 * number
    zero = torch.zeros(num_envs)
    own.set_pose(
        Pose.create_from_pq(
            torch.stack([0.1 * number, 0.5 * number, zero], 1),
            torch.stack([half.cos(), zero, zero, half.sin()], 1),
        )
    )
    own.set_qpos(own.get_qpos() + 0.15 * number[:, None] * torch.tensor([1, 1, -1, 1, 1, 1, 1, 0, 0]))
    apply_and_fetch(task.env)
    task.env.agent.controller.reset()
    return task


@pytest.fixture
def body_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    own: Any = Panda.__dict__["_controller_configs"].fget

    def configs(panda: Any) -> dict[str, Any]:
        found = own(panda)
        found["in the hand's frame"] = copy.deepcopy(found["pd_ee_delta_pose"])
        found["in the hand's frame"]["arm"].frame = "body_translation:body_aligned_body_rotation"
        return found

    monkeypatch.setattr(Panda, "_controller_configs", property(configs))


@pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")
@pytest.mark.parametrize(
    "mode",
    ["pd_ee_delta_pose", "pd_ee_target_delta_pose", "pd_ee_pose", "in the hand's frame", "pd_joint_pos"],
)
def test_a_hand_is_moved_and_turned_where_every_env_stands_differently(body_frames: None, mode: str) -> None:
    task = unlike(mode)
    (arm,) = find_arms(task.env)
    turn = sapien.Pose([0.03, -0.02, 0.04], [np.cos(0.1), 0.6 * np.sin(0.1), 0, 0.8 * np.sin(0.1)])
    before = [tool(arm, env) for env in range(3)]
    wanted = sapien.Pose(before[2][:3], before[2][3:]) * turn
    target = np.array([*wanted.p, *wanted.q])
    held = hold_action(task.parts, 3)
    goal = solve(arm, 2, target)
    assert not goal.why
    for _ in range(12):
        action = held.copy()
        assert steer(task.env, arm, 2, goal, action[2])
        assert (action[:2] == held[:2]).all() and action[2, -1] == held[2, -1], "the gripper keeps its number"
        task.step(action)
    assert apart(tool(arm, 2), target) < 0.005 and angle(tool(arm, 2), target) < 2
    for env in range(2):
        assert apart(tool(arm, env), before[env]) < 5e-3 and angle(tool(arm, env), before[env]) < 1
    assert reaches(arm, 2, np.array([target[:3], before[2][:3], before[0][:3] + [0, 0, 1.5]])).tolist() == [
        True,
        True,
        False,
    ]


@pytest.mark.parametrize("mode", ["pd_joint_delta_pos", "pd_joint_vel", "pd_ee_delta_pos"])
def test_a_step_to_a_far_pose_is_shortened_and_not_bent(mode: str) -> None:
    task = opened("panda", mode)
    (arm,) = find_arms(task.env)
    goal = solve(arm, ENV, tool(arm) + [-0.25, 0.3, 0.2, 0, 0, 0, 0])
    action = hold_action(task.parts, 2)
    steer(task.env, arm, ENV, goal, action[ENV])
    link = objects_of(arm.link)[ENV].index
    if mode == "pd_ee_delta_pos":
        way, values = goal.poses[link, :3] - tool(arm)[:3], action[ENV, :3]
    else:
        way, values = (goal.qpos - arm.qpos(ENV))[list(arm.joints)], action[ENV, :7]
    assert np.abs(values).max() == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(values, way / np.abs(way).max(), atol=1e-3)


def test_out_of_reach_the_hand_goes_along_the_line_to_the_target() -> None:
    (arm,) = find_arms(opened("panda", "pd_joint_pos", "PickCube-v1", 1).env)
    start = tool(arm, 0)
    found = solve(arm, 0, start + [0, 0, 3, 0, 0, 0, 0])
    end = found.poses[objects_of(arm.link)[0].index]
    assert 0.5 < end[2] - start[2] < 1.5 and np.abs(end[:2] - start[:2]).max() < 0.01
    assert found.metres == pytest.approx(3 - (end[2] - start[2]), abs=0.01) and found.why


def test_of_two_robots_one_is_led() -> None:
    task = opened_pair()
    first, second = find_arms(task.env)
    assert first.name.partition("/")[0] != second.name.partition("/")[0]
    held = hold_action(task.parts, 2)
    for arm, columns in ((first, slice(0, 7)), (second, slice(8, 15))):
        action = held.copy()
        assert steer(task.env, arm, ENV, solve(arm, ENV, tool(arm) + WAY), action[ENV])
        changed = action != held
        assert changed[ENV, columns].any()
        changed[ENV, columns] = False
        assert not changed.any()


def opened_pair() -> TaskEnv:
    task = TaskEnv(batched("TwoRobotPickCube-v1", 2, control_mode="pd_joint_pos"))
    task.reset(0)
    return task


def test_a_floating_gripper_follows() -> None:
    task = opened("floating_panda_gripper", "pd_ee_delta_pose")
    (arm,) = find_arms(task.env)
    target = tool(arm) + [0.2, 0.1, 0.5, 0, 0, 0, 0]
    goal = solve(arm, ENV, target)
    for _ in range(60):
        action = hold_action(task.parts, 2)
        steer(task.env, arm, ENV, goal, action[ENV])
        task.step(action)
    assert apart(tool(arm), target) < 0.01


@pytest.mark.parametrize("robot", ["panda", "so100"])
def test_a_solution_is_within_the_limits_and_says_what_is_left(robot: str) -> None:
    (arm,) = find_arms(opened(robot, "pd_joint_pos", "PickCube-v1", num_envs=1).env)
    limits, rng = arm.limits(0), np.random.default_rng(0)
    link = objects_of(arm.link)[0].index
    for metres in (0.02, 0.1, 0.5, 3.0):
        way = rng.normal(size=3)
        target = tool(arm, 0)
        target[:3] += metres * way / np.linalg.norm(way)
        found = solve(arm, 0, target)
        own = list(arm.joints)
        assert (found.qpos[own] >= limits[own, 0] - 1e-6).all()
        assert (found.qpos[own] <= limits[own, 1] + 1e-6).all()
        assert apart(found.poses[link], target) == pytest.approx(found.metres, abs=1e-4)
        assert angle(found.poses[link], target) == pytest.approx(found.degrees, abs=0.5)
        names = {
            name
            for name, joint in zip(arm.joint_names, own, strict=True)
            if (np.abs(found.qpos[joint] - limits[joint]) < 1e-3).any()
        }
        named = {name for name in arm.joint_names if name in found.why.replace(",", " ").split()}
        assert named == (names if found.why else set())
        assert bool(found.why) == (found.metres >= 0.005 or found.degrees >= 2)
        assert found.metres <= metres + 0.005, "never farther than it was"
        assert metres > 0.02 or found.metres < 0.005
    assert found.why, "3 m are too far"


def test_an_arm_holds_still_in_the_mode_of_absolute_poses() -> None:
    task = opened("panda", "pd_ee_pose", "PickCube-v1")
    (arm,) = find_arms(task.env)
    before = tool(arm)
    held = hold_action(task.parts, 2)
    for _ in range(20):
        task.step(held)
    assert apart(tool(arm), before) < 2e-3


@pytest.mark.parametrize("robot", ["panda", "fetch", "so100"])
def test_an_arm_reaches_where_joints_within_the_limits_bring_it_and_not_farther(robot: str) -> None:
    task = opened(robot, "pd_joint_pos")
    (arm,) = find_arms(task.env)
    own, rng, start = list(arm.joints), np.random.default_rng(0), tool(arm)[:3]
    low, high = np.clip(arm.limits(ENV)[own].T, -3, 3)
    points = []
    for _ in range(20):
        qpos = arm.articulation.get_qpos()
        qpos[ENV, own] = torch.as_tensor(rng.uniform(low, high), dtype=torch.float32)
        arm.articulation.set_qpos(qpos)
        apply_and_fetch(task.env)
        points.append(tool(arm)[:3])
    task.reset(0)
    assert reaches(arm, ENV, np.array(points)).all()
    assert not reaches(arm, ENV, start + np.array([[0, 0, 9.0], [0, 0, -9.0]])).any()

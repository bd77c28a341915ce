"""Arms of ManiSkill's robots: found, solved within their limits, and led by the action in one env."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from mani_skill.agents.controllers.pd_ee_pose import PDEEPosControllerConfig
from mani_skill.agents.robots import Panda

from tests.drive.envs import batched
from workbench.envs.action_vector import hold_action
from workbench.envs.arms import Arm, find_arms, reaches, solve, steer, without_arms
from workbench.envs.maniskill_private import apply_and_fetch, objects_of
from workbench.envs.task_env import TaskEnv

ENV = 1
WAY = np.array([-0.03, 0.04, 0.05, 0, 0, 0, 0])


def opened(robot: str, mode: str, task: str = "Empty-v1", num_envs: int = 2) -> TaskEnv:
    env = TaskEnv(batched(task, num_envs, control_mode=mode, robot_uids=robot))
    env.reset(0)
    return env


def tool(arm: Arm, env: int = ENV) -> np.ndarray:
    """(7,) pose of the end effector."""
    return arm.link.pose.raw_pose[env].numpy().astype(float)


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
        *(
            ("panda", mode)
            for mode in (
                "pd_joint_delta_pos",
                "pd_joint_pos",
                "pd_ee_delta_pos",
                "pd_ee_pose",
                "pd_ee_target_delta_pose",
                "pd_joint_vel",
                "pd_joint_pos_vel",
            )
        ),
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
    for _ in range(60):
        action = held.copy()
        assert steer(task.env, arm, ENV, solve(arm, ENV, target), action[ENV])
        task.step(action)
    assert apart(tool(arm), target) < 0.01
    assert apart(tool(arm, 0), still) < 2e-3


def test_a_floating_gripper_follows() -> None:
    task = opened("floating_panda_gripper", "pd_ee_delta_pose")
    (arm,) = find_arms(task.env)
    target = tool(arm) + [0.2, 0.1, 0.5, 0, 0, 0, 0]
    for _ in range(60):
        action = hold_action(task.parts, 2)
        steer(task.env, arm, ENV, solve(arm, ENV, target), action[ENV])
        task.step(action)
    assert apart(tool(arm), target) < 0.01


@pytest.mark.parametrize(("robot", "task"), [("panda", "PickCube-v1"), ("so100", "PickCube-v1")])
def test_a_solution_is_within_the_limits_and_says_what_is_left(robot: str, task: str) -> None:
    (arm,) = find_arms(opened(robot, "pd_joint_pos", task, num_envs=1).env)
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

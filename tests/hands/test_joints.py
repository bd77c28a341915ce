"""Joints of robots that a person sets or drives, in a session with a real worker."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.agents.base_agent import Keyframe
from mani_skill.utils.structs.pose import Pose

from tests.drive.envs import batched, stock
from tests.drive.session import jump, live_session, moment_at, start_over, step, wait_until
from workbench.app.session import Session
from workbench.envs import maniskill_private
from workbench.envs.action_vector import action_parts, target_joints
from workbench.envs.read_robots import named_agents, read_robots
from workbench.envs.robots import Joint
from workbench.envs.scene.scene_index import read_joints, read_poses, scene_index
from workbench.hands.commands import ChooseMovedEnvs, DragJoint, SetJoint, UseKeyframe
from workbench.hands.joints import (
    display_value,
    keyframe_code,
    limits_text,
    position_of,
    qpos_code,
    slider_bounds,
)
from workbench.hands.link_poses import link_poses
from workbench.hands.state import DraggedJoint, Hands
from workbench.hands.worker import move_joints
from workbench.live.commands import PauseRun, PlayRun, UseControlMode
from workbench.live.events import MomentShown
from workbench.live.history.moments import BY_HAND
from workbench.live.messages import MoveJoints
from workbench.live.timeline_commands import ContinueFromHere, UndoReset
from workbench.page.command import Refused
from workbench.record.commands import ToggleRecording
from workbench.record.state import RecordingStatus

N = 3
PANDA = "panda"
ELBOW = 3
"""Place of panda_joint4 in the robot's joints."""


@pytest.fixture(scope="module")
def session(child_process: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with live_session("PickCube-v1", tmp_path_factory.mktemp("recordings"), num_envs=N) as session:
        yield session


def fresh(session: Session) -> int:
    """Pause at the first moment of seed 0's episodes; return the moment's serial."""
    session.do(PauseRun())
    session.do(ChooseMovedEnvs(all_envs=False))
    session.change(episode_end="continue", action_source="hold", selected_env=1)
    return start_over(session, 0).timeline.last


def qpos(session: Session) -> np.ndarray:
    """(N, J) shown joint positions."""
    now = session.view().step.qpos
    assert now is not None, "the scene has joints"
    return now


def set_elbow(session: Session, degrees: float = -90.0) -> None:
    jump(session, lambda: session.do(SetJoint(robot=PANDA, joint=ELBOW, to=degrees)))


def test_a_joint_is_set_in_the_selected_env_only_and_stays_there(session: Session) -> None:
    fresh(session)
    step(session, 2)
    before, poses = qpos(session).copy(), session.view().step.poses.copy()
    set_elbow(session)
    expected = before[1].copy()
    expected[ELBOW] = -math.pi / 2
    np.testing.assert_allclose(qpos(session)[1], expected, atol=1e-6)
    np.testing.assert_array_equal(qpos(session)[[0, 2]], before[[0, 2]])
    now = session.view()
    np.testing.assert_array_equal(now.step.poses[[0, 2]], poses[[0, 2]])
    names = now.task.geometry.body_names
    assert np.abs(now.step.poses[1] - poses[1])[names.index("panda/panda_hand"), :3].max() > 0.1
    np.testing.assert_array_equal(now.step.poses[1, names.index("cube")], poses[1, names.index("cube")])
    assert np.isnan(now.step.reward[1]) and now.step.elapsed_steps[1] == 2
    step(session, 5)
    np.testing.assert_allclose(qpos(session)[1], expected, atol=2e-3)


def test_a_drag_is_one_event_that_undo_takes_back(session: Session) -> None:
    start = fresh(session)
    step(session, 1)
    before = session.view().step
    for degrees in (-100.0, -80.0, -60.0):
        session.do(DragJoint(robot=PANDA, joint=ELBOW, to=degrees))
    dragged = session.view()
    assert dragged.of(Hands).dragged == DraggedJoint(PANDA, (1,), ELBOW, math.radians(-60.0))
    assert dragged.timeline.last == start + 1, "until the end of the drag only the page shows it"
    set_elbow(session, -60.0)
    moved = session.view()
    assert moved.of(Hands).dragged is None
    assert moved.timeline.last == start + 2
    assert moved.timeline.undo == "move of panda of env 1"
    assert moved.timeline.arrived == "panda_joint4 of panda was set by hand."
    moment = moment_at(session, moved.timeline.last)
    assert moment is not None and moment.event_flags.tolist() == [0, BY_HAND, 0]
    jump(session, lambda: session.do(UndoReset()))
    np.testing.assert_array_equal(session.view().step.poses, before.poses)
    np.testing.assert_array_equal(session.view().step.qpos, before.qpos)


def test_what_happens_after_it_is_repeated_to_the_last_bit(session: Session) -> None:
    fresh(session)
    set_elbow(session)
    session.change(action_source="random")
    step(session, 4)
    after = session.view().timeline.last
    kept = session.view().step.poses.copy()
    step(session, 3)
    session.dispatch(MomentShown(after))
    jump(session, lambda: session.do(ContinueFromHere()))
    np.testing.assert_array_equal(session.view().step.poses[1], kept[1])


def test_a_keyframe_is_that_of_maniskills_own_robot_in_all_envs(session: Session) -> None:
    fresh(session)
    set_elbow(session)
    session.do(ChooseMovedEnvs(all_envs=True))
    jump(session, lambda: session.do(UseKeyframe(robot=PANDA, name="rest")))
    env = stock("PickCube-v1")
    env.reset(seed=0)
    env.agent.robot.set_qpos(env.agent.keyframes["rest"].qpos)
    view = session.view()
    wanted = read_joints(env)
    assert wanted is not None
    np.testing.assert_allclose(qpos(session), np.tile(wanted, (N, 1)), atol=1e-6)
    links = [k for k, name in enumerate(view.task.geometry.body_names) if name.startswith("panda/")]
    assert scene_index(env).names == view.task.geometry.body_names
    expected = np.tile(read_poses(env)[:, links, :3], (N, 1, 1))
    np.testing.assert_allclose(view.step.poses[:, links, :3], expected, atol=1e-5)
    env.close()
    assert view.timeline.undo == "move of panda of all"


def test_a_recording_in_progress_ends_at_it(session: Session) -> None:
    fresh(session)
    written = session.view().of(RecordingStatus).episodes_written
    session.do(ToggleRecording())
    start_over(session, 0)
    step(session, 3)
    set_elbow(session)
    wait_until(session, lambda v: v.of(RecordingStatus).episodes_written == written + 1, "the ended episode")
    session.do(ToggleRecording())
    wait_until(session, lambda v: not v.of(RecordingStatus).active, "the end of the recording")


def test_while_it_plays_a_slider_drives_its_joint_in_a_mode_of_positions(session: Session) -> None:
    fresh(session)
    session.do(UseControlMode(mode="pd_joint_pos"))
    wait_until(session, lambda v: v.task.control_mode == "pd_joint_pos" and v.state == "paused", "the mode")
    start_over(session, 0)
    before = qpos(session).copy()
    session.do(PlayRun())
    session.do(DragJoint(robot=PANDA, joint=ELBOW, to=-90.0))
    session.do(SetJoint(robot=PANDA, joint=7, to=0.01))
    view = wait_until(session, lambda v: abs(v.step.qpos[1, ELBOW] + math.pi / 2) < 0.02, "the elbow")
    assert view.settings.action_source == "sliders" and view.of(Hands).dragged is None
    wait_until(session, lambda v: abs(v.step.qpos[1, 7:9] - 0.01).max() < 2e-3, "both fingers")
    session.do(PauseRun())
    np.testing.assert_allclose(qpos(session)[[0, 2]], before[[0, 2]], atol=0.02)
    with pytest.raises(Refused, match="panda_finger_joint2"):
        session.do(PlayRun())
        session.do(SetJoint(robot=PANDA, joint=8, to=0.0))
    session.do(PauseRun())


# --- one env, without a session --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "task",
    ["PickCube-v1", "TwoRobotPickCube-v1", "MS-CartpoleBalance-v1", "UnitreeG1Stand-v1", "MS-AntRun-v1"],
)
def test_the_page_places_links_where_the_simulation_does(task: str) -> None:
    env = batched(task, on_finding=lambda finding: None)  # ManiSkill's Ant breaks a rule
    env.reset(seed=0)
    poses, columns, random = read_poses(env), read_joints(env), np.random.default_rng(0)
    robots = read_robots(env)
    assert robots and columns is not None
    for robot in robots:
        positions = np.array(
            [[random.uniform(max(j.low, -1), min(j.high, 1)) for j in robot.joints] for _ in range(2)]
        )
        poses = link_poses(robot, poses, positions)
        named_agents(env)[robot.name].robot.set_qpos(torch.tensor(positions, dtype=torch.float32))
    maniskill_private.apply_and_fetch(env)
    expected = read_poses(env)
    np.testing.assert_allclose(poses[..., :3], expected[..., :3], atol=1e-5)
    agreement = np.abs((poses[..., 3:] * expected[..., 3:]).sum(axis=-1))
    np.testing.assert_allclose(agreement, 1.0, atol=1e-5)  # q and -q are the same
    env.close()


class _Task:
    """What `move_joints` uses of a `TaskEnv`."""

    def __init__(self, env: Any) -> None:
        self.env = env

    def rescore(self) -> None:
        return None


def test_one_of_two_robots_is_set_and_the_other_keeps_its_targets() -> None:
    env = batched("TwoRobotPickCube-v1", control_mode="pd_joint_pos")
    env.reset(seed=0)
    hold = {name: agent.robot.get_qpos()[:, :8].clone() for name, agent in env.agent.agents_dict.items()}
    for action in hold.values():
        action[:, 7] = -1.0
    env.step(hold)
    first, second = (agent.robot for agent in named_agents(env).values())
    kept, targets = second.get_qpos().clone(), second.get_drive_targets().clone()
    assert (targets - kept).abs().max() > 0.01, "its gripper is about to close"
    name = next(iter(named_agents(env)))
    moved = move_joints(_Task(env), MoveJoints(name, (1,), (0, 8), (0.5, 0.02), None, "", 0))  # type: ignore[arg-type]
    assert moved is not None and moved[1].env_idx == (1,)
    assert first.get_qpos()[1, [0, 8]].tolist() == pytest.approx([0.5, 0.02])
    assert abs(float(first.get_qpos()[0, 0])) < 0.4
    assert torch.equal(first.get_drive_targets()[1], first.get_qpos()[1])
    assert torch.equal(second.get_drive_targets(), targets) and torch.equal(second.get_qpos(), kept)
    env.close()


def test_the_numbers_of_an_end_effector_are_targets_of_no_joint() -> None:
    env = batched("PickCube-v1", control_mode="pd_ee_pose")
    env.reset(seed=0)
    arm, gripper = action_parts(env)
    assert not target_joints(arm) and target_joints(gripper)
    env.close()


def test_a_keyframe_moves_the_root_of_a_robot_that_stands_free() -> None:
    env = batched("UnitreeG1Stand-v1")
    env.reset(seed=0)
    (robot,) = read_robots(env)
    keyframe = next(one for one in robot.keyframes if one.name == "right_knee_up")
    own = env.agent.keyframes["right_knee_up"]
    assert keyframe.root is not None
    every = tuple(range(len(robot.joints)))
    raised = (*keyframe.root[:2], keyframe.root[2] + 1.0, *keyframe.root[3:])
    move_joints(_Task(env), MoveJoints(robot.name, (0,), every, keyframe.qpos, raised, "", 0))  # type: ignore[arg-type]
    np.testing.assert_allclose(env.agent.robot.get_qpos()[0], own.qpos, atol=1e-5)
    np.testing.assert_allclose(env.agent.robot.pose.p[0], own.pose.p + [0, 0, 1], atol=1e-5)
    assert not np.allclose(env.agent.robot.get_qpos()[1], own.qpos, atol=1e-3)
    env.close()


def test_a_keyframe_that_is_no_pose_is_left_out_and_the_task_loads() -> None:
    env = batched("UnitreeG1Stand-v1")
    env.reset(seed=0)
    qpos, pose = env.agent.keyframes["right_knee_up"].qpos, Pose.create_from_pq(torch.ones((2, 3)))
    env.agent.keyframes = {
        "ragged": Keyframe(sapien.Pose(), [[1.0], [2.0, 3.0]]),
        "short": Keyframe(sapien.Pose(), qpos[:3]),
        "not finite": Keyframe(sapien.Pose(), np.full_like(qpos, np.nan)),
        "one for each env": Keyframe(pose, qpos),  # type: ignore[arg-type]
        "no rotation": Keyframe(sapien.Pose(q=[0, 0, 0, 0]), qpos),
    }
    (robot,) = read_robots(env)
    roots = {one.name: one.root for one in robot.keyframes}
    assert roots == {"one for each env": (1, 1, 1, 1, 0, 0, 0), "no rotation": None}
    env.close()


@pytest.mark.parametrize(
    "request_",
    [
        MoveJoints("fetch", (0,), (0,), (0.0,), None, "", 0),
        MoveJoints(PANDA, (0,), (9,), (0.0,), None, "", 0),
    ],
)
def test_a_robot_of_another_version_is_not_set(request_: MoveJoints) -> None:
    env = batched("PickCube-v1")
    env.reset(seed=0)
    assert move_joints(_Task(env), request_) is None  # type: ignore[arg-type]
    env.close()


# --- units and source text ---------------------------------------------------------------------------------


def test_a_slider_shows_degrees_or_metres_and_stays_within_the_limits() -> None:
    hinge, rail = Joint("hinge", False, -math.pi / 2, math.pi, 0), Joint("rail", True, 0.0, 0.04, 1)
    assert slider_bounds(hinge, 0.0) == (-90.0, 180.0) and slider_bounds(rail, 0.0) == (0.0, 0.04)
    assert (
        position_of(hinge, 45.0) == pytest.approx(math.pi / 4) and position_of(hinge, -200.0) == -math.pi / 2
    )
    assert position_of(rail, 1.0) == 0.04 and display_value(rail, 0.0123456) == 0.0123
    assert limits_text(hinge) == "-90 to 180°" and limits_text(rail) == "0 to 0.04 m"
    wheel = Joint("wheel", False, -math.inf, math.inf, 0)
    assert slider_bounds(wheel, 0.0) == (-180.0, 180.0) and slider_bounds(wheel, 4 * math.pi) == (
        -180.0,
        720.0,
    )
    assert limits_text(wheel) == "no limits, °"


def test_the_copied_text_reads_back_as_the_same_numbers(tmp_path: Path) -> None:
    qpos = np.random.default_rng(0).normal(size=9).astype(np.float32)
    root = np.array([-0.615, 0, 0.1, 1, 0, 0, 0], np.float32)
    names: dict[str, Any] = {"np": np, "sapien": sapien, "Keyframe": Keyframe}
    exec(qpos_code(qpos), names)
    np.testing.assert_array_equal(names["qpos"].astype(np.float32), qpos)
    entry = eval("{" + keyframe_code(qpos, root) + "}", names)["new"]
    np.testing.assert_array_equal(np.float32(entry.qpos), qpos)
    np.testing.assert_allclose([*entry.pose.p, *entry.pose.q], root, atol=1e-7)

"""Arms that follow the handles at their end effectors, in a session with a real worker."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tests.drive.session import jump, live_session, start_over, step, wait_until
from workbench.app.session import Session
from workbench.hands.commands import SetJoint, ToggleDriving, ToggleReach
from workbench.hands.reach import ArmDragged, Reach
from workbench.hands.state import Hands
from workbench.live.commands import PauseRun, PlayRun, UseControlMode
from workbench.live.history.moments import BY_HAND
from workbench.live.timeline_commands import UndoReset
from workbench.live.view import SessionView
from workbench.page.command import Refused

ARM = "panda/panda_hand_tcp"
WAY = np.array([0.05, 0.06, -0.05, 0, 0, 0, 0])
FAR = np.array([3.0, 0.0, 0.0, 0, 0, 0, 0])
KEY = 1, ARM


@pytest.fixture(scope="module")
def session(child_process: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    where = tmp_path_factory.mktemp("recordings")
    with live_session("PickCube-v1", where, num_envs=2, control_mode="pd_ee_delta_pose") as session:
        yield session


def reach(session: Session) -> Reach:
    return session.view().of(Hands).reach


def tool(view: SessionView) -> np.ndarray:
    """(N, 7) poses of the end effectors."""
    return view.step.poses[:, view.task.geometry.body_names.index(ARM)].astype(float)


def apart(view: SessionView, target: np.ndarray, env: int = 1) -> float:
    """Metres from the end effector of an env to a target."""
    return float(np.linalg.norm(tool(view)[env, :3] - target[:3]))


def drag(session: Session, target: np.ndarray, ends: bool = True) -> None:
    session.dispatch(ArmDragged(ARM, 1, tuple(map(float, target)), ends))


def fresh(session: Session) -> np.ndarray:
    """Pause at the first moment of seed 0, and show handles; return the (N, 7) poses of the end effectors."""
    if session.view().of(Hands).driving:
        session.do(ToggleDriving())
    session.change(action_source="hold", episode_end="continue", selected_env=1)
    start = tool(start_over(session, 0))
    if not reach(session).shown:
        session.do(ToggleReach())
    return start


def lead(session: Session, target: np.ndarray, near: float = 0.01) -> SessionView:
    """Play and lead the arm of env 1 until it is within `near` metres."""
    session.do(PlayRun())
    wait_until(session, lambda view: view.playing, "playing")
    drag(session, target)
    return wait_until(session, lambda view: apart(view, target) < near, "the arm at its target")


def test_an_arm_follows_while_the_envs_play_and_the_others_hold_still(session: Session) -> None:
    start = fresh(session)
    view = lead(session, start[1] + WAY)
    assert view.of(Hands).driving and view.settings.action_source == "sliders"
    assert np.abs(tool(view)[0] - start[0]).max() < 2e-3
    answer = wait_until(session, lambda view: view.of(Hands).reach.reached.get(KEY), "an answer")
    assert not answer.of(Hands).reach.reached[KEY].why
    assert view.step.action is not None and np.abs(view.step.action).max() <= 1, "it is led by the action"
    assert np.isfinite(view.step.reward[1]) and not view.timeline.undo.startswith("move")
    session.do(ToggleDriving())
    assert not reach(session).targets and session.view().settings.action_source == "hold"


@pytest.mark.parametrize("mode", ["pd_joint_pos", "pd_joint_target_delta_pos", "pd_ee_pose"])
def test_an_arm_follows_in_modes_of_joints_and_of_absolute_targets(session: Session, mode: str) -> None:
    session.do(PauseRun())
    session.do(UseControlMode(mode=mode))
    wait_until(session, lambda v: v.task.control_mode == mode and v.state == "paused", "the mode")
    start = fresh(session)
    view = lead(session, start[1] + WAY)
    assert np.abs(tool(view)[0] - start[0]).max() < 2e-3
    fresh(session)
    session.do(UseControlMode(mode="pd_ee_delta_pose"))
    wait_until(
        session, lambda v: v.task.control_mode == "pd_ee_delta_pose" and v.state == "paused", "the mode"
    )


def test_a_target_out_of_reach_is_told_with_what_is_left(session: Session) -> None:
    start = fresh(session)
    drag(session, start[1] + FAR, ends=False)
    view = wait_until(session, lambda view: KEY in view.of(Hands).reach.reached, "an answer")
    answer = view.of(Hands).reach.reached[KEY]
    assert answer.why and 2 < answer.metres < 3
    assert len(answer.links) == len(answer.poses) and ARM in answer.links
    drag(session, start[1] + WAY, ends=False)
    wait_until(session, lambda view: not view.of(Hands).reach.reached[KEY].why, "within reach again")
    np.testing.assert_array_equal(tool(session.view()), start)


def test_a_paused_arm_is_put_at_its_target_in_one_event_and_undone(session: Session) -> None:
    start = fresh(session)
    before = session.view()
    drag(session, start[1] + WAY / 2, ends=False)
    target = start[1] + WAY
    view = jump(session, lambda: drag(session, target))
    assert view.timeline.last == before.timeline.last + 1
    assert apart(view, target) < 0.01
    np.testing.assert_array_equal(view.step.poses[0], before.step.poses[0])
    assert not reach(session).targets and view.timeline.undo == f"move of {ARM} of env 1"
    moment = session.look(lambda run: run.past.history.at(view.timeline.last))
    assert moment.event_flags[1] == BY_HAND and not moment.event_flags[0]
    assert apart(step(session, 3), target) < 0.01, "it stays there"
    assert apart(jump(session, lambda: session.do(UndoReset())), start[1]) < 1e-6


def test_an_arm_stays_where_a_slider_has_put_it_afterwards(session: Session) -> None:
    start = fresh(session)
    lead(session, start[1] + WAY)
    session.do(PauseRun())
    session.do(SetJoint(robot="panda", joint=0, to=40.0))
    view = wait_until(session, lambda view: apart(view, start[1] + WAY) > 0.1, "the joint")
    assert not view.of(Hands).reach.targets
    assert apart(step(session, 5), tool(view)[1]) < 0.01


def test_why_a_move_fell_short_is_shown_until_the_reset(session: Session) -> None:
    start = fresh(session)
    jump(session, lambda: drag(session, start[1] + FAR))
    assert reach(session).reached[KEY].why
    start_over(session, 1)
    assert not reach(session).reached


def test_a_robot_without_an_arm_is_refused_in_words(
    child_process: None, tmp_path_factory: pytest.TempPathFactory
) -> None:
    where = tmp_path_factory.mktemp("recordings")
    with live_session("RotateValveLevel0-v1", where, num_envs=1) as session:
        with pytest.raises(Refused, match="dclaw"):
            session.do(ToggleReach())
        assert session.view().task.arms == ()


def test_each_of_several_robots_has_an_arm(
    child_process: None, tmp_path_factory: pytest.TempPathFactory
) -> None:
    where = tmp_path_factory.mktemp("recordings")
    with live_session("TwoRobotPickCube-v1", where, num_envs=1) as session:
        arms = [arm.body for arm in session.view().task.arms]
        assert len(arms) == 2
        session.do(ToggleReach())
        names = session.view().task.geometry.body_names
        before = session.view().step.poses[0, [names.index(arm) for arm in arms]].astype(float)
        target = before[1] + WAY
        view = jump(session, lambda: session.dispatch(ArmDragged(arms[1], 0, tuple(target.tolist()), True)))
        now = view.step.poses[0, [names.index(arm) for arm in arms]]
        assert np.linalg.norm(now[1, :3] - target[:3]) < 0.01
        np.testing.assert_allclose(now[0], before[0], atol=1e-6)

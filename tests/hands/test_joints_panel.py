"""The fold Joints of the Run tab."""

from __future__ import annotations

import math
from dataclasses import replace
from html import unescape
from typing import Any

import numpy as np
import pytest

from tests.drive.live import Live
from tests.drive.panels import Panels
from tests.drive.scenes import changed, running
from workbench.envs.keywords import HowMade, Keyword
from workbench.envs.robots import Joint, JointTarget, RobotDescription, RobotKeyframe, RobotLink
from workbench.hands.commands import DragJoint, SetJoint, UseKeyframe
from workbench.hands.joints import keyframe_code, qpos_code
from workbench.hands.joints_panel import PAST, TITLE, short_names, with_dragged_joint
from workbench.hands.state import DraggedJoint, Hands
from workbench.live.view import SessionView
from workbench.page.commands import TellUnfolded

HERE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
HAND = 2
"""Place of the hand among the bodies of `running`."""
ARM = RobotDescription(
    "arm",
    (
        Joint("arm_base", False, -math.inf, math.inf, 0),
        Joint("arm_lift", True, 0.0, 0.5, 1, JointTarget(1, 2.0, 0.25)),
    ),
    (RobotLink(0, -1, -1, HERE, HERE), RobotLink(HAND, 0, 1, HERE, HERE)),
    (RobotKeyframe("rest", (0.0, 0.1), None),),
)
MODES = (Keyword("control_mode", "choice", '"pd_joint_vel"', choices=('"pd_joint_vel"', '"pd_joint_pos"')),)


def view_of(*robots: RobotDescription, playing: bool = False, **changes: Any) -> SessionView:
    """Three envs with these robots; env 1 is selected."""
    view = running(3, selected_env=1, playing=playing, **changes)
    assert view.task is not None and view.step is not None
    task = replace(view.task, robots=robots, made=HowMade("arm", MODES))
    qpos = np.array([[0.0, 0.1], [math.pi, 0.2], [0.0, 0.3]], np.float32)
    return replace(view, task=task, step=replace(view.step, qpos=qpos))


def unfold(live: Live, view: SessionView) -> Panels:
    live.show(view)
    live.do(TellUnfolded(panel=TITLE))
    live.show(view)
    return live.part("Run")


def test_the_fold_says_how_many_joints_there_are_and_is_empty_until_it_is_unfolded(live_page: Live) -> None:
    live_page.show(view_of())
    assert not [label for label in live_page.folders() if label.startswith(TITLE)]
    live_page.show(replace(view_of(ARM), task_serial=2))
    assert f"{TITLE} \N{MIDDLE DOT} 2" in live_page.folders()
    assert not live_page.part("Run").shows("lift")


def test_each_joint_has_a_slider_with_its_unit_and_limits(live_page: Live) -> None:
    run = unfold(live_page, view_of(ARM))
    base, lift = run.field("base"), run.field("lift")
    assert base.value == 180.0 and base.bounds == (-180.0, 180.0)
    assert lift.value == pytest.approx(0.2) and lift.bounds == (0.0, 0.5)
    assert "0 to 0.5 m" in run.html("wb-field-slider") and "no limits, °" in run.html("wb-field-slider")


def test_each_of_several_robots_is_named_with_its_texts_to_copy_in_the_selected_env(live_page: Live) -> None:
    wrist = RobotDescription(
        "other", (Joint("wrist", True, 0.0, 1.0, 1),), (RobotLink(HAND, -1, -1, HERE, HERE),)
    )
    view = view_of(ARM, wrist)
    assert view.step is not None
    poses = view.step.poses.copy()
    poses[:, :, 0] = np.arange(3)[:, None] + np.arange(poses.shape[1]) / 8
    run = unfold(live_page, replace(view, step=replace(view.step, poses=poses)))
    assert f"{TITLE} \N{MIDDLE DOT} 2 robots" in live_page.folders()
    html = unescape(run.html())
    for text in (
        "<b>arm</b>",
        "<b>other</b>",
        qpos_code([math.pi, 0.2]),
        keyframe_code([math.pi, 0.2], poses[1, 0]),
        qpos_code([0.2]),
        keyframe_code([0.2], poses[1, HAND]),
    ):
        assert text in html


@pytest.mark.parametrize(
    ("names", "short"),
    [
        (["panda_joint1", "panda_finger_joint1"], ["joint1", "finger_joint1"]),
        (["left_hip_joint", "torso_joint"], ["left_hip", "torso"]),
        (["joint_f1_0", "joint_f2_0"], ["f1", "f2"]),
        (["hinge_1"], ["hinge_1"]),
        (["slider"], ["slider"]),
    ],
)
def test_names_leave_out_the_words_that_all_joints_share(names: list[str], short: list[str]) -> None:
    assert short_names(Joint(name, False, -1.0, 1.0, 0) for name in names) == short


def test_a_slider_drags_and_sets_its_joint(live_page: Live) -> None:
    run = unfold(live_page, view_of(ARM))
    live_page.do(DragJoint(robot="arm", joint=1, to=0.4))
    run.type("lift", 0.3)
    assert live_page.asked[-2:] == [
        DragJoint(robot="arm", joint=1, to=0.4),
        SetJoint(robot="arm", joint=1, to=0.3),
    ]


def test_keyframes_are_buttons_while_nothing_plays(live_page: Live) -> None:
    run = unfold(live_page, view_of(ARM))
    run.press("rest")
    assert live_page.asked[-1] == UseKeyframe(robot="arm", name="rest")
    live_page.show(view_of(ARM, playing=True))
    (button,) = [one for one in run.buttons() if one.text == "rest"]
    assert button.command is None


def test_while_it_plays_only_what_the_control_mode_drives_can_be_moved(live_page: Live) -> None:
    playing = view_of(ARM, playing=True)
    run = unfold(live_page, playing)
    assert run.field("base").off and not run.field("lift").off
    assert "choose pd_joint_pos under Control" in run.html("takes no positions for the disabled joints")
    sliders = replace(playing.settings, action_source="sliders")
    live_page.show(
        replace(playing, settings=sliders, slider_action=np.array([[0, 0], [0, -0.5], [0, 0]], np.float32))
    )
    assert run.field("lift").value == 0.0, "the slider shows the target"


def test_a_past_moment_shows_its_joints_and_sets_none(live_page: Live) -> None:
    view = view_of(ARM)
    past = replace(view, timeline=replace(view.timeline, shown=3))
    run = unfold(live_page, past)
    assert run.field("base").off and run.field("lift").off and run.field("lift").value == pytest.approx(0.2)
    assert run.html(PAST)


def test_a_dragged_joint_moves_its_links_in_the_view_of_the_chosen_envs() -> None:
    view = changed(view_of(ARM), hands=Hands(dragged=DraggedJoint("arm", (0, 2), 1, 0.5)))
    assert view.step is not None
    poses = with_dragged_joint(view, view.step.poses)
    # Prismatic joints move along x.
    np.testing.assert_allclose(poses[:, HAND, 0], [0.5, view.step.poses[1, HAND, 0], 0.5], atol=1e-6)
    others = np.arange(poses.shape[1]) != HAND
    np.testing.assert_array_equal(poses[:, others], view.step.poses[:, others])
    past = replace(view, timeline=replace(view.timeline, shown=3))
    np.testing.assert_array_equal(with_dragged_joint(past, view.step.poses), view.step.poses)

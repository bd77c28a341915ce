"""Driving a robot by keys."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.scenes import running
from tests.drive.session import live_session, start_over, wait_until
from workbench.app.session import Session
from workbench.hands.commands import ToggleDriving
from workbench.hands.drive_keys import KEYS, PAIRS, SHARE, bindings, driven_action
from workbench.hands.drive_panel import yaw_of
from workbench.hands.state import Driven, Hands, apply
from workbench.live.commands import PauseRun
from workbench.live.events import Send
from workbench.live.messages import SetSliderAction, Settings
from workbench.live.run import first_run
from workbench.task.description import ActionDimension, TaskOptions

ARM = tuple(ActionDimension(f"arm/{axis}", -1.0, 2.0) for axis in ("x", "y", "z", "rx", "ry", "rz"))
PANDA = (*ARM, ActionDimension("gripper/finger", -1.0, 1.0, zero_holds=False))
FLANGE = "panda/panda_hand"


@given(st.sets(st.sampled_from(KEYS)), st.floats(-math.pi, math.pi))
def test_values_are_within_the_bounds_and_opposite_keys_cancel(keys: set[str], yaw: float) -> None:
    dimensions, values = driven_action(PANDA, keys, yaw)
    assert dimensions == tuple(range(6))
    assert all(PANDA[k].low <= value <= PANDA[k].high for k, value in zip(dimensions, values, strict=True))
    both = {key for pair in PAIRS for key in pair}
    assert not any(driven_action(PANDA, both, yaw)[1])
    assert not any(driven_action(PANDA, (), yaw)[1])


@pytest.mark.parametrize(
    ("key", "yaw", "x", "y"),
    [
        ("w", 0.0, 2.0, 0.0),
        ("w", math.pi / 2, 0.0, 2.0),
        ("w", math.pi, -1.0, 0.0),
        ("d", math.pi, 0.0, 2.0),
        ("a", 0.0, 0.0, 2.0),
        ("a", math.pi / 2, -1.0, 0.0),
        ("w", math.pi / 4, 2.0 * math.sqrt(0.5), 2.0 * math.sqrt(0.5)),
    ],
)
def test_keys_move_an_end_effector_as_the_person_sees_it(key: str, yaw: float, x: float, y: float) -> None:
    assert driven_action(PANDA, (key,), yaw)[1][:2] == pytest.approx((SHARE * x, SHARE * y), abs=1e-9)


def test_the_gripper_changes_once_for_each_press_of_its_key() -> None:
    run = replace(first_run("push.py", TaskOptions(), 1, Settings()), task=running(1).task)
    hands, closes = Hands(driving=True), []
    for held in (("g",), ("g", "w"), ("w",), ("g",), ("g",), ()):
        hands, _ = apply(hands, Driven(held, 0.0), run)
        closes.append(hands.closes)
    assert closes == [True, True, True, False, False, False]


def slider_actions(effects: list[Any]) -> list[SetSliderAction]:
    """The slider actions that these effects send to the worker."""
    requests = [effect.request for effect in effects if isinstance(effect, Send)]
    return [request for request in requests if isinstance(request, SetSliderAction)]


def test_an_env_holds_still_when_another_is_selected_while_keys_are_held() -> None:
    task = running(2).task
    assert task is not None
    first = replace(first_run("push.py", TaskOptions(), 2, Settings()), task=replace(task, actions=PANDA))
    second = replace(first, settings=replace(first.settings, selected_env=1))
    hands, _ = apply(Hands(driving=True), Driven(("w",), 0.0), first)
    hands, effects = apply(hands, Driven(("w",), 0.0), second)
    values = {request.env_idx: request.values for request in slider_actions(effects)}
    assert any(values[1,]) and not any(values[0,])
    _, effects = apply(hands, Driven((), 0.0), second)
    assert [request.env_idx for request in slider_actions(effects)] == [(1,)]


def test_the_view_decides_no_other_number_than_x_and_y() -> None:
    joints = tuple(ActionDimension(f"arm/joint{k}", -1.0, 1.0) for k in range(9))
    assert {driven_action(joints, ("w",), yaw)[1] for yaw in (0.0, 1.0, 2.0)} == {(SHARE, 0, 0, 0, 0, 0, 0)}
    absolute = tuple(ActionDimension(one.name, -1.0, 1.0, zero_holds=False) for one in joints)
    assert not bindings(absolute)


@given(st.floats(-math.pi, math.pi), st.floats(-1.2, 1.2))
def test_the_yaw_is_that_of_the_camera(yaw: float, pitch: float) -> None:
    """A camera of viser looks along its z axis, with x to the right and y down."""
    ahead = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
    right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    matrix = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    from viser.transforms import SO3

    assert math.cos(yaw - yaw_of(SO3.from_matrix(matrix).wxyz)) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def session(child_process: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    where = tmp_path_factory.mktemp("recordings")
    with live_session("PickCube-v1", where, num_envs=2, control_mode="pd_ee_delta_pose") as session:
        yield session


def hand(session: Session) -> np.ndarray:
    """(N, 3) position of each hand."""
    view = session.view()
    return view.step.poses[:, view.task.geometry.body_names.index(FLANGE), :3]


def test_a_held_key_moves_the_robot_until_it_is_released_or_the_page_is_silent(session: Session) -> None:
    session.change(action_source="random", episode_end="reset", selected_env=1)
    session.do(PauseRun())
    start_over(session, 0)
    session.do(ToggleDriving())
    view = wait_until(session, lambda v: v.playing and v.settings.action_source == "sliders", "driving")
    assert view.of(Hands).driving and view.settings.episode_end == "continue"
    began = hand(session)[1].copy()
    for _ in itertools.repeat(None, 3):
        session.dispatch(Driven(("w",), 0))
        last = session.view().step_serial
        wait_until(session, lambda v, last=last: v.step_serial > last + 2, "steps")
    view = wait_until(session, lambda v: not v.of(Hands).keys, "the keys count as released")
    assert hand(session)[1, 0] > began[0] + 0.03
    wait_until(
        session,
        lambda v: v.slider_action is not None and not v.slider_action[1, :6].any(),
        "the robot holds still",
    )
    session.dispatch(Driven(("g",), 0))
    wait_until(
        session, lambda v: v.slider_action is not None and v.slider_action[1, 6] == -1, "the gripper closes"
    )
    session.dispatch(Driven((), 0))
    session.do(ToggleDriving())
    view = session.view()
    assert not view.of(Hands).driving
    assert (view.settings.action_source, view.settings.episode_end) == ("random", "reset")
    session.do(PauseRun())

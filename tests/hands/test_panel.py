"""Drags and buttons on the page, and the requests that the session gets."""

from __future__ import annotations

import re
from dataclasses import replace
from html import unescape

import numpy as np
import pytest

from tests.drive.hands import EYE, OFFSET, PAGE, Hands
from tests.drive.live import Live
from tests.drive.panels import Panels
from tests.drive.scenes import changed, running
from workbench.hands.commands import (
    BeginAgain,
    ChooseMovedEnvs,
    DiscardEpisode,
    KeepEpisode,
    SetBodyPosition,
    ToggleHandles,
    WriteBodyPose,
)
from workbench.hands.start_edit import BodyPose, StartEdit, StartWanted
from workbench.hands.state import BodyMoved, BodyPulled
from workbench.hands.state import Hands as State
from workbench.live.commands import SelectBody
from workbench.live.messages import PullBody
from workbench.page.command import Refused
from workbench.pictures.camera_conventions import quaternion_from_rpy, rpy_of
from workbench.record.saving_state import KeptEpisodes
from workbench.record.state import RecordingStatus
from workbench.task.description import ActionDimension, ArmDescription, Pulled
from workbench.task.write_edits import SourceEdit


def words_of(html: str) -> str:
    """The text of some HTML, with single spaces."""
    return " ".join(re.sub("<[^>]*>", "", html).split())


def test_a_paused_body_follows_the_pointer_parallel_to_the_ground(panels: Panels) -> None:
    hands, grabbed = Hands(panels), np.array([0.01, 0.0, 0.02])
    hands.drag(hands.pose[:3] + grabbed, np.array([0.3, 0.2, 0.52]), grabbed=grabbed)
    drawn = hands.redraw()[1, hands.geometry.body_names.index("cube")]
    # The ray from (1, 0, 1) comes down to the grabbed point's height of 0.04 at twice its length.
    np.testing.assert_allclose(drawn[:3], [-0.41, 0.4, 0.02], atol=1e-6)
    assert not hands.session.asked, "only the page shows it until the drag ends"
    end = np.array([0.4, 0.2, 0.04]) + OFFSET
    hands.panel.drag(PAGE, "end", end, end, EYE)
    (moved,) = hands.session.asked
    assert isinstance(moved, BodyMoved) and (moved.body, moved.env_idx) == ("cube", (1,))
    np.testing.assert_allclose(moved.pose, [0.39, 0.2, 0.02, 1, 0, 0, 0], atol=1e-6)
    np.testing.assert_array_equal(hands.redraw(), hands.poses)


def test_with_shift_a_paused_body_moves_up_and_down_only(panels: Panels) -> None:
    hands = Hands(panels)
    hands.drag(hands.pose[:3], np.array([0.505, 0.3, 0.7]), lifts=True)
    drawn = hands.redraw()[1, hands.geometry.body_names.index("cube")]
    assert drawn[:2] == pytest.approx(hands.pose[:2]) and drawn[2] > 0.5


@pytest.mark.parametrize(
    ("pointer", "lifts"), [([0.5, 0.0, 1.0], False), ([0.5, 0.0, 0.99], False), ([1.0, 0.0, 0.5], True)]
)
def test_a_pointer_at_the_horizon_moves_nothing(panels: Panels, pointer: list[float], lifts: bool) -> None:
    hands = Hands(panels)
    hands.drag(hands.pose[:3], np.array(pointer), lifts=lifts)
    np.testing.assert_allclose(hands.redraw(), hands.poses, atol=1e-6)


def test_a_small_kinematic_body_is_dragged_while_paused(panels: Panels) -> None:
    hands = Hands(panels, kind="kinematic")
    assert panels.nodes("/hands/grip")
    hands.drag(hands.pose[:3])
    end = np.array([0.4, 0.2, 0.02]) + OFFSET
    hands.panel.drag(PAGE, "end", end, end, EYE)
    (moved,) = hands.session.asked
    assert moved.pose[:3] == pytest.approx([0.4, 0.2, 0.02], abs=1e-6)


def test_a_drag_moves_the_body_of_the_env_in_which_it_began(panels: Panels) -> None:
    hands = Hands(panels)
    hands.drag(hands.pose[:3], np.array([0.3, 0.2, 0.1]))
    hands.view = replace(hands.view, settings=replace(hands.view.settings, selected_env=2))
    hands.session.shown = hands.view
    hands.redraw()
    end = np.array([0.4, 0.2, 0.1]) + OFFSET
    hands.panel.drag(PAGE, "end", end, end, EYE)
    (moved,) = hands.session.asked
    assert moved.env_idx == (1,)


def test_a_body_that_plays_on_is_where_the_env_has_it(
    panels: Panels, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(panels.server, "get_clients", lambda: {PAGE: object()})
    hands = Hands(panels)
    hands.drag(hands.pose[:3], np.array([0.3, 0.2, 0.1]))
    hands.panel.follow(hands.view)
    assert (hands.redraw() != hands.poses).any()
    hands.view = replace(hands.view, playing=True)
    hands.panel.follow(hands.view)
    np.testing.assert_array_equal(hands.redraw(), hands.poses)
    assert not hands.session.asked


def test_a_playing_body_is_pulled_at_the_grabbed_point_until_the_drag_ends(panels: Panels) -> None:
    hands, grabbed = Hands(panels, playing=True), np.array([0.0, 0.0, 0.02])
    hands.drag(hands.pose[:3] + grabbed, np.array([0.0, 0.0, 0.5]), grabbed=grabbed)
    pull = hands.session.asked[-1].pull
    assert (pull.body, pull.env) == ("cube", 1)
    np.testing.assert_allclose(pull.grabbed, grabbed, atol=1e-6)
    np.testing.assert_allclose(pull.target, [0, 0, 0.5], atol=1e-6)
    np.testing.assert_array_equal(hands.redraw(), hands.poses)
    assert [text for text in panels.labels() if text.endswith(" N")]
    hands.panel.drag(PAGE, "end", OFFSET, OFFSET, EYE)
    assert hands.session.asked[-1] == BodyPulled(PullBody())
    hands.redraw()
    assert not [text for text in panels.labels() if text.endswith(" N")]


def test_a_page_that_closes_during_a_pull_lets_go(panels: Panels) -> None:
    hands = Hands(panels, playing=True)
    hands.drag(hands.pose[:3])
    hands.panel.follow(hands.view)
    assert hands.session.asked[-1] == BodyPulled(PullBody())


def test_a_reset_ends_the_pull_and_the_drag_in_the_browser(
    panels: Panels, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(panels.server, "get_clients", lambda: {PAGE: object()})
    hands = Hands(panels, playing=True)

    def at_step(step: int) -> None:
        assert hands.view.step is not None
        elapsed = np.full(3, step, np.int32)
        hands.view = replace(hands.view, step=replace(hands.view.step, elapsed_steps=elapsed))
        hands.session.shown = hands.view
        hands.panel.follow(hands.view)
        hands.redraw()

    at_step(2)
    hands.drag(hands.pose[:3])
    (dragged,) = (node.name for node in panels.nodes("/hands/grip"))
    at_step(40)
    assert hands.session.asked[-1] != BodyPulled(PullBody())
    at_step(5)
    assert hands.session.asked[-1] == BodyPulled(PullBody())
    (now,) = (node.name for node in panels.nodes("/hands/grip"))
    assert now != dragged, "the browser would go on dragging the node"


TURNED = np.array([np.cos(0.3), 0.0, 0.0, np.sin(0.3)])


def test_the_handles_move_and_turn_the_body_of_their_env_when_the_drag_ends(panels: Panels) -> None:
    hands = Hands(panels)
    there = np.array([0.4, 0.2, 0.1, *TURNED])
    in_view = there + [*OFFSET, 0, 0, 0, 0]
    panels.turn("/hands/gizmo", np.array([*(hands.pose[:3] + OFFSET), 1, 0, 0, 0]), "start")
    panels.turn("/hands/gizmo", in_view)
    drawn = hands.redraw()
    np.testing.assert_allclose(drawn[1, hands.geometry.body_names.index("cube")], there, atol=1e-6)
    assert (drawn != hands.poses).any(axis=2).sum() == 1 and not hands.session.asked
    panels.turn("/hands/gizmo", in_view, "end")
    (moved,) = hands.session.asked
    assert moved == BodyMoved("cube", (1,), tuple(pytest.approx(one, abs=1e-6) for one in there))  # type: ignore[arg-type]
    np.testing.assert_array_equal(hands.redraw(), hands.poses)


def test_the_grip_and_the_handles_are_at_the_body_of_the_selected_env(panels: Panels) -> None:
    hands = Hands(panels, "table", kind="dynamic")
    hands.poses[1, hands.geometry.body_names.index("table")] = [
        0.1,
        0.2,
        0.3,
        np.sqrt(0.5),
        np.sqrt(0.5),
        0,
        0,
    ]
    hands.redraw()
    (grip,), (gizmo,) = panels.nodes("/hands/grip"), panels.nodes("/hands/gizmo")
    # The table's middle is 0.46 m below its origin; turned about x, that is along y.
    np.testing.assert_allclose(grip.position, np.array([0.1, 0.66, 0.3]) + OFFSET, atol=1e-6)
    np.testing.assert_allclose(grip.dimensions, 1.02 * np.array([1.2, 2.4, 0.92]), atol=1e-5)
    np.testing.assert_allclose(gizmo.position, np.array([0.1, 0.2, 0.3]) + OFFSET, atol=1e-6)
    for node in (grip, gizmo):
        np.testing.assert_allclose(node.wxyz, [np.sqrt(0.5), np.sqrt(0.5), 0, 0], atol=1e-6)


def test_the_force_is_that_of_the_pulled_body(panels: Panels) -> None:
    hands = Hands(panels, playing=True)
    hands.drag(hands.pose[:3], np.array([0.0, 0.0, 0.5]))
    for body, shown in (("cube", "3.25 N"), ("arm/hand", "0 N")):
        hands.view = replace(hands.view, pulled=Pulled(1, body, 3.25))
        hands.redraw()
        assert panels.labels() == [shown]
    (label,) = panels.nodes("/hands/force")
    np.testing.assert_allclose(label.position, np.array([0.0, 0.0, 0.5]) + OFFSET, atol=1e-6)


def test_another_page_does_not_take_the_body_out_of_the_hand(panels: Panels) -> None:
    hands = Hands(panels)
    hands.drag(hands.pose[:3])
    hands.panel.drag(PAGE + 1, "update", OFFSET, OFFSET + 1, EYE)
    np.testing.assert_array_equal(hands.redraw(), hands.poses)


@pytest.mark.parametrize(("body", "playing"), [("arm/hand", False), ("ground", False), ("table", True)])
def test_a_drag_of_what_does_not_move_is_refused(panels: Panels, body: str, playing: bool) -> None:
    hands = Hands(panels, body, playing)
    with pytest.raises(Refused):
        hands.drag(hands.pose[:3])
    assert not hands.session.asked


def test_a_typed_coordinate_moves_the_selected_body_in_one_env_or_in_all(live_page: Live) -> None:
    view = running(3, selected_env=2)
    live_page.show(view)
    with pytest.raises(Refused):
        live_page.page.do(SetBodyPosition(of="z", to=0.5), live_page.visitor)
    assert not live_page.part("Inspect").shows("Position")
    live_page.do(SelectBody(body="cube"))
    live_page.show(view)
    assert live_page.part("Inspect").shows("Position")
    live_page.do(SetBodyPosition(of="z", to=0.5))
    moved = live_page.asked[-1]
    assert isinstance(moved, BodyMoved) and moved.env_idx == (2,) and moved.pose[2] == 0.5
    live_page.do(ChooseMovedEnvs(all_envs=True))
    assert live_page.asked[-1] == ChooseMovedEnvs(all_envs=True)
    live_page.show(changed(view, hands=State(all_envs=True)))
    live_page.do(SetBodyPosition(of="x", to=0.1))
    assert live_page.asked[-1].env_idx == (0, 1, 2)


def test_the_numbers_are_those_of_the_selected_env_and_one_angle_turns_the_body_in_place(
    live_page: Live,
) -> None:
    view = replace(running(3, selected_env=2), playing=False)
    assert view.step is not None and view.task is not None
    poses, cube = view.step.poses.copy(), view.task.geometry.body_names.index("cube")
    poses[2, cube] = [0.1, -0.2, 0.3, *quaternion_from_rpy(10.0, 20.0, 30.0)]
    live_page.do(SelectBody(body="cube"))
    live_page.show(replace(view, step=replace(view.step, poses=poses)))
    inspect = live_page.part("Inspect")
    assert inspect.typed("Position") == pytest.approx((0.1, -0.2, 0.3))
    assert inspect.typed("Rotation") == pytest.approx((10, 20, 30), abs=0.01)
    inspect.type("Rotation", -40.0, at=1)
    moved = live_page.asked[-1]
    assert moved.body == "cube" and moved.env_idx == (2,)
    assert moved.pose[:3] == pytest.approx((0.1, -0.2, 0.3))
    assert rpy_of(np.array(moved.pose[3:])) == pytest.approx((10, -40, 30), abs=1e-3)
    live_page.do(WriteBodyPose())
    assert live_page.asked[-1] == StartWanted(BodyPose("cube", tuple(map(float, poses[2, cube]))))


def test_the_handles_are_shown_at_the_body_while_nothing_plays(live_page: Live) -> None:
    view = replace(running(2), playing=False)
    live_page.do(SelectBody(body="cube"))
    live_page.show(view)
    (gizmo,) = live_page.nodes("/hands/gizmo")
    assert not gizmo.visible
    live_page.do(ToggleHandles())
    live_page.show(view)
    assert gizmo.visible
    for shown in (replace(view, playing=True), replace(view, timeline=replace(view.timeline, shown=30))):
        live_page.show(shown)
        assert not gizmo.visible, "what a past moment or a running env holds is not moved"
        live_page.show(view)
        assert gizmo.visible


@pytest.mark.parametrize(
    ("body", "playing", "draggable"),
    [
        ("cube", False, True),
        ("cube", True, True),
        ("table", False, False),
        ("table", True, False),
        ("arm/hand", False, False),
        ("arm/hand", True, True),
    ],
)
def test_only_what_a_drag_would_move_takes_the_gesture_from_the_view(
    panels: Panels, body: str, playing: bool, draggable: bool
) -> None:
    Hands(panels, body, playing)
    assert bool(panels.nodes("/hands/grip")) == draggable


def test_a_driver_sees_the_keys_and_the_set_and_ends_episodes_by_buttons(live_page: Live) -> None:
    hands = State(driving=True, note="The episode of seed 3 (40 steps) is kept, with success.")
    recording = RecordingStatus(kept=KeptEpisodes(2, 1, 1))
    view = running(2)
    assert view.task is not None
    task = replace(view.task, actions=(ActionDimension("arm/x", -1.0, 1.0),))
    live_page.show(replace(view, task=task, features={State: hands, RecordingStatus: recording}))
    text = words_of(live_page.part("Run").html())
    for words in ("seed 3 (40 steps) is kept", "2 kept, 1 with success, 1 being saved", "W / S", "arm/x"):
        assert words in text
    for row in ("CYkeep", "XXdiscard", "ZBagain"):
        assert row in "".join(text.split())
    for command in (KeepEpisode(), DiscardEpisode(), BeginAgain()):
        live_page.do(command)
    assert live_page.asked[-3:] == [KeepEpisode(), DiscardEpisode(), BeginAgain()]


def test_the_sign_names_the_env_that_is_driven_and_what_the_gamepads_buttons_do(live_page: Live) -> None:
    live_page.show(replace(running(3, selected_env=2), features={State: State(driving=True)}))
    sign = live_page.html("data-drive")
    assert re.search(r"\benv 2\b", words_of(sign).lower())
    for button, command in ((1, "begin_again"), (2, "discard_episode"), (3, "keep_episode")):
        assert f'"{button}": "{command}"' in unescape(sign)
    live_page.show(replace(running(3, selected_env=2), features={State: State()}))
    assert not live_page.html("data-drive")


def test_driving_and_reaching_are_offered_to_robots_that_can(live_page: Live) -> None:
    view, run = running(2), live_page.part("Run")
    assert view.task is not None
    arms = (ArmDescription("arm/hand", ("a",)),)
    for actions, arms_of, drives, reaches in (
        (view.task.actions, arms, True, True),
        (view.task.actions, (), True, False),
        ((), (), False, False),
    ):
        live_page.show(
            replace(
                view,
                task=replace(view.task, actions=actions, arms=arms_of),
                task_serial=len(actions) + 9 * len(arms_of),
            )
        )
        offered = [run.button(name).command is not None for name in ("Drive by keys", "Reach")]
        assert offered == [drives, reaches]


@pytest.mark.parametrize("count", [7, 9])
def test_a_driver_sees_how_many_numbers_of_the_action_have_no_key(live_page: Live, count: int) -> None:
    view = running(2)
    assert view.task is not None
    actions = tuple(ActionDimension(f"body/joint{k}", -1.0, 1.0) for k in range(count))
    task = replace(view.task, actions=actions)
    live_page.show(replace(view, task=task, features={State: State(driving=True)}))
    text = words_of(live_page.part("Run").html())
    assert ("2 numbers" in text) == (count == 9)


def test_the_sliders_of_the_action_are_hidden_while_keys_drive(live_page: Live) -> None:
    view = running(2)
    assert view.task is not None
    task = replace(view.task, actions=(ActionDimension("arm/x", -1.0, 1.0),))
    settings = replace(view.settings, action_source="sliders")
    for driving in (False, True, False):
        live_page.show(replace(view, task=task, settings=settings, features={State: State(driving=driving)}))
        assert live_page.part("Run").shows("arm/x") != driving


def test_a_planned_pose_is_shown_as_a_diff_and_saved_by_its_button(live_page: Live) -> None:
    change = SourceEdit("/tasks/push.py", "a\np = [0, 0, 0]\n", "a\np = [0.1, 0, 0]\n", ("goal too",), None)
    edit = StartEdit("planned", 1, edit=change, message="This writes where cube begins.")
    view = running(3, selected_env=1)
    live_page.do(SelectBody(body="cube"))
    live_page.show(replace(view, playing=False, features={StartEdit: edit}))
    text = words_of(live_page.part("Inspect").html())
    for words in ("Write into the file", "p = [0.1, 0, 0]", "goal too", "Save to push.py"):
        assert words in text
    live_page.do(WriteBodyPose())
    wanted = live_page.asked[-1]
    assert isinstance(wanted, StartWanted) and wanted.wanted.of == "cube"

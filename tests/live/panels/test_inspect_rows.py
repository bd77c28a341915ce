from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.drive.live import Live
from tests.drive.scenes import running
from workbench.envs.inspection import Inspection, JointReadings, Leaf, Touching
from workbench.live.commands import HoverBody, SelectBody
from workbench.live.panels.inspect_panel import (
    CHOICES,
    MAX_ARROW_METRES,
    METRES_AT_ONE_NEWTON,
    arrows_of,
    inspect_html,
    joint_rows,
    pose_rows,
)
from workbench.page.commands import TellOpenTab


def leaf(name: str, *values: float, shape: tuple[int, ...] | None = None) -> Leaf:
    numbers = np.array(values, np.float32)
    return Leaf(name, numbers.shape if shape is None else shape, "float32", numbers, 0.0, 255.0)


JOINTS = JointReadings(
    articulation="arm",
    names=("turn", "free", "slide"),
    kinds=("revolute", "revolute_unwrapped", "prismatic"),
    position=np.array([0.5, 9.0, 0.04], np.float32),
    velocity=np.zeros(3, np.float32),
    target=np.array([0.0, np.nan, 0.02], np.float32),
    low=np.array([-1, -np.inf, 0], np.float32),
    high=np.array([1, np.inf, 0.04], np.float32),
)


def test_joints_are_shown_between_their_limits() -> None:
    turn, free, slide = (SimpleNamespace(**row) for row in joint_rows(JOINTS))
    assert (turn.place, turn.target_place, turn.at_limit) == (75.0, 50.0, False)
    assert turn.limits == "-1.000 to 1.000 rad"
    assert (free.place, free.target_place, free.at_limit, free.target) == (None, None, False, "")
    assert free.limits == "no limits, rad"
    assert (slide.place, slide.target_place, slide.at_limit) == (100.0, 50.0, True)
    assert slide.limits == "0.000 to 0.040 m"


PRESSED = Touching(
    ("cube", "<i>table</i>"),
    np.array([0, 3, 4], np.float32),
    np.array([0, 0.03, 0.04], np.float32),
    np.array([[0, 0, 0], [0.2, 0, 0]], np.float32),
    np.array([[0, 0, 4], [0, 0, 0]], np.float32),
    -0.001,
)


def test_a_contact_is_shown_in_newtons_with_its_position() -> None:
    html = inspect_html("contacts", running(1), Inspection(0, 5, contacts=(PRESSED,)), None)
    for words in (
        ">cube</b> ← &lt;i&gt;table&lt;/i&gt;",
        ">5 N<",
        "force 0.000, 3.000, 4.000; impulse 0.05 N s",
        "at 0.100, 0.000, 0.000; 2 points, 1.00 mm deep",
    ):
        assert words in html
    apart = replace(PRESSED, separation=0.001, points=np.zeros((0, 3), np.float32))
    html = inspect_html("contacts", running(1), Inspection(0, 5, contacts=(apart,)), None)
    assert "<br>at ; 0 points<" in html


def test_arrows_start_at_the_contact_points_and_are_limited() -> None:
    hard = Touching(
        ("a", "b"), PRESSED.force, PRESSED.impulse, np.ones((1, 3), np.float32), np.array([[1e6, 0, 0]]), 0.0
    )
    arrows = arrows_of(Inspection(0, 0, contacts=(PRESSED, hard)))
    # The point without a force has no arrow.
    four_newtons = 4 ** (1 / 3) * METRES_AT_ONE_NEWTON
    np.testing.assert_allclose(
        arrows, [[[0, 0, 0], [0, 0, four_newtons]], [[1, 1, 1], [1 + MAX_ARROW_METRES, 1, 1]]], rtol=1e-6
    )
    assert arrows_of(Inspection(0, 0)).shape == (0, 2, 3)


def test_a_pose_is_copied_as_python_that_recreates_it() -> None:
    poses = np.array([[0.1, -2, 0, 1, 0, 0, 0], [np.nan] * 7], np.float32)
    [row] = pose_rows(("cube", "absent"), poses)
    assert row["code"] == "sapien.Pose(p=[0.1, -2, 0], q=[1, 0, 0, 0])"


@pytest.mark.parametrize("choice", CHOICES)
def test_the_tab_never_shows_another_envs_reading_and_escapes_names(choice: str) -> None:
    now = Inspection(
        1,
        5,
        observation=(leaf("<script>x", 1),),
        state=(leaf("s", 1),),
        joints=(JOINTS,),
        contacts=(PRESSED,),
    )
    other = inspect_html(choice, running(3, selected_env=0), now, None)
    own = inspect_html(choice, running(3, selected_env=1), now, None)
    assert "step 5" not in other
    assert "<script>x" not in own and "<i>table</i>" not in own
    expected = {
        "joints": "slide",
        "contacts": "5 N",
        "bodies": "arm/hand",
        "observation": "&lt;script",
        "state": "s</b>",
    }
    if choice == "bodies":
        assert 'data-copy="sapien.Pose(p=[' in own
    if choice in expected:
        assert expected[choice] in own
        assert choice == "bodies" or expected[choice] not in other


def test_changes_since_the_last_reading_of_the_same_env_are_marked(live_page: Live) -> None:
    inspect = live_page.part("Inspect")
    inspect.set("Show", "state")

    def changed(env: int, step: int, value: float) -> int:
        reading = Inspection(env, step, state=(leaf("s", value),))
        live_page.show(running(2, selected_env=env, inspection=reading, step_serial=step))
        assert f"env {env} at step {step}" in inspect.html("wb-inspect")
        return inspect.html("wb-inspect").count("wb-changed")

    assert [
        changed(*one)
        for one in ((0, 1, 1.0), (0, 2, 2.0), (0, 3, 2.0), (1, 3, 5.0), (1, 4, 6.0), (0, 4, 9.0))
    ] == [0, 1, 0, 0, 1, 0]


def test_the_selected_body_is_shown_first_with_its_pose_and_its_contacts(live_page: Live) -> None:
    inspect = live_page.part("Inspect")
    reading = Inspection(1, 5, contacts=(PRESSED,))
    view = running(2, selected_env=1, inspection=reading)
    live_page.show(view)
    assert "wb-body" not in inspect.html()
    live_page.do(TellOpenTab(tab="Inspect"))
    live_page.do(SelectBody(body="cube"))
    assert "contacts" in live_page.asked[-1].sections
    live_page.show(view)
    body = inspect.html("wb-body")
    assert (
        'data-copy="sapien.Pose(p=[' in body
        and "touches <span" in body
        and "&lt;i&gt;table" in body
        and "5 N" in body
    )
    live_page.show(running(2, selected_env=0, inspection=reading))
    assert "5 N" not in inspect.html("wb-body"), "the contacts are of another env"
    live_page.do(SelectBody(body="gone"))
    live_page.show(view)
    assert "wb-body" not in inspect.html()


def test_the_body_of_the_row_under_the_pointer_is_marked_in_the_view(live_page: Live) -> None:
    view = running(2)
    live_page.show(view)

    def marked() -> list[str]:
        live_page.show(view)
        return [node.name for node in live_page.nodes("/hovered_body/")]

    assert not marked()
    live_page.do(HoverBody(body="cube"))
    assert marked()
    live_page.do(SelectBody(body="cube"))
    assert not marked(), "it has the mark of the selected body"
    live_page.do(SelectBody(body=""))
    live_page.do(HoverBody(body=""))
    assert not marked()


def test_only_chosen_quantities_are_read_and_contacts_for_the_arrows(live_page: Live) -> None:
    def chosen() -> tuple[str, ...]:
        return live_page.asked[-1].sections

    live_page.show(running(2))
    inspect = live_page.part("Inspect")
    assert not live_page.asked, "no page has opened the tab"
    inspect.set("Force arrows", "on this tab")
    assert chosen() == ()
    live_page.do(TellOpenTab(tab="Inspect"))
    inspect.set("Show", "state")
    live_page.again()
    assert chosen() == ("state", "contacts")
    live_page.do(TellOpenTab(tab="Reward"))
    assert chosen() == ()
    inspect.set("Force arrows", "on all tabs")
    assert chosen() == ("contacts",)
    inspect.set("Force arrows", "off")
    assert chosen() == ()
    live_page.do(TellOpenTab(tab="Inspect"))
    inspect.set("Show", "nothing")
    assert chosen() == ()

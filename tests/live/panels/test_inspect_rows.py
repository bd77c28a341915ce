from __future__ import annotations

import math
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.drive.live import Live
from tests.drive.scenes import running
from workbench.envs.inspection import BodyReadings, Inspection, JointReadings, Leaf, LinkJoint, Touching
from workbench.live.commands import HoverBody, SelectBody
from workbench.live.env_commands import ToggleOnlySelected
from workbench.live.panels.inspect_panel import (
    CHOICES,
    MAX_ARROW_METRES,
    METRES_AT_ONE_NEWTON,
    arrows_of,
    inspect_html,
    joint_rows,
    leaf_rows,
    number,
    pose_rows,
)
from workbench.live.past import TimelineView
from workbench.live.view import SessionView
from workbench.page.commands import TellOpenTab


def leaf(name: str, *values: float, shape: tuple[int, ...] | None = None) -> Leaf:
    numbers = np.array(values, np.float32)
    return Leaf(name, numbers.shape if shape is None else shape, "float32", numbers, 0.0, 255.0)


JOINTS = JointReadings(
    articulation="arm",
    names=("turn", "free", "slide"),
    kinds=("revolute", "revolute_unwrapped", "prismatic"),
    position=np.array([0.5, 9.0, 0.04], np.float32),
    velocity=np.array([1.5, 2.5, 3.5], np.float32),
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
    assert [row.velocity for row in (turn, free, slide)] == ["1.500", "2.500", "3.500"]
    low, *_ = joint_rows(replace(JOINTS, position=-JOINTS.high))
    assert (low["place"], low["at_limit"]) == (0.0, True)
    assert slide.limits == "0.000 to 0.040 m"


PRESSED = Touching(
    ("cube", "<i>table</i>"),
    np.array([0, 3, 4], np.float32),
    np.array([0, 0.03, 0.04], np.float32),
    np.array([[0, 0, 0], [0.2, 0, 0]], np.float32),
    np.array([[0, 0, 4], [0, 0, 0]], np.float32),
    -0.001,
)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        *((True, "yes"), (False, "no"), (7, "7"), (0.0, "0.000"), (-1.5, "-1.500"), (-0.0005, "-5.0e-04")),
        *((1e-7, "0.000"), (-12345.0, "-1.2e+04"), (math.nan, "NaN")),
    ],
)
def test_a_number_is_short(value: object, text: str) -> None:
    assert number(value) == text


def test_an_array_is_shown_whole_or_by_its_range() -> None:
    before = leaf("s", 1.0, math.nan, 3.0), leaf("big", 1.0, shape=(9, 9))
    now = leaf("s", 1.0, math.nan, 4.0), leaf("big", 1.0, shape=(9, 9)), leaf("new", 2.0)
    small, big, new = leaf_rows(now, before)
    shown = [(one["text"], one["changed"]) for one in small["numbers"]]
    assert shown == [("1.000", False), ("NaN", False), ("4.000", True)]
    assert big["numbers"] == () and re.findall(r"[\d.]+", big["note"]) == ["81", "0.000", "255.000"]
    assert [one["changed"] for one in new["numbers"]] == [False]
    (other,) = leaf_rows((leaf("s", 1.0, 2.0),), before)
    assert not any(one["changed"] for one in other["numbers"]), "it has another shape"


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
    poses = np.array([[0.1, -7.6e-4, -1e-6, 1, 0, 0, 0], [np.nan] * 7], np.float32)
    [row] = pose_rows(("cube", "absent"), poses)
    assert row["code"] == "sapien.Pose(p=[0.1, -0.00076, -0.000001], q=[1, 0, 0, 0])"
    assert row["p"] == "0.1000, -0.0008, 0.0000", "no exponent and no negative zero among plain numbers"


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


@pytest.mark.parametrize("section", ["state", "observation"])
def test_changes_since_the_last_reading_of_the_same_env_are_marked(live_page: Live, section: str) -> None:
    inspect = live_page.part("Inspect")
    inspect.set("Show", section)

    def changed(env: int, step: int, value: float) -> int:
        other = {"state": "observation", "observation": "state"}[section]
        values: Any = {section: (leaf("s", value),), other: (leaf("s", -step),)}
        reading = Inspection(env, step, **values)
        live_page.show(running(2, selected_env=env, inspection=reading, step_serial=step))
        assert f"env {env} at step {step}" in inspect.html("wb-inspect")
        return inspect.html("wb-inspect").count("wb-changed")

    assert [
        changed(*one)
        for one in (
            *((0, 1, 1.0), (0, 2, 2.0), (0, 3, 2.0), (1, 3, 5.0), (1, 4, 6.0), (1, 4, 6.0), (0, 4, 9.0)),
        )
    ] == [0, 1, 0, 0, 1, 1, 0], "another reading of a step is compared with the step before, too"


def test_the_selected_body_is_shown_while_there_is_one_and_its_contacts_are_read(live_page: Live) -> None:
    inspect = live_page.part("Inspect")
    view = running(2, selected_env=1, inspection=Inspection(1, 5, contacts=(PRESSED,)))
    live_page.show(view)
    assert "wb-body" not in inspect.html()
    live_page.do(TellOpenTab(tab="Inspect"))
    live_page.do(SelectBody(body="cube"))
    assert "contacts" in live_page.asked[-1].sections
    live_page.show(view)
    body = inspect.html("wb-body")
    assert 'data-copy="sapien.Pose(p=[' in body and "&lt;i&gt;table" in body and "5 N" in body
    live_page.do(SelectBody(body="gone"))
    live_page.show(view)
    assert "wb-body" not in inspect.html()


ORIGIN = np.zeros(3, np.float32)
PHYSICS = BodyReadings(
    "cube",
    mass=0.5,
    inertia=np.array([1, 2, 3], np.float32),
    centre_of_mass=np.array([0.1, 0.2, 0.3], np.float32),
    velocity=np.array([3, 4, 0], np.float32),
    angular_velocity=np.array([0, 0, 2], np.float32),
    has_gravity=False,
    shapes=("box", "convex mesh", "box"),
    materials=((0.1, 0.2, 0.3),),
    joint=LinkJoint("hinge", "revolute_unwrapped", -np.inf, np.inf, ORIGIN, ORIGIN),
)


def test_the_selected_body_has_its_own_physics_contacts_and_pose(live_page: Live) -> None:
    pair = replace(PRESSED, bodies=("arm/hand", "cube"))
    other = replace(pair, bodies=("ground", "table"))
    reading = Inspection(1, 5, contacts=(pair, other), body=PHYSICS)
    view = running(2, selected_env=1, inspection=reading)
    inspect = live_page.part("Inspect")
    live_page.do(SelectBody(body="cube"))

    def shown(view: SessionView) -> dict[str, str]:
        live_page.show(view)
        rows = re.findall(
            r"<tr><td>([\w ]+) <span class=\"wb-right wb-num\">([^<]*)<", inspect.html("wb-body")
        )
        return dict(rows)

    def pose() -> str:
        return re.findall(r"p ([-\d., ]+)<br>", inspect.html("wb-body"))[0]

    def touched() -> list[str]:
        return re.findall(r'title="Select it">([^<]*)<', inspect.html("wb-body"))

    facts = {
        "mass": "0.5 kg, no gravity",
        "inertia": "1, 2, 3 kg m²",
        "centre of mass": "0.100, 0.200, 0.300 m",
        "velocity": "5 m/s, 2 rad/s",
        "collision": "2 × box, convex mesh",
        "friction": "0.1 static, 0.2 dynamic; restitution 0.3",
        "joint": "hinge, revolute, no limits",
    }
    assert shown(view) == facts and touched() == ["arm/hand"] and pose() == "0.0100, 0.0000, 0.0200"
    assert inspect.presses(SelectBody(body="arm/hand"))
    slide = replace(PHYSICS, has_gravity=True, joint=LinkJoint("rail", "prismatic", 0.0, 2.0, ORIGIN, ORIGIN))
    later = shown(replace(view, inspection=replace(reading, body=slide), step_serial=2))
    assert (later["mass"], later["joint"]) == ("0.5 kg", "rail, prismatic, 0.000 to 2.000 m")
    assert view.step is not None
    moved = replace(view.step, poses=view.step.poses + np.float32(0.5))
    shown(replace(view, step=moved, step_serial=3))
    assert pose() == "0.5100, 0.5000, 0.5200", "it follows the body while joints are listed"
    past = replace(view, timeline=TimelineView(0, 9, 5, 0, 5, 9), step_serial=4)
    assert shown(past) and touched() == [], "the reading is live"
    assert shown(replace(view, settings=replace(view.settings, selected_env=0))) == {}
    assert pose() == "0.0000, 0.0000, 0.0200" and touched() == []
    assert shown(replace(view, inspection=replace(reading, body=replace(PHYSICS, name="table")))) == {}
    live_page.session.answers["segment"] = lambda: (4, 4)
    shown(replace(view, step_serial=5))
    assert touched() == [], "PhysX finds contacts while it steps"


def test_the_arrows_are_the_forces_on_the_selected_env_where_it_is_drawn(live_page: Live) -> None:
    live_page.do(ToggleOnlySelected())
    reading = Inspection(1, 5, contacts=(PRESSED,))
    view = running(4, selected_env=1, inspection=reading)
    live_page.part("Inspect").set("Force arrows", "on all tabs")

    def drawn(view: SessionView) -> np.ndarray | None:
        live_page.show(view)
        return next((node.points for node in live_page.nodes("/forces") if node.visible), None)

    arrows, (cube, *_) = drawn(view), live_page.bodies("cube")
    assert view.step is not None and arrows is not None and cube.batched_positions[1].any()
    offset = cube.batched_positions[1] - view.step.poses[1, 3, :3]
    assert abs(offset).max() > 0.1
    np.testing.assert_allclose(arrows, arrows_of(reading) + offset, atol=1e-6)
    past = replace(view, timeline=TimelineView(0, 9, 5, 0, 5, 9), step_serial=2)
    for hidden in (
        past,
        running(4, inspection=reading),
        replace(view, inspection=replace(reading, contacts=())),
    ):
        assert drawn(hidden) is None
        assert drawn(view) is not None
    assert drawn(replace(view, inspection=replace(reading, elapsed_steps=0))) is None, "it was reset"
    live_page.session.answers["segment"] = lambda: (4, 4)
    assert drawn(view) is None, "it was put back"
    live_page.session.answers["segment"] = lambda: (4, 5)
    assert drawn(view) is not None
    assert live_page.part("Inspect").typed("Force arrows") == "on all tabs"


def test_bodies_are_listed_by_kind_with_their_own_poses(live_page: Live) -> None:
    view = running(2, selected_env=1)
    inspect = live_page.part("Inspect")
    live_page.show(view)
    assert not inspect.shows("Find")
    inspect.set("Show", "bodies")

    def listed() -> dict[str, list[str]]:
        live_page.again()
        tables = inspect.html("wb-inspect").split("<thead>")[1:]
        return {
            re.findall(r"<th>([^ <]*)", one)[0]: re.findall(r"wb-num\">p ([^<]*)<", one) for one in tables
        }

    every = {
        "dynamic": ["0.0100, 0.0000, 0.0200"],
        "arm": ["0.0000, 0.0000, 0.5000"],
        "kinematic": ["0.0000, 0.0000, 0.0000"],
        "static": ["0.0000, 0.0000, 0.0000"],
    }
    assert listed() == every and list(listed()) == list(every) and inspect.typed("Show") == "bodies"
    for text, found in (
        ("CUB", ["dynamic"]),
        ("a", ["arm", "kinematic"]),
        ("nothing", []),
        ("", list(every)),
    ):
        inspect.type("Find", text)
        assert list(listed()) == found and inspect.typed("Find") == text


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

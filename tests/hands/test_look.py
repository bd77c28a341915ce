"""View tools for the selected body: hide, follow, frame, and measure the distance to another body."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.drive.hands import OFFSET, Hands
from tests.drive.live import Live
from tests.drive.panels import Panels
from tests.drive.scenes import running
from workbench.envs.inspection import BodyReadings, LinkJoint
from workbench.hands.commands import FrameBody, HideBody, MeasureFrom, ShowHiddenBodies, TrackBody
from workbench.hands.look import AXIS_METRES, BodyView
from workbench.live.commands import FindBodies, SelectBody
from workbench.page.command import Refused


@dataclass
class Camera:
    """The viewpoint of a page, which moves as viser's does."""

    _position: np.ndarray = field(default_factory=lambda: np.array([6.0, 0.0, 1.0]))
    look_at: np.ndarray = field(default_factory=lambda: np.array([5.0, 0.0, 0.0]))
    image_width: int = 800
    image_height: int = 600

    @property
    def position(self) -> np.ndarray:
        return self._position

    @position.setter
    def position(self, position: np.ndarray) -> None:
        self.look_at = self.look_at + position - self._position
        self._position = position


class Page:
    """The tools of the selected body on one page, `cube` selected in env 1 of 3."""

    def __init__(self, panels: Panels, monkeypatch: pytest.MonkeyPatch) -> None:
        self.panels, self.hands = panels, Hands(panels)
        self.client = SimpleNamespace(camera=Camera())
        self.camera = self.client.camera
        monkeypatch.setattr(panels.server, "get_clients", lambda: {1: self.client})
        self.part = BodyView(panels.server, lambda: "cube", lambda: self.hands.panel.selected, 1.0)
        self.draw(self.hands.poses)

    def draw(self, poses: np.ndarray) -> None:
        self.hands.panel.draw_in_view(self.hands.view, poses, OFFSET)
        self.part.draw_in_view(self.hands.view, poses, OFFSET, None)

    def do(self, command: object) -> None:
        self.part.do(command, SimpleNamespace(client=self.client))  # type: ignore[arg-type]

    def moved(self, by: list[float]) -> np.ndarray:
        poses = self.hands.poses.copy()
        poses[1, self.hands.geometry.body_names.index("cube"), :3] += np.array(by, np.float32)
        return poses


@pytest.fixture
def page(panels: Panels, monkeypatch: pytest.MonkeyPatch) -> Page:
    return Page(panels, monkeypatch)


def test_a_hidden_body_is_left_out_of_the_view_in_all_envs_until_it_is_shown(page: Page) -> None:
    geometry, poses = page.hands.geometry, page.hands.poses
    cube = geometry.body_names.index("cube")
    page.do(HideBody())
    shown = page.part.without_hidden(geometry, poses)
    assert np.isnan(shown[:, cube]).all()
    others = np.arange(len(geometry.body_names)) != cube
    np.testing.assert_array_equal(shown[:, others], poses[:, others])
    page.do(HideBody())
    np.testing.assert_array_equal(page.part.without_hidden(geometry, poses), poses)
    page.do(HideBody())
    page.do(ShowHiddenBodies())
    np.testing.assert_array_equal(page.part.without_hidden(geometry, poses), poses)


def test_the_viewpoint_follows_the_body_but_not_to_another_env(page: Page) -> None:
    page.draw(page.moved([0.1, 0, 0]))
    np.testing.assert_array_equal(page.camera.position, [6, 0, 1])
    page.do(TrackBody())
    page.draw(page.moved([0.1, 0, 0]))
    page.draw(page.moved([0.3, 0, 0.2]))
    np.testing.assert_allclose(page.camera.position, [6.2, 0, 1.2], atol=1e-6)
    np.testing.assert_allclose(page.camera.look_at, [5.2, 0, 0.2], atol=1e-6)
    page.hands.view = running(3, selected_env=2)
    page.draw(page.hands.poses)
    np.testing.assert_allclose(page.camera.position, [6.2, 0, 1.2], atol=1e-6)
    page.hands.view = running(3, selected_env=1)
    page.do(TrackBody())
    page.draw(page.hands.poses)
    page.draw(page.moved([0.5, 0, 0]))
    np.testing.assert_allclose(page.camera.position, [6.2, 0, 1.2], atol=1e-6)


def test_the_centre_of_mass_and_the_joint_are_drawn_in_the_frame_of_the_turned_body(page: Page) -> None:
    poses = page.moved([0.1, 0.2, 0.3])
    # A quarter turn about z: x of the body is y of the env.
    poses[1, page.hands.geometry.body_names.index("cube"), 3:] = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    place = poses[1, page.hands.geometry.body_names.index("cube"), :3] + OFFSET
    hinge = LinkJoint(
        "hinge", "revolute", 0, 1, np.array([0.1, 0, 0], np.float32), np.array([0, 0, 1], np.float32)
    )
    of_cube = BodyReadings(
        "cube", 1.0, None, np.array([0.02, 0, 0.01], np.float32), None, None, True, (), (), hinge
    )

    def drawn(read: BodyReadings | None) -> tuple[list, list]:
        page.hands.panel.draw_in_view(page.hands.view, poses, OFFSET)
        page.part.draw_in_view(page.hands.view, poses, OFFSET, read)
        return page.panels.nodes("/hands/mass"), page.panels.nodes("/hands/joint_axis")

    (mass,), (axis,) = drawn(of_cube)
    np.testing.assert_allclose(mass.position, place + [0, 0.02, 0.01], atol=1e-6)
    ends = place + [[0, 0.1, -AXIS_METRES], [0, 0.1, AXIS_METRES]]
    np.testing.assert_allclose(axis.points.reshape(2, 3), ends, atol=1e-6)
    for read in (replace(of_cube, name="arm/hand"), replace(of_cube, centre_of_mass=None, joint=None), None):
        assert drawn(read) == ([], [])


def test_the_measured_line_joins_the_bodies_of_the_selected_env(live_page: Live) -> None:
    view = running(3, selected_env=1)
    assert view.task is not None and view.step is not None
    live_page.do(SelectBody(body="arm/hand"))
    live_page.show(view)
    live_page.do(MeasureFrom())
    live_page.do(SelectBody(body="cube"))
    live_page.show(view)
    names = view.task.geometry.body_names
    hand, cube = (view.step.poses[1, names.index(name), :3] for name in ("arm/hand", "cube"))
    line, label = live_page.nodes("/hands/distance")
    start, end = np.array(line.points).reshape(2, 3)
    np.testing.assert_allclose(end - start, cube - hand, atol=1e-6)
    np.testing.assert_allclose(label.position, (start + end) / 2, atol=1e-5)
    (drawn,) = live_page.bodies("cube")
    np.testing.assert_allclose(drawn.batched_positions[-1], end, atol=1e-6)


def test_framing_looks_at_the_body_from_where_the_user_stands(page: Page) -> None:
    direction = page.camera.position - page.camera.look_at
    page.do(FrameBody())
    np.testing.assert_allclose(page.camera.look_at, page.hands.pose[:3] + OFFSET, atol=1e-5)
    now = page.camera.position - page.camera.look_at
    np.testing.assert_allclose(now / np.linalg.norm(now), direction / np.linalg.norm(direction), atol=1e-5)
    assert 0.1 < np.linalg.norm(now) < 1.5


def test_the_distance_between_two_bodies_is_that_of_their_frames(live_page: Live) -> None:
    view = running(3, selected_env=2)
    assert view.task is not None and view.step is not None
    names = view.task.geometry.body_names
    cube, hand = (view.step.poses[2, names.index(name), :3] for name in ("cube", "arm/hand"))
    live_page.show(view)
    with pytest.raises(Refused):
        live_page.page.do(MeasureFrom(), live_page.visitor)
    live_page.do(SelectBody(body="arm/hand"))
    live_page.show(view)
    live_page.do(MeasureFrom())
    live_page.do(SelectBody(body="cube"))
    live_page.show(view)
    assert f"{np.linalg.norm(cube - hand):.4f} m from arm/hand" in live_page.part("Inspect").html("m from")
    poses = view.step.poses.copy()
    poses[0, names.index("cube"), :3] = poses[0, names.index("arm/hand"), :3] + [0.3, 0, 0.4]
    view = replace(view, step=replace(view.step, poses=poses))
    live_page.show(view)
    live_page.show(replace(view, settings=replace(view.settings, selected_env=0)))
    assert "0.5000 m from arm/hand" in live_page.part("Inspect").html("m from")


def test_bodies_are_listed_under_their_articulation_and_found_by_a_part_of_their_name(
    live_page: Live,
) -> None:
    inspect = live_page.part("Inspect")
    inspect.set("Show", "bodies")
    live_page.show(running(1))
    assert ">arm/hand<" in inspect.html("wb-inspect") and ">cube<" in inspect.html("wb-inspect")
    live_page.do(FindBodies(text="HAND"))
    live_page.again()
    listed = inspect.html("wb-inspect")
    assert ">arm/hand<" in listed and ">cube<" not in listed

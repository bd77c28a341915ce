from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import viser
import websockets.sync.client
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drive.panels import Panels
from tests.drive.scenes import running, table_scene
from tests.drive.tabs import camera_message, handshake
from tests.drive.waiting import until
from workbench.envs.camera_data import Picture
from workbench.live.env_commands import ShowEnvs, ToggleOnlySelected
from workbench.live.panels.view_panel import ViewIcons, ViewPanel
from workbench.page.commands import ToggleTheme
from workbench.page.scene.bodies import DrawStyle
from workbench.page.scene.env_grid import lay_out
from workbench.page.scene.viewpoint import (
    FOV_RADIANS,
    Framing,
    ViewChoice,
    Viewpoint,
    frame_all,
    frame_box,
    frame_one,
)


@given(
    size=st.tuples(st.floats(0.05, 60), st.floats(0.05, 60), st.floats(0.05, 10)),
    aspect=st.floats(0.35, 3.5),
)
@settings(max_examples=80)
def test_the_whole_box_is_in_the_picture(size: tuple[float, float, float], aspect: float) -> None:
    low, high = -np.array(size) / 2, np.array(size) / 2
    viewpoint = frame_box(low, high, aspect)
    forward = viewpoint.look_at - viewpoint.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    picks = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
    corners = np.where(picks == 0, low, high) - viewpoint.position
    depth = corners @ forward
    assert (depth > 0).all()
    assert (corners @ up <= np.tan(FOV_RADIANS / 2) * depth).all()
    assert (corners @ up >= -np.tan(FOV_RADIANS / 2) * depth).all()
    assert (np.abs(corners @ right) <= np.tan(FOV_RADIANS / 2) * aspect * depth).all()


@pytest.mark.parametrize("num_envs", [2, 16, 64])
def test_there_is_room_for_the_labels_under_the_front_envs(num_envs: int) -> None:
    layout = lay_out(*table_scene(num_envs))
    viewpoint = frame_all(layout)
    forward = viewpoint.look_at - viewpoint.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    up = np.cross(right / np.linalg.norm(right), forward)
    low, high = layout.box_of_all()
    label = np.array([high[0], (low[1] + high[1]) / 2, layout.floor_height]) - viewpoint.position
    assert label @ up / (label @ forward) > -0.94 * np.tan(FOV_RADIANS / 2)


def test_the_human_camera_s_picture_fits_the_view() -> None:
    geometry, poses = table_scene(1)
    pose = np.array([1.5, 0.2, 0.4, 0, 0, 0, 1], np.float32)
    picture, fovy = Picture("render_camera", "human", 0, pose), 1.0
    viewpoint = frame_one(lay_out(geometry, poses), picture, 1.25, fovy)
    layout = lay_out(geometry, poses)
    depth = 1.5 - float(layout.low[0] + layout.high[0]) / 2
    away = viewpoint.position[0] - (1.5 - depth)
    for part, place in ((0.0, 0.0), (1.0, 1.0), (-1.0, -1.0)):
        # A point of the middle plane at the picture's middle, top and bottom: where it is in the view, -1 to 1.
        z = 0.4 + part * depth * np.tan(fovy / 2)
        assert abs((z - viewpoint.position[2]) / (away * np.tan(FOV_RADIANS / 2)) - place) < 1e-5


def test_a_single_env_is_seen_from_the_tasks_human_camera() -> None:
    geometry, poses = table_scene(1)
    # At x = 1.5, rotated by pi about z: it looks along -x.
    pose = np.array([1.5, 0.2, 0.4, 0, 0, 0, 1], np.float32)
    viewpoint = frame_one(lay_out(geometry, poses), Picture("render_camera", "human", 0, pose))
    np.testing.assert_allclose(viewpoint.position, pose[:3], atol=1e-6)
    towards = viewpoint.look_at - viewpoint.position
    np.testing.assert_allclose(towards / np.linalg.norm(towards), [-1, 0, 0], atol=1e-6)


def test_a_page_is_reframed_on_resize_until_the_user_moves_the_view(
    server: viser.ViserServer,
) -> None:
    framing = Framing(server)

    def frame(aspect: float) -> Viewpoint:
        return frame_box(np.full(3, -1.0), np.full(3, 1.0), aspect)

    framing.frame(frame)
    address, arguments = handshake(f"http://127.0.0.1:{server.get_port()}")
    with websockets.sync.client.connect(address, close_timeout=0.1, **arguments) as page:

        def shows(width: int, position: np.ndarray) -> np.ndarray:
            """The camera position after the page reported this width."""
            page.send(camera_message(position.tolist(), width))
            until(
                lambda: any(one.camera.image_width == width for one in server.get_clients().values()),
                "its width",
            )
            framing.follow()
            framing.frame_untouched(frame)
            (client,) = server.get_clients().values()
            return np.array(client.camera.position)

        at = np.array(server.initial_camera.position)
        for narrower in (600, 500, 400):
            before, at = at, shows(narrower, at)
            assert np.linalg.norm(at) != np.linalg.norm(before), narrower
        assert np.allclose(at, frame(400 / 720).position)
        begins = np.array(server.initial_camera.position)
        assert np.allclose(shows(399, begins), frame(399 / 720).position), "where it begins came after"
        moved = at + 0.1
        assert np.allclose(shows(300, moved), moved), "the user's view is kept"
        (client,) = server.get_clients().values()
        for what in ("live", "review"):
            assert framing.is_new(what)
            if what == "review":
                framing.frame_new(frame)
        assert not np.allclose(client.camera.position, moved)
        assert framing.is_new("live")
        framing.frame_new(frame)
        assert np.allclose(client.camera.position, moved), "the view is kept after the review"


def test_a_narrow_view_stands_farther_back_and_without_a_human_camera_the_actors_fill_it() -> None:
    layout = lay_out(*table_scene(1))
    pose = np.array([1.5, 0.2, 0.4, 0, 0, 0, 1], np.float32)
    picture = Picture("render_camera", "human", 0, pose)
    wide, narrow = (frame_one(layout, picture, aspect) for aspect in (2.0, 0.5))
    np.testing.assert_allclose(wide.look_at, narrow.look_at, atol=1e-6)
    away = [np.linalg.norm(one.position - one.look_at) for one in (wide, narrow)]
    assert away[1] == pytest.approx(2 * away[0])
    behind = frame_one(
        layout, Picture("render_camera", "human", 0, np.array([-9, 0, 0.4, 0, 0, 0, 1], np.float32))
    )
    assert behind.look_at[0] < -9, "a camera that looks away still looks ahead"
    box = np.array([-0.1, -0.1, 0.0]), np.array([0.1, 0.1, 0.2])
    assert (
        frame_one(layout, None, 1.5, acting=box).position.tolist() == frame_box(*box, 1.5).position.tolist()
    )
    assert (
        frame_one(layout, None, 1.5).position.tolist()
        == frame_box(layout.low, layout.high, 1.5).position.tolist()
    )


class Pages:
    """A stub server with open pages."""

    def __init__(self, *numbers: int) -> None:
        self.initial_camera = SimpleNamespace(position=np.zeros(3), look_at=np.zeros(3))
        self.open = {number: self._page(number) for number in numbers}

    def _page(self, number: int) -> Any:
        at = SimpleNamespace(position=np.zeros(3), look_at=np.zeros(3), image_width=800, image_height=720)
        return SimpleNamespace(client_id=number, camera=at)

    def comes(self, number: int) -> Any:
        page = self.open[number] = self._page(number)
        page.camera.position = np.array(self.initial_camera.position)
        return page

    def get_clients(self) -> dict[int, Any]:
        return dict(self.open)


def test_each_page_keeps_its_own_view_of_each_scene() -> None:
    pages = Pages(1, 2)
    framing = Framing(cast(Any, pages))
    eyes = [pages.open[number].camera for number in (1, 2)]

    def shows(what: str, x: float) -> None:
        if framing.is_new(what):
            framing.frame_new(lambda aspect: Viewpoint(np.array([x, 0.0, 1.0]), np.array([x, 0.0, 0.0])))

    shows("one", 10.0)
    assert [eye.position[0] for eye in eyes] == [10, 10] and pages.initial_camera.position[0] == 10
    assert framing.pointed == {1, 2} and framing.follow() == 2
    eyes[1].position, eyes[1].look_at = np.array([11.0, 5, 5]), np.array([1.0, 2, 3])
    shows("one", 99.0)
    assert [eye.position[0] for eye in eyes] == [10, 11], "the same scene is not framed again"
    shows("two", 20.0)
    assert [eye.position[0] for eye in eyes] == [20, 20]
    shows("one", 30.0)
    assert [eye.position.tolist() for eye in eyes] == [[30, 0, 1], [11, 5, 5]] and eyes[
        1
    ].look_at.tolist() == [1, 2, 3]
    shows("two", 40.0)
    assert [eye.position[0] for eye in eyes] == [40, 40], "it was not moved there"
    late = pages.comes(3).camera
    assert late.position[0] == 40
    framing.frame(lambda aspect: Viewpoint(np.array([50.0, 0, 1]), np.zeros(3)), untouched_only=True)
    assert [eye.position[0] for eye in (*eyes, late)] == [50, 50, 50]
    eyes[0].position = np.array([7.0, 7, 7])
    framing.frame(lambda aspect: Viewpoint(np.array([60.0, 0, 1]), np.zeros(3)), untouched_only=True)
    assert [eye.position[0] for eye in (*eyes, late)] == [7, 60, 60]
    del pages.open[2]
    assert framing.follow() == 2 and framing.pointed == {1, 3}


def test_an_untouched_page_is_framed_again_only_when_its_shape_changes() -> None:
    pages, framed = Pages(1), list[float]()
    framing, eye = Framing(cast(Any, pages)), pages.open[1].camera

    def frame(aspect: float) -> Viewpoint:
        framed.append(aspect)
        return Viewpoint(np.array([aspect, 0.0, 1.0]), np.zeros(3))

    framing.frame(frame)
    for width, times in ((800, 0), (830, 0), (900, 1), (900, 1), (0, 2)):
        eye.image_width = width
        before = len(framed) if width == 800 else before  # noqa: F821
        framing.frame_untouched(frame)
        assert len(framed) == before + times, width
    assert framed[-1] == pytest.approx(1.385), "a folded view has no shape"
    eye.position = eye.position + 1
    eye.image_width = 300
    framing.frame_untouched(frame)
    assert len(framed) == before + 2


def test_choices_of_the_view_apply_to_later_pages(panels: Panels) -> None:
    choice = ViewChoice()
    panel = ViewPanel(panels.server, dark=True, chosen=choice)
    panels.visitors.do = panel.do
    panels.set("Detail", "coarse")
    panels.set("Theme", "light")
    panel.draw(running(4))
    assert [panels.field(name).value for name in ("Detail", "Theme")] == ["coarse", "light"]
    assert panel.looks == DrawStyle(50_000, False)
    panels.do(ToggleTheme())
    panel.draw(running(4))
    assert panels.field("Theme").value == "dark"
    with panels.server.gui.add_folder("The next page"):
        assert ViewPanel(panels.server, chosen=choice).looks == DrawStyle(50_000, True)


def test_the_selected_env_or_all_envs_are_shown_as_chosen_for_the_task(panels: Panels) -> None:
    choice = ViewChoice()
    icons = ViewIcons(panels.server, choice, "push.py")
    panels.visitors.do = icons.do
    icons.draw(running(1))
    assert "env 0" not in panels.html("wb-view-icons"), "there is nothing to choose of a single env"
    icons.draw(running(4))
    assert icons.only_selected and "env 0" in panels.html("wb-view-icons")
    panels.ask(ShowEnvs(all_envs=True))
    assert not icons.only_selected
    assert not ViewIcons(panels.server, choice, "push.py").only_selected, "also after the review"
    assert ViewIcons(panels.server, choice, "pick.py").only_selected
    panels.ask(ShowEnvs(all_envs=False))
    assert icons.only_selected


def test_each_part_of_the_view_is_switched_on_and_off_by_its_icon(panels: Panels) -> None:
    choice = ViewChoice()
    icons = ViewIcons(panels.server, choice, "push.py")
    panels.visitors.do = icons.do
    icons.draw(running(4))
    assert "Collision shapes" not in panels.html("wb-view-icons"), "the scene has none besides its visuals"
    bare = running(4)
    assert bare.task is not None
    geometry = replace(bare.task.geometry, collisions=bare.task.geometry.visuals[:1])
    view = replace(bare, task=replace(bare.task, geometry=geometry))
    icons.draw(view)

    def pressed() -> dict[str, bool]:
        on = {name: panels.button(name).pressed for name in ("Cameras", "Frames", "Collision shapes")}
        assert on == dict(zip(on, (choice.frustums, choice.frames, choice.collisions), strict=True))
        return on

    first = pressed()
    for name in first:
        for on in (not first[name], first[name]):
            panels.press(name)
            icons.draw(view)
            assert pressed() == {**first, name: on}
    for all_envs in (True, False):
        panels.ask(ShowEnvs(all_envs=all_envs))
        icons.draw(replace(view, settings=replace(view.settings, selected_env=3)))
        on = {one.text.strip(): one.pressed for one in panels.buttons()}
        assert (on["All envs"], on["The selected env"]) == (all_envs, not all_envs)
        assert "env 3" in panels.html("wb-view-icons")
    for _ in range(2):
        before_toggle = icons.only_selected
        panels.do(ToggleOnlySelected())
        assert icons.only_selected != before_toggle

from __future__ import annotations

from dataclasses import replace

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
from workbench.page.commands import ShowCollisions, ShowFrames, ShowFrustums, ToggleTheme
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
    panels.do(ToggleOnlySelected())
    assert icons.only_selected
    panels.ask(ShowFrustums(on=False))
    assert not choice.frustums
    panels.ask(ShowFrames(on=True))
    assert choice.frames
    assert "Collision shapes" not in panels.html("wb-view-icons"), "the scene has none besides its visuals"
    bare = running(4)
    assert bare.task is not None
    geometry = replace(bare.task.geometry, collisions=bare.task.geometry.visuals[:1])
    icons.draw(replace(bare, task=replace(bare.task, geometry=geometry)))
    assert "Collision shapes" in panels.html("wb-view-icons")
    panels.ask(ShowCollisions(on=True))
    assert choice.collisions

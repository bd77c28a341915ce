"""The Cameras tab, drawn from hand-made views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.drive.panels import Clock, Panels
from tests.drive.scenes import camera, description, running, table_scene
from workbench.cameras.commands import ShowPictures
from workbench.cameras.panel import CamerasPanel
from workbench.cameras.view import ShownCameras, shown_cameras
from workbench.envs.camera_data import CameraInfo, Picture
from workbench.live.messages import CameraRequest

POSE = np.array([0, 0, 1, 1, 0, 0, 0], np.float32)


BASE, TOP = "base · sensor", "top · sensor"


def seen(serial: int, cameras: tuple[CameraInfo, ...], pictured: bool = True) -> ShownCameras | None:
    pictures = {
        (c.kind, c.name): Picture(c.name, c.kind, 0, POSE, np.zeros((6, 8, 3), np.uint8)) for c in cameras
    }
    view = running(
        1,
        task=description(table_scene(1)[0], cameras),
        cameras_serial=serial,
        pictures=pictures if pictured else {},
        pictures_serial=serial,
    )
    return shown_cameras(view)


def test_a_remaining_camera_keeps_its_place_its_ticks_and_its_picture(panels: Panels, clock: Clock) -> None:
    panel = CamerasPanel(panels.server, clock=clock)
    panels.visitors.do = panel.do
    panel.draw(seen(1, (camera("base"), camera("hand"))))
    base = panels.part(BASE)
    base.set("depth", True)
    (image,) = base.images()
    clock.passes()
    both = seen(2, (camera("top"), replace(camera("base"), width=640)))
    panel.draw(both)
    assert panels.folders() == [TOP, BASE]
    assert base.field("depth").value and base.images() == [image]
    assert "640 × 6" in base.html()
    assert panel.wanted(both) == (
        CameraRequest("top", "sensor", ("rgb",)),
        CameraRequest("base", "sensor", ("rgb", "depth")),
    )
    # Other modalities mean other tick boxes.
    panel.draw(seen(3, (replace(camera("base"), modalities=("rgb",)),)))
    assert panels.folders() == [BASE] and not base.shows("depth") and base.images() != [image]


def test_ticked_pictures_are_requested_and_stay_ticked_while_their_camera_is_gone(panels: Panels) -> None:
    panel = CamerasPanel(panels.server)
    panels.visitors.do = panel.do
    panel.draw(None)
    panel.draw(seen(1, (camera("base"),)))
    assert panel.wanted(seen(1, (camera("base"),))) == (CameraRequest("base", "sensor", ("rgb",)),)
    base = panels.part(BASE)
    base.set("rgb", False)
    base.set("segmentation", True)
    panel.draw(seen(1, (camera("base"),)))
    assert panel.wanted(seen(1, (camera("base"),))) == (CameraRequest("base", "sensor", ("segmentation",)),)
    assert not base.field("rgb").value
    panel.draw(seen(2, (camera("top"),)))
    panel.draw(seen(3, (camera("base"),)))
    assert panel.wanted(seen(1, (camera("base"),))) == (CameraRequest("base", "sensor", ("segmentation",)),)
    panels.do(ShowPictures(kind="sensor", name="base", modality="albedo", on=True))
    assert panels.client.notices == ["There is no sensor camera base with the modality albedo."]


def test_pictures_of_another_moment_are_marked(panels: Panels) -> None:
    panel = CamerasPanel(panels.server)
    cameras = (camera("base"),)
    panel.draw(seen(1, cameras))
    assert "another moment" not in panels.html()
    panel.draw(seen(1, cameras, pictured=False))
    assert "another moment" in panels.html() and "wb-other-moment" in panels.html()
    panel.draw(seen(1, cameras))
    assert "another moment" not in panels.html()


def test_frequent_pictures_have_the_panels_width_and_the_last_full_size(panels: Panels, clock: Clock) -> None:
    panel = CamerasPanel(panels.server, clock=clock)

    moving = seen(1, (camera("base"),))
    assert moving is not None

    def width_drawn(serial: int, moving: ShownCameras = moving) -> int:
        panel.draw(
            replace(moving, pictures_serial=serial, pictures=dict.fromkeys(moving.pictures, new_picture()))
        )
        (image,) = panels.part(BASE).images()
        return image.image.shape[1]

    def new_picture() -> Picture:
        return Picture("base", "sensor", 0, POSE, np.zeros((600, 1000, 3), np.uint8))

    assert width_drawn(1) == 1000, "the first picture has full size"
    clock.passes(0.1)
    assert width_drawn(2) == 400
    clock.passes(0.1)
    assert width_drawn(3) == 400
    (image,) = panels.part(BASE).images()
    clock.passes(0.2)
    panel.draw(replace(moving, pictures_serial=3))
    assert image.image.shape == (240, 400, 3)
    clock.passes(0.3)
    panel.draw(replace(moving, pictures_serial=3))
    assert image.image.shape == (600, 1000, 3)


def test_few_pictures_are_sent_while_no_page_shows_the_tab(panels: Panels, clock: Clock) -> None:
    """None is requested for the Studio; ticked pictures are still requested, for the frustums in the view."""
    is_shown = False
    panel = CamerasPanel(panels.server, is_shown=lambda: is_shown, clock=clock)
    panels.visitors.do = panel.do

    def draw(serial: int) -> ShownCameras:
        view = seen(1, (camera("base"),))
        assert view is not None
        pictures = dict.fromkeys(
            view.pictures, Picture("base", "sensor", 0, POSE, np.full((6, 8, 3), serial, np.uint8))
        )
        view = replace(view, placed=("sensor", "base"), pictures_serial=serial, pictures=pictures)
        panel.draw(view)
        return view

    def shown() -> int:
        (image,) = panels.part(BASE).images()
        return int(np.asarray(image.image).mean())

    view = draw(10)
    assert shown() == 10 and panel.wanted(view) == (CameraRequest("base", "sensor", ("rgb",)),)
    clock.passes(0.5)
    draw(20)
    assert shown() == 10
    clock.passes(5)
    draw(30)
    assert shown() == 30
    is_shown = True
    clock.passes(0.5)
    draw(40)
    assert shown() == 40
    panels.do(ShowPictures(kind="sensor", name="base", modality="rgb", on=False))
    assert panel.wanted(view) == (CameraRequest("base", "sensor", ("rgb",)),), "the Studio's"
    is_shown = False
    assert panel.wanted(view) == ()

"""The Cameras tab, drawn from hand-made views."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np

from tests.drive.panels import Clock, Panels
from tests.drive.scenes import camera, description, running, table_scene
from workbench.cameras.commands import ShowPictures
from workbench.cameras.panel import CameraPick, CamerasPanel, StudioPicture
from workbench.cameras.view import (
    PickedPixel,
    ShownCameras,
    StudioCamera,
    StudioResults,
    StudioView,
    shown_cameras,
)
from workbench.envs.camera_data import CameraInfo, CameraKey, CameraSettings, Picture
from workbench.live.messages import CameraRequest
from workbench.live.view import SessionView

POSE = np.array([0, 0, 1, 1, 0, 0, 0], np.float32)


BASE, TOP = "base · sensor", "top · sensor"


def seen(serial: int, cameras: tuple[CameraInfo, ...], pictured: bool = True) -> ShownCameras:
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
    shown = shown_cameras(view)
    assert shown is not None
    return shown


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
    assert panel.wanted(replace(view, preview=True)) == (), "a preview is drawn apart"
    is_shown = False
    assert panel.wanted(view) == ()


def test_only_the_selected_envs_pictures_of_ticked_cameras_and_of_the_studios_are_frustums(
    panels: Panels,
) -> None:
    panel = CamerasPanel(panels.server)
    panels.visitors.do = panel.do
    view = seen(1, (camera("base"), camera("hand"), camera("top")))
    panel.draw(view)
    assert {name for _, name in panel.shown_pictures(view)} == {"base"}, "the first is ticked"
    assert {name for _, name in panel.shown_pictures(replace(view, placed=("sensor", "top")))} == {
        "base",
        "top",
    }
    panels.do(ShowPictures(kind="sensor", name="base", modality="rgb", on=False))
    panels.do(ShowPictures(kind="sensor", name="hand", modality="depth", on=True))
    assert {name for _, name in panel.shown_pictures(view)} == {"hand"}
    assert panel.shown_pictures(replace(view, env=1)) == {}


def test_a_picture_of_another_env_is_neither_drawn_nor_unmarked(panels: Panels, clock: Clock) -> None:
    panel = CamerasPanel(panels.server, clock=clock)
    view = seen(1, (camera("base"),))
    panel.draw(view)
    (image,) = panels.part(BASE).images()
    clock.passes()
    white = Picture("base", "sensor", 1, POSE, np.full((6, 8, 3), 255, np.uint8))
    panel.draw(replace(view, pictures={("sensor", "base"): white}, pictures_serial=2))
    assert int(np.asarray(image.image).max()) == 0 and "wb-other-moment" in panels.html()
    clock.passes()
    panel.draw(replace(view, pictures={("sensor", "base"): white}, pictures_serial=2, env=1))
    assert int(np.asarray(image.image).max()) == 255 and "wb-other-moment" not in panels.html()


def test_what_the_task_hides_is_named_at_sensors_and_a_failing_camera_shows_why(panels: Panels) -> None:
    panel = CamerasPanel(panels.server)
    view = seen(1, (camera("base"), camera("people", "human")))
    panel.draw(view)
    panel.draw(replace(view, hidden=("goal",), failed={("sensor", "base"): "It has no such texture."}))
    base, people = panels.part(BASE), panels.part("people · human view")
    assert "goal" in base.html() and "goal" not in people.html()
    assert "no such texture" in base.html() and base.images() == [] and len(people.images()) == 1
    panel.draw(view)
    assert len(base.images()) == 1 and "goal" not in base.html()


def test_a_reload_measures_the_range_of_depth_again(panels: Panels, clock: Clock) -> None:
    """Else a range that was widened once reduces the contrast for ever."""
    panel = CamerasPanel(panels.server, clock=clock)
    panels.visitors.do = panel.do
    view = seen(1, (camera("base"),))
    panel.draw(view)
    panels.part(BASE).set("depth", True)

    def shown(serial: int, metres: float, cameras_serial: int = 1) -> str:
        depth = np.full((6, 8), metres, np.float32)
        depth[0] += 0.5
        picture = Picture("base", "sensor", 0, POSE, np.zeros((6, 8, 3), np.uint8), depth)
        clock.passes()
        pictures = {("sensor", "base"): picture}
        panel.draw(replace(view, cameras_serial=cameras_serial, pictures=pictures, pictures_serial=serial))  # type: ignore[arg-type]
        return panels.part(BASE).html("1.00") + panels.part(BASE).html("5.50")

    assert "1.00" in shown(2, 1.0) and "1.00" in shown(3, 5.0)
    assert "1.00" not in shown(4, 5.0, cameras_serial=2)


# --- the Studio's picture ------------------------------------------------------------------------------

AT = CameraSettings((0.3, 0, 0.6), (1, 0, 0, 0), 1.0, None, 16, 8, 0.01, 10.0, "minimal")
KEYS: tuple[CameraKey, CameraKey] = ("sensor", "base"), ("sensor", "top")


def pictured(
    key: CameraKey, grey: int, env: int = 0, selected_env: int = 0, metres: float = 1.0, **studio: Any
) -> SessionView:
    infos = tuple(replace(camera(name), settings=AT) for _, name in KEYS)
    cameras = tuple(StudioCamera(info.key, info, AT, False, None) for info in infos)
    rgb, depth = np.full((8, 16, 3), grey, np.uint8), np.full((8, 16), metres, np.float32)
    depth = (depth + np.arange(16) * 0.1).astype(np.float32)
    one = Picture(key[1], key[0], env, POSE, rgb, depth)
    view = running(
        2,
        selected_env=selected_env,
        studio=StudioView(**{"cameras": cameras, "selected": key, **studio}),
        pictures={key: one},
        pictures_serial=grey,
    )
    assert view.task is not None
    return replace(view, task=replace(view.task, cameras=infos))


def test_the_studio_shows_the_newest_picture_of_the_chosen_camera_and_env(
    panels: Panels, clock: Clock
) -> None:
    shown = StudioPicture(panels.server, clock)

    def grey(view: SessionView) -> int | None:
        clock.passes()
        shown.draw(view)
        images = panels.images()
        assert shown.visible is bool(images)
        return int(np.asarray(images[0].image)[0, 0, 0]) if images else None

    base, top = KEYS
    assert grey(pictured(base, 10)) == 10
    assert grey(pictured(base, 20, env=1)) == 10, "of another env; the last one stays"
    assert grey(pictured(base, 30, env=1, selected_env=1)) == 30
    assert grey(pictured(top, 40, env=1)) is None, "it would be the other camera's"
    assert grey(pictured(top, 50)) == 50
    small = replace(pictured(top, 60).pictures[top], rgb=np.full((4, 8, 3), 70, np.uint8))
    assert grey(pictured(top, 60, preview_scale=0.5)) == 50, "the preview is not drawn yet"
    assert grey(pictured(top, 60, preview_scale=0.5, preview=small)) == 70
    assert grey(pictured(top, 80)) == 80
    failing = replace(pictured(top, 90), failed_cameras={top: "It hangs."})
    assert grey(failing) is None and "It hangs." in panels.html()
    assert grey(pictured(top, 90)) == 90 and "It hangs." not in panels.html()
    assert grey(pictured(top, 90, selected=None)) is None


def test_the_studio_shows_the_chosen_modality_where_the_camera_has_it(panels: Panels, clock: Clock) -> None:
    shown = StudioPicture(panels.server, clock)
    base, top = KEYS

    def draw(view: SessionView) -> str:
        clock.passes()
        for _ in range(2):  # the caption appears after the picture
            shown.draw(view)
        return panels.html()

    draw(pictured(base, 10))
    assert shown.kinds == ("rgb", "depth", "segmentation") and shown.shows == "rgb"
    shown.show_kind("depth")
    assert "1.0" in draw(pictured(base, 10)) and shown.shows == "depth"
    assert "1.0" in draw(pictured(base, 11, metres=4.0)), "the range never narrows"
    assert "4.0" in draw(pictured(top, 12, metres=4.0)) and "1.0" not in panels.html(), "of another camera"
    plain = pictured(base, 13)
    (one, other) = plain.of(StudioView).cameras
    only_colours = replace(one, info=replace(one.info, modalities=("rgb",)))
    draw(pictured(base, 13, cameras=(only_colours, other)))
    assert shown.kinds == ("rgb",) and shown.shows == "rgb"
    more = replace(one, info=replace(one.info, modalities=("rgb", "depth", "normal")))
    draw(pictured(base, 14, cameras=(more, other)))
    assert shown.kinds == ("rgb", "depth", "normal")
    draw(pictured(base, 14, cameras=(more, other), preview_scale=2.0))
    assert shown.kinds == ("rgb", "depth"), "a preview has no more"


def test_a_picked_pixel_is_marked_on_the_picture_and_in_the_view_of_its_camera_and_env(
    panels: Panels,
) -> None:
    pick, (base, top) = CameraPick(panels.server, cast(Any, None)), KEYS
    picked = PickedPixel(base, 1, 0.25, 0.75, (4, 6), "cube", 0.5, (0.1, 0.2, 0.3))

    def drawn(
        key: CameraKey, env: int, pixel: PickedPixel = picked, shown: bool = True
    ) -> tuple[bool, list[str]]:
        view = pictured(key, 1, selected_env=env, results=StudioResults(picked=pixel))
        pick.draw(view, shown)
        pick.draw_in_view(view, np.array([10.0, 0, 0], np.float32))
        return bool(panels.html("wb-found")), panels.labels()

    assert drawn(base, 0) == (False, []) and "<i" not in panels.html("wb-pane")
    assert drawn(base, 1) == (True, ["cube"])
    assert "left:25.00%;top:75.00%" in panels.html("wb-pane") and "0.1000, 0.2000, 0.3000" in panels.html(
        "wb-found"
    )
    assert "--wb-aspect: 2.000000" in panels.html("wb-pane")
    (cross,) = panels.nodes("/picked/cross")
    assert cross.points.shape == (3, 2, 3)
    np.testing.assert_allclose(cross.points.mean(axis=1), np.tile([10.1, 0.2, 0.3], (3, 1)), atol=1e-6)
    np.testing.assert_allclose(np.abs(cross.points[:, 1] - cross.points[:, 0]), np.eye(3) * 0.1, atol=1e-6)
    assert drawn(top, 1) == (False, []) and panels.nodes("/picked/cross") == []
    nothing = replace(picked, body=None, depth=None, point=None)
    assert drawn(base, 1, nothing) == (True, [])
    assert drawn(base, 1, shown=False)[0] is False and panels.html("wb-pane") == ""
    wider = pictured(base, 1, selected_env=1)
    (one, other) = wider.of(StudioView).cameras
    cameras = replace(one, now=replace(AT, width=32)), other
    pick.draw(pictured(base, 1, selected_env=1, cameras=cameras), shown=True)
    assert "--wb-aspect: 4.000000" in panels.html("wb-pane"), "a press would be read at another place"

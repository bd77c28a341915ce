"""The camera that the Studio places: chosen from its list, and drawn in the view."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import websockets.sync.client

from tests.drive.live import Live
from tests.drive.scenes import camera, running
from tests.drive.tabs import camera_message, handshake
from tests.drive.waiting import until
from workbench.cameras.commands import (
    ChooseAxes,
    ChooseCamera,
    ChooseHandles,
    ChooseSnap,
    MoveCameraToView,
    ShowModality,
)
from workbench.cameras.events import CameraChosen
from workbench.cameras.studio_panel import NO_CAMERA, TAB
from workbench.cameras.view import StudioCamera, StudioView
from workbench.envs.camera_data import CameraKey, CameraSettings, Picture
from workbench.live.view import SessionView

AT = CameraSettings((1.0, 2.0, 3.0), (1, 0, 0, 0), 1.0, None, 8, 6, 0.01, 10.0, "minimal")
INFO = replace(camera("base_camera"), settings=AT)
BASE, PEOPLE = "base_camera · sensor", "base_camera · human view"


def studio(selected: CameraKey | None) -> SessionView:
    infos = camera("base_camera"), replace(camera("base_camera"), kind="human")
    cameras = tuple(StudioCamera(one.key, one, None, False, None) for one in infos)
    return running(1, studio=StudioView(cameras=cameras, selected=selected))


def placed(moved: bool = False, **studio: Any) -> SessionView:
    one = StudioCamera(INFO.key, INFO, replace(AT, width=80) if moved else AT, moved, None)
    return running(1, studio=StudioView(cameras=(one,), selected=INFO.key, **studio))


def test_a_camera_or_none_can_be_chosen_from_the_list(live_page: Live) -> None:
    tab = live_page.part(TAB)
    live_page.show(running(1))
    assert not tab.shows("Camera")
    live_page.show(studio(None))
    assert tab.field("Camera").value == NO_CAMERA
    assert list(tab.field("Camera").options) == [NO_CAMERA, BASE, PEOPLE]
    tab.set("Camera", PEOPLE)
    assert live_page.asked[-1] == CameraChosen(("human", "base_camera"))
    live_page.show(studio(("human", "base_camera")))
    assert tab.field("Camera").value == PEOPLE
    tab.set("Camera", NO_CAMERA)
    assert live_page.asked[-1] == CameraChosen(None)
    live_page.do(ChooseCamera(name="gone · sensor"))
    assert live_page.client.notices == ["There is no camera gone · sensor."]
    live_page.do(MoveCameraToView())
    assert live_page.client.notices[1:] == ["First choose a camera that can be placed."]


def test_undo_redo_and_reset_are_offered_when_there_is_something_to_do(live_page: Live) -> None:
    tab = live_page.part(TAB)

    def offered(moved: bool = False, **changes: Any) -> dict[str, bool]:
        live_page.show(placed(moved, **changes))
        buttons = {one.text.strip(): one for one in tab.buttons()}
        return {name: buttons[name].command is not None for name in ("Undo", "Redo", "Reset to file")}

    assert offered() == {"Undo": False, "Redo": False, "Reset to file": False}
    assert offered(undo="moved it") == {"Undo": True, "Redo": False, "Reset to file": False}
    assert "moved it" in tab.button("Undo").hint
    assert offered(redo="turned it") == {"Undo": False, "Redo": True, "Reset to file": False}
    assert "turned it" in tab.button("Redo").hint
    assert offered(moved=True) == {"Undo": False, "Redo": False, "Reset to file": True}
    assert "40 × 3" not in tab.html()
    offered(moved=True, preview_scale=0.5)
    assert "40 × 3" in tab.html()


def test_how_long_the_picture_took_is_shown_unless_it_is_a_preview(live_page: Live) -> None:
    tab, pose = live_page.part(TAB), np.array([1, 2, 3, 1, 0, 0, 0], np.float32)

    def took(degree: Any = "fast", scale: float = 1.0, **more: Any) -> str:
        picture = Picture(INFO.name, INFO.kind, 0, pose, np.zeros((6, 8, 3), np.uint8), degree=degree)
        live_page.show(replace(placed(preview_scale=scale), pictures={INFO.key: picture}, **more))
        return "".join(re.findall('wb-took">(.*?)<', tab.html("wb-took")))

    assert took(picture_milliseconds=12.4) == "fast, 12 ms"
    assert took("exact") == "exact", "drawn while steps were made"
    assert took(scale=0.5, picture_milliseconds=12.4) == "" == took(None)


def test_the_buttons_show_what_is_chosen(live_page: Live) -> None:
    tab = live_page.part(TAB)

    def on(scale: float = 1.0) -> set[str]:
        live_page.show(placed(preview_scale=scale))
        return {one.text.strip() for one in tab.buttons() if one.pressed}

    assert on() == {"rgb", "pose", "world", "none", "full"}
    for command in (ShowModality(kind="depth"), ChooseAxes(own=True), ChooseSnap(snap="1 cm, 5°")):
        live_page.do(command)
    assert on(0.5) == {"depth", "pose", "camera", "1 cm, 5°", "½"}
    live_page.do(ChooseSnap(snap="2 cm"))
    assert "2 cm" in live_page.client.notices.pop() and "1 cm, 5°" in on()


def test_axes_are_offered_for_the_handles_of_the_pose_only(live_page: Live) -> None:
    """The handles at eye and target have the axes of the world."""
    tab = live_page.part(TAB)
    for look_at in (False, True, False):
        live_page.do(ChooseHandles(look_at=look_at))
        live_page.show(placed())
        offered = [tab.presses(ChooseAxes(own=own)) for own in (False, True)]
        assert any(offered) == (not look_at)


def test_the_frustum_is_hidden_while_a_page_looks_from_the_cameras_place(live_page: Live) -> None:
    view = placed()
    assert view.task is not None
    view = replace(view, task=replace(view.task, cameras=(INFO,)))
    live_page.show(view)
    assert [node.name for node in live_page.nodes("/cameras/")] == ["/cameras/sensor base_camera"]
    address, arguments = handshake(f"http://127.0.0.1:{live_page.server.get_port()}")
    with websockets.sync.client.connect(address, close_timeout=0.1, **arguments) as page:
        for height, seen in ((3.05, False), (3.5, True)):
            page.send(camera_message((1.0, 2.0, height)))
            until(
                lambda height=height: any(
                    np.allclose(one.camera.position, [1.0, 2.0, height])
                    for one in live_page.server.get_clients().values()
                ),
                "the page's viewpoint",
            )
            live_page.show(view)
            assert bool(live_page.nodes("/cameras/")) is seen, height

"""The camera that the Studio places, chosen from its list."""

from __future__ import annotations

from dataclasses import replace

from tests.drive.live import Live
from tests.drive.scenes import camera, running
from workbench.cameras.commands import ChooseCamera, MoveCameraToView
from workbench.cameras.events import CameraChosen
from workbench.cameras.studio_panel import NO_CAMERA, TAB
from workbench.cameras.view import StudioCamera, StudioView
from workbench.envs.camera_data import CameraKey
from workbench.live.view import SessionView

BASE, PEOPLE = "base_camera · sensor", "base_camera · human view"


def studio(selected: CameraKey | None) -> SessionView:
    infos = camera("base_camera"), replace(camera("base_camera"), kind="human")
    cameras = tuple(StudioCamera(one.key, one, None, False, None) for one in infos)
    return running(1, studio=StudioView(cameras=cameras, selected=selected))


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

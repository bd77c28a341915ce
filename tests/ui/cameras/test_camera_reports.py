"""What the folders beside placing a camera say and show, without a page."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from tests.drive.live import HandedSession
from tests.drive.panels import Panels
from tests.ui.scenes import description, running, table_scene
from workbench.commands.cameras import ReturnToKept, ToggleWantedObject
from workbench.core.camera_data import CameraInfo, CameraSettings
from workbench.core.cameras.report import ObjectToSee
from workbench.session.cameras.view import EditRequest, EditState, StudioCamera, StudioView
from workbench.session.live.view import SessionView
from workbench.ui.cameras.compare import NAMES, CameraCompare, what_differs
from workbench.ui.cameras.export import CameraExport, file_name
from workbench.ui.cameras.report import CameraReportPanel
from workbench.ui.cameras.suggest import CameraSuggest, choices_of
from workbench.ui.cameras.write_to_file import WriteToFile

SETTINGS = CameraSettings(
    position=(0.3, 0.0, 0.6),
    quaternion=(0.6, 0.0, 0.8, 0.0),
    fov=math.pi / 2,
    intrinsic=None,
    width=128,
    height=128,
    near=0.01,
    far=100.0,
    shader_pack="minimal",
)


def camera(mount_pose: np.ndarray | None = None, mount: str = "panda/panda_hand") -> StudioCamera:
    info = CameraInfo(
        name="base_camera",
        kind="sensor",
        width=128,
        height=128,
        fovy=math.pi / 2,
        near=0.01,
        far=100.0,
        intrinsic=np.eye(3, dtype=np.float32),
        mount=None if mount_pose is None else mount,
        modalities=("rgb",),
        settings=SETTINGS,
    )
    return StudioCamera(("sensor", "base_camera"), info, SETTINGS, False, mount_pose)


def test_two_placements_differ_by_how_far_and_how_much_they_were_turned() -> None:
    assert what_differs(SETTINGS, SETTINGS) == []
    half = math.radians(5) / 2
    new = replace(SETTINGS, position=(0.3, 0.02, 0.6), quaternion=(math.cos(half), 0.0, math.sin(half), 0.0))
    old = replace(SETTINGS, quaternion=(1.0, 0.0, 0.0, 0.0))
    assert what_differs(old, new) == ["moved 20.0 mm", "turned 5.00°"]
    # The same orientation, said by the opposite quaternion.
    opposite = tuple(-number for number in SETTINGS.quaternion)
    assert what_differs(SETTINGS, replace(SETTINGS, quaternion=opposite)) == []
    assert what_differs(SETTINGS, replace(SETTINGS, fov=1.0, far=2.0, width=64)) == [
        "fov 90.0° → 57.3°",
        "128 × 128 → 64 × 128",
        "far 100 → 2 m",
    ]


def test_hands_of_robots_are_offered_first_and_are_not_asked_for_by_themselves() -> None:
    objects = (
        ObjectToSee("cube", False),
        ObjectToSee("goal", True),
        ObjectToSee("left", False, ("left/hand", "left/arm"), robot=True),
        ObjectToSee("right", False, ("right/hand",), robot=True),
    )
    task = replace(description(table_scene(1)[0]), objects=objects)
    found = choices_of(task, "sensor")
    assert [(c.name, c.first) for c in found] == [
        ("cube", True),
        ("left/hand", False),
        ("right/hand", False),
        ("left/arm", False),
    ]
    assert [c.label for c in choices_of(replace(task, objects=objects[:3]), "human")] == [
        "cube",
        "goal",
        "hand",
        "arm",
    ]


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("base_camera", "base_camera.json"),
        ("../../etc/passwd", "etc_passwd.json"),
        ("a/b\\c\n.html", "a_b_c_html.json"),
        ("摄像机", "camera.json"),
        ("x" * 500, "x" * 60 + ".json"),
    ],
)
def test_a_download_is_named_by_plain_letters(name: str, wanted: str) -> None:
    assert file_name(name, "json") == wanted
    assert file_name(name, "ros") == wanted.replace(".json", "_ros.yaml")


def looked_at(now: CameraSettings = SETTINGS, in_file: CameraSettings = SETTINGS, **more: Any) -> SessionView:
    """A view in which this camera is chosen, of a task with a cube."""
    one = camera()
    one = replace(one, info=replace(one.info, settings=in_file), now=now)
    task = replace(description(table_scene(1)[0]), objects=(ObjectToSee("cube", False),))
    return running(1, task=task, studio=StudioView(cameras=(one,), selected=one.key, **more))


def test_a_placement_is_compared_with_that_of_the_file_before_it_was_saved(panels: Panels) -> None:
    session = HandedSession()
    folder = CameraCompare(panels.server, cast(Any, session))
    panels.visitors.do = folder.do

    def draw(settings: CameraSettings) -> None:
        session.shown = looked_at(settings, settings)
        folder.draw(session.shown)

    draw(SETTINGS)
    panels.set("Now, with", NAMES["before"])
    panels.press("Show side by side")
    assert session.asked == [] and "in one way" in panels.client.notices[-1]
    draw(replace(SETTINGS, far=50.0))
    draw(replace(SETTINGS, far=50.0))
    panels.press("Show side by side")
    assert session.asked == [("studio.reports.compare", SETTINGS)]


def test_a_placement_that_was_kept_is_what_it_is_then_compared_with_and_returns_to(panels: Panels) -> None:
    session = HandedSession()
    folder = CameraCompare(panels.server, cast(Any, session))
    panels.visitors.do = folder.do
    session.shown = looked_at()
    folder.draw(session.shown)
    panels.do(ReturnToKept())
    assert "is kept yet" in panels.client.notices[-1]
    panels.press("Keep this placement as A")
    folder.draw(session.shown)
    assert panels.field("Now, with").value == NAMES["kept"] and not panels.shows("Return to A")
    session.shown = looked_at(replace(SETTINGS, far=50.0))
    folder.draw(session.shown)
    panels.press("Return to A")
    assert session.asked == [("studio.place", ("sensor", "base_camera"), SETTINGS)]


def test_a_box_around_the_eye_is_searched_until_one_is_written(panels: Panels) -> None:
    session = HandedSession()
    folder = CameraSuggest(panels.server, cast(Any, session))
    panels.visitors.do = folder.do

    def draw(now: CameraSettings) -> None:
        session.shown = looked_at(now)
        folder.draw(session.shown)

    draw(SETTINGS)
    assert panels.field("Search box to").value == (0.6, 0.3, 0.9) and not panels.field("Draw this box").value
    panels.type("Search box from", 2.0, at=2)
    panels.type("Search box from", 2000.0, at=1)
    draw(replace(SETTINGS, position=(1.0, 1.0, 1.0)))
    assert panels.field("Search box from").value == (0.0, -0.3, 2.0) and panels.field("Draw this box").value
    panels.set("Resets", 3)
    panels.press("Search")
    asked = "studio.reports.suggest", ("cube",), (0.0, -0.3, 0.9), (0.6, 0.3, 2.0), 3
    assert session.asked == [asked], "between the corners, in whatever order they are"
    panels.ask(ToggleWantedObject(name="cube"))
    panels.press("Search")
    assert session.asked == [asked] and "at least one object" in panels.client.notices[-1]


def test_a_camera_is_measured_over_what_was_chosen(panels: Panels) -> None:
    session = HandedSession()
    folder = CameraReportPanel(panels.server, cast(Any, session))
    panels.visitors.do = folder.do
    session.shown = looked_at()
    for over, fields, wanted in (
        ("all envs now", (False, False), ("studio.reports.measure", 0)),
        ("fresh resets", (False, True), ("studio.reports.measure", 32)),
        ("this env's episode so far", (True, False), ("studio.reports.measure_steps", 50)),
    ):
        folder.draw(session.shown)
        panels.set("Over", over)
        folder.draw(session.shown)
        assert (panels.shows("Steps"), panels.shows("Resets")) == fields
        panels.press("Measure this camera")
        assert session.asked[-1] == wanted
    session.shown = running(1)
    panels.press("Pictures of all envs")
    assert len(session.asked) == 3 and "Choose the camera" in panels.client.notices[-1]


class Writing:
    """The places where changes of the file are asked for."""

    def __init__(self, panels: Panels) -> None:
        self.panels, self.session = panels, HandedSession()
        above = panels.server.gui.add_folder(None)
        self.part = WriteToFile(panels.server, cast(Any, self.session), lambda _, lens: lens, above)
        panels.visitors.do = self.part.do

    def draw(self, view: SessionView) -> None:
        self.session.shown = view
        self.part.draw(view)


def test_only_a_change_that_was_read_is_saved(panels: Panels) -> None:
    writing, moved = Writing(panels), replace(SETTINGS, far=50.0)
    planned = EditState("planned", EditRequest("edit", ("sensor", "base_camera"), SETTINGS))
    writing.draw(looked_at())
    assert panels.button("Show the change").command is None and not panels.shows("Save")
    writing.draw(looked_at(edit_state=planned))
    assert not panels.shows("Show the change")
    writing.session.shown = looked_at(moved, edit_state=planned)
    panels.press("Save")
    assert writing.session.asked == [] and "Show the change first" in panels.client.notices[-1]
    writing.draw(writing.session.shown)
    assert not panels.shows("Save") and panels.shows("Discard the change")
    writing.draw(looked_at(edit_state=planned))
    panels.press("Save")
    assert writing.session.asked == [("studio.file.write",)]


def test_a_camera_gets_the_name_that_was_typed_until_it_is_taken(panels: Panels) -> None:
    writing, key = Writing(panels), looked_at().studio.cameras[0].key
    writing.draw(looked_at())
    for name, button, why_not in (
        ("", "Rename", "Type a new name"),
        ("a b", "Duplicate", "has letters"),
        (key[1], "Rename", "already"),
    ):
        panels.type("New name", name)
        panels.press(button)
        assert why_not in panels.client.notices[-1] and writing.session.asked == []
    panels.type("New name", "hand")
    panels.press("Duplicate")
    request = EditRequest("duplicate", key, name="hand")
    assert writing.session.asked == [("studio.file.plan", request)]
    writing.draw(looked_at(edit_state=EditState("planned", replace(request, settings=SETTINGS))))
    assert panels.typed("New name") == "hand"
    writing.draw(looked_at(edit_state=EditState("checked", request)))
    assert panels.typed("New name") == ""
    panels.press("Duplicate")
    assert writing.session.asked[-1] == ("studio.file.plan", replace(request, name="base_camera_2"))


def test_a_pasted_calibration_is_read_as_was_chosen(panels: Panels) -> None:
    session = HandedSession()
    folder = CameraExport(panels.server, cast(Any, session))
    panels.visitors.do = folder.do
    session.shown = looked_at()
    folder.draw(session.shown)
    panels.press("Apply to the camera")
    assert session.asked == [] and "Paste a calibration" in panels.client.notices[-1]
    panels.set("Convention", "OpenGL, Blender")
    panels.set("Direction", "camera to world")
    panels.set("Units", "millimetres")
    panels.type("Calibration", "1 0 0 0")
    panels.press("Apply to the camera")
    told = ("sensor", "base_camera"), "1 0 0 0", "camera_to_world", "opengl", 0.001
    assert session.asked == [("studio.import_pose", *told)]
    folder.draw(session.shown)
    assert panels.typed("Calibration") == "1 0 0 0" and "x right, y up" in panels.html()

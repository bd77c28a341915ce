"""The Studio's folders for reports, comparison, search, export and edits, without a page."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.drive.live import StubSession
from tests.drive.panels import Panels
from tests.drive.scenes import description, running, table_scene
from workbench.cameras.commands import ReturnToKept, SaveCameraChange, ToggleWantedObject
from workbench.cameras.compare_panel import NAMES, CameraCompare, what_differs
from workbench.cameras.edit_panel import WriteToFile
from workbench.cameras.events import (
    CameraPlaced,
    ComparisonWanted,
    EditWanted,
    MeasureWanted,
    SuggestionsWanted,
)
from workbench.cameras.export_panel import CameraExport, calibrated_pose, calibration_text, file_name
from workbench.cameras.report_panel import CameraReportPanel
from workbench.cameras.suggest_panel import CameraSuggest, choices_of
from workbench.cameras.view import EditRequest, EditState, StudioCamera, StudioView
from workbench.envs.camera_data import CameraInfo, CameraSettings, differences
from workbench.live.view import SessionView
from workbench.page.command import Command
from workbench.page.widgets.visitors import Visitor
from workbench.pictures.camera_conventions import axes_of, make_pose, with_pose
from workbench.pictures.camera_report import ObjectToSee

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


def test_differences_of_placements_are_listed_with_distance_and_angle() -> None:
    assert what_differs(SETTINGS, SETTINGS) == []
    half = math.radians(5) / 2
    new = replace(SETTINGS, position=(0.3, 0.02, 0.6), quaternion=(math.cos(half), 0.0, math.sin(half), 0.0))
    old = replace(SETTINGS, quaternion=(1.0, 0.0, 0.0, 0.0))
    assert what_differs(old, new) == ["moved 20.0 mm", "turned 5.00°"]
    # The negated quaternion is the same orientation.
    opposite = tuple(-number for number in SETTINGS.quaternion)
    assert what_differs(SETTINGS, replace(SETTINGS, quaternion=opposite)) == []
    assert what_differs(SETTINGS, replace(SETTINGS, fov=1.0, far=2.0, width=64)) == [
        "fov 90.0° → 57.3°",
        "128 × 128 → 64 × 128",
        "far 100 → 2 m",
    ]


def test_robot_hands_are_listed_before_other_links_and_are_not_preselected() -> None:
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
def test_a_downloads_file_name_has_plain_letters_only(name: str, wanted: str) -> None:
    assert file_name(name, "json") == wanted
    assert file_name(name, "ros") == wanted.replace(".json", "_ros.yaml")


def view_of_camera(
    now: CameraSettings = SETTINGS, in_file: CameraSettings = SETTINGS, **more: Any
) -> SessionView:
    """Return a view of a task with a cube, in which the camera is chosen."""
    one = camera()
    one = replace(one, info=replace(one.info, settings=in_file), now=now)
    task = replace(description(table_scene(1)[0]), objects=(ObjectToSee("cube", False),))
    return running(1, task=task, studio=StudioView(cameras=(one,), selected=one.key, **more))


def test_a_saved_placement_is_compared_with_the_files_previous_one(panels: Panels) -> None:
    session = StubSession()
    folder = CameraCompare(panels.server, cast(Any, session))
    panels.visitors.do = folder.do

    def draw(settings: CameraSettings) -> None:
        session.shown = view_of_camera(settings, settings)
        folder.draw(session.shown)

    draw(SETTINGS)
    panels.set("Now, with", NAMES["before"])
    panels.press("Show side by side")
    assert session.asked == [] and "has not changed" in panels.client.notices[-1]
    draw(replace(SETTINGS, far=50.0))
    draw(replace(SETTINGS, far=50.0))
    panels.press("Show side by side")
    assert session.asked == [ComparisonWanted(SETTINGS)]


def test_a_kept_placement_becomes_the_comparison_and_can_be_restored(panels: Panels) -> None:
    session = StubSession()
    folder = CameraCompare(panels.server, cast(Any, session))
    panels.visitors.do = folder.do
    session.shown = view_of_camera()
    folder.draw(session.shown)
    panels.do(ReturnToKept())
    assert "is kept yet" in panels.client.notices[-1]
    panels.press("Keep this placement as A")
    folder.draw(session.shown)
    assert panels.field("Now, with").value == NAMES["kept"] and not panels.shows("Return to A")
    session.shown = view_of_camera(replace(SETTINGS, far=50.0))
    folder.draw(session.shown)
    panels.press("Return to A")
    assert session.asked == [CameraPlaced(("sensor", "base_camera"), SETTINGS)]


def test_the_search_box_surrounds_the_eye_until_one_is_typed(panels: Panels) -> None:
    session = StubSession()
    folder = CameraSuggest(panels.server, cast(Any, session))
    panels.visitors.do = folder.do

    def draw(now: CameraSettings) -> None:
        session.shown = view_of_camera(now)
        folder.draw(session.shown)

    draw(SETTINGS)
    assert panels.field("Search box to").value == (0.6, 0.3, 0.9) and not panels.field("Draw this box").value
    panels.type("Search box from", 2.0, at=2)
    panels.type("Search box from", 2000.0, at=1)
    draw(replace(SETTINGS, position=(1.0, 1.0, 1.0)))
    assert panels.field("Search box from").value == (0.0, -0.3, 2.0) and panels.field("Draw this box").value
    panels.set("Resets", 3)
    panels.press("Search")
    asked = SuggestionsWanted(("cube",), (0.0, -0.3, 0.9), (0.6, 0.3, 2.0), 3)
    assert session.asked == [asked], "the corners must be sorted"
    panels.ask(ToggleWantedObject(name="cube"))
    panels.press("Search")
    assert session.asked == [asked] and "at least one object" in panels.client.notices[-1]


def test_a_camera_is_measured_over_the_chosen_set(panels: Panels) -> None:
    session = StubSession()
    folder = CameraReportPanel(panels.server, cast(Any, session))
    panels.visitors.do = folder.do
    session.shown = view_of_camera()
    for over, fields, wanted in (
        ("all envs now", (False, False), MeasureWanted("envs", 32)),
        ("fresh resets", (False, True), MeasureWanted("resets", 32)),
        ("this env's episode so far", (True, False), MeasureWanted("steps", 50)),
    ):
        folder.draw(session.shown)
        panels.set("Over", over)
        folder.draw(session.shown)
        assert (panels.shows("Steps"), panels.shows("Resets")) == fields
        panels.press("Measure this camera")
        assert session.asked[-1] == wanted
    session.shown = running(1)
    panels.press("Pictures of all envs")
    assert len(session.asked) == 3 and "Choose a camera" in panels.client.notices[-1]


class Writing:
    """The folder that requests edits of the file, with a scripted session."""

    def __init__(self, panels: Panels) -> None:
        self.panels, self.session = panels, StubSession()
        above = panels.server.gui.add_folder(None)
        self.part = WriteToFile(panels.server, cast(Any, self.session), lambda _, lens: lens, above)
        panels.visitors.do = self.do

    def do(self, command: Command, visitor: Visitor) -> None:
        if type(command) in self.part.does:
            self.part.do(command, visitor)
        else:
            self.session.do(command)

    def draw(self, view: SessionView) -> None:
        self.session.shown = view
        self.part.draw(view)


def test_only_the_shown_change_can_be_saved(panels: Panels) -> None:
    writing, moved = Writing(panels), replace(SETTINGS, far=50.0)
    planned = EditState("planned", EditRequest("edit", ("sensor", "base_camera"), SETTINGS))
    writing.draw(view_of_camera())
    assert panels.button("Show the change").command is None and not panels.shows("Save")
    writing.draw(view_of_camera(edit_state=planned))
    assert not panels.shows("Show the change")
    writing.draw(view_of_camera(moved, edit_state=planned))
    assert not panels.shows("Save") and panels.shows("Discard the change")
    writing.draw(view_of_camera(edit_state=planned))
    panels.press("Save")
    assert writing.session.asked == [SaveCameraChange()]


def test_a_typed_name_is_used_once(panels: Panels) -> None:
    writing, key = Writing(panels), view_of_camera().of(StudioView).cameras[0].key
    writing.draw(view_of_camera())
    for name, button, why_not in (
        ("", "Rename", "Type a new name"),
        ("a b", "Duplicate", "has letters"),
        ("a-b", "Duplicate", "has letters"),
        (key[1], "Rename", "already"),
    ):
        panels.type("New name", name)
        panels.press(button)
        assert why_not in panels.client.notices[-1] and writing.session.asked == []
    panels.type("New name", "hand")
    panels.press("Duplicate")
    request = EditRequest("duplicate", key, name="hand")
    assert writing.session.asked == [EditWanted(request)]
    writing.draw(view_of_camera(edit_state=EditState("planned", replace(request, settings=SETTINGS))))
    assert panels.typed("New name") == "hand"
    writing.draw(view_of_camera(edit_state=EditState("checked", request)))
    assert panels.typed("New name") == ""
    panels.press("Duplicate")
    assert writing.session.asked[-1] == EditWanted(replace(request, name="base_camera_2"))


@given(
    st.lists(st.floats(-2, 2), min_size=7, max_size=7),
    st.one_of(st.none(), st.lists(st.floats(-2, 2), min_size=7, max_size=7)),
)
def test_an_exported_camera_is_imported_at_the_same_pose(
    pose: list[float], mount: list[float] | None
) -> None:
    """Includes mounted cameras, whose pose the file holds in the env's frame."""
    assume(all(np.linalg.norm(one[3:]) > 0.1 for one in (pose, mount) if one is not None))
    on = None if mount is None else make_pose(mount[:3], mount[3:]).astype(np.float32)
    one = camera(on)
    there = with_pose(SETTINGS, make_pose(pose[:3], pose[3:]))
    text = calibration_text([replace(one, now=there)], "json")
    for metres in (1.0, 0.001):
        back = with_pose(SETTINGS, calibrated_pose(one, text, None, None, metres))
        assert not differences(back, there, close=1e-5), "our own file is in metres whatever unit is chosen"
    assert calibration_text([one], "opencv") and calibration_text([one, one], "ros").count("---") == 1
    assert refusal_of(lambda: calibrated_pose(one, "{}", None, None))
    assert refusal_of(lambda: calibration_text([replace(one, now=None)], "json"))
    if mount is not None:
        assert refusal_of(lambda: calibrated_pose(replace(one, mount_pose=None), text, None, None))


def refusal_of(do: Callable[[], object]) -> str:
    with pytest.raises(ValueError) as refused:
        do()
    return str(refused.value)


def test_a_pasted_calibration_is_read_in_the_chosen_convention_and_units(panels: Panels) -> None:
    session = StubSession()
    folder = CameraExport(panels.server, cast(Any, session))
    panels.visitors.do = folder.do
    session.shown = view_of_camera()
    folder.draw(session.shown)
    panels.press("Apply to the camera")
    assert session.asked == [] and "Paste a calibration" in panels.client.notices[-1]
    panels.set("Convention", "OpenGL, Blender")
    panels.set("Direction", "camera to world")
    panels.set("Units", "millimetres")
    text = "1 0 0 500\n0 1 0 -60\n0 0 1 700\n0 0 0 1"
    panels.type("Calibration", text)
    panels.press("Apply to the camera")
    (placed,) = session.asked
    assert placed.key == ("sensor", "base_camera")
    assert placed.settings.position == pytest.approx((0.5, -0.06, 0.7))
    assert np.allclose(axes_of(placed.settings.quaternion)[0], (0, 0, -1))
    folder.draw(session.shown)
    assert panels.typed("Calibration") == text and "x right, y up" in panels.html()

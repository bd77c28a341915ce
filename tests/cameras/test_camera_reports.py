"""The Studio's folders for reports, comparison, search, export and edits, without a page."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.drive.live import StubSession
from tests.drive.panels import Panels
from tests.drive.scenes import description, running, table_scene
from workbench.cameras.commands import (
    AddCamera,
    ChooseConvention,
    ChooseDirection,
    CopyTask,
    DropCameraChange,
    PlanCameraChange,
    RemoveCamera,
    ReturnToKept,
    RevertCameraChange,
    SaveCameraChange,
    ShowMeasuredMoment,
    ShowSearchBox,
    ToggleAllLinks,
    ToggleWantedObject,
    UsePlacement,
    UseSuggestedPlane,
)
from workbench.cameras.compare_panel import NAMES, CameraCompare, what_differs
from workbench.cameras.edit_panel import NEW, WriteToFile
from workbench.cameras.events import (
    CameraPlaced,
    ComparisonWanted,
    EditWanted,
    MeasureWanted,
    SuggestionsWanted,
)
from workbench.cameras.export_panel import CameraExport, calibrated_pose, calibration_text, file_name
from workbench.cameras.report_panel import (
    CameraReportPanel,
    env_words,
    headline,
    histogram,
    object_rows,
    percent,
)
from workbench.cameras.suggest_panel import CameraSuggest, choices_of
from workbench.cameras.view import (
    EditRequest,
    EditState,
    MeasuredMoment,
    StudioCamera,
    StudioResults,
    StudioView,
)
from workbench.envs.camera_data import CameraInfo, CameraKey, CameraSettings, Picture, differences
from workbench.live.env_commands import SelectEnv
from workbench.live.events import MomentShown
from workbench.live.view import SessionView
from workbench.page.command import Command
from workbench.page.widgets.modality_colours import data_address
from workbench.page.widgets.visitors import Visitor
from workbench.pictures.camera_conventions import (
    axes_of,
    intrinsic_of,
    make_pose,
    matrix_of,
    pose_in_env,
    with_pose,
)
from workbench.pictures.camera_report import (
    DEPTH_EDGES_METRES,
    CameraReport,
    DepthReport,
    ObjectSeen,
    ObjectToSee,
    OfferedPlacement,
)
from workbench.task.write_edits import SourceEdit

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
    studio = StudioView(**{"cameras": (one,), "selected": one.key, **more})
    return running(1, task=task, studio=studio)


class Folder:
    """One folder of the Studio on a page, with a scripted session."""

    def __init__(self, panels: Panels, kind: type, *more: Any) -> None:
        self.session = StubSession()
        self.part = kind(panels.server, cast(Any, self.session), *more)
        panels.visitors.do = self._do

    @property
    def asked(self) -> list[Any]:
        return self.session.asked

    def draw(self, view: SessionView) -> None:
        self.session.shown = view
        self.part.draw(view)

    def _do(self, command: Command, visitor: Visitor) -> None:
        if type(command) in self.part.does:
            self.part.do(command, visitor)
        else:
            self.session.do(command)


def writing_folder(panels: Panels, look: Callable[..., CameraSettings] = lambda _, lens: lens) -> Folder:
    """The folder that requests edits of the file; `look` gives an added camera the view of the page."""
    return Folder(panels, WriteToFile, look, panels.server.gui.add_folder(None))


def test_a_saved_placement_is_compared_with_the_files_previous_one(panels: Panels) -> None:
    folder = Folder(panels, CameraCompare)

    def draw(settings: CameraSettings) -> None:
        folder.draw(view_of_camera(settings, settings))

    draw(SETTINGS)
    panels.set("Now, with", NAMES["before"])
    panels.press("Show side by side")
    assert folder.asked == [] and "has not changed" in panels.client.notices[-1]
    draw(replace(SETTINGS, far=50.0))
    draw(replace(SETTINGS, far=50.0))
    panels.press("Show side by side")
    assert folder.asked == [ComparisonWanted(SETTINGS)]


def test_a_kept_placement_becomes_the_comparison_and_can_be_restored(panels: Panels) -> None:
    folder = Folder(panels, CameraCompare)
    folder.draw(view_of_camera())
    panels.do(ReturnToKept())
    assert "is kept yet" in panels.client.notices[-1]
    panels.press("Keep this placement as A")
    folder.draw(view_of_camera())
    assert panels.field("Now, with").value == NAMES["kept"] and not panels.shows("Return to A")
    folder.draw(view_of_camera(replace(SETTINGS, far=50.0)))
    panels.press("Return to A")
    assert folder.asked == [CameraPlaced(("sensor", "base_camera"), SETTINGS)]


def test_the_search_box_surrounds_the_eye_until_one_is_typed(panels: Panels) -> None:
    folder = Folder(panels, CameraSuggest)
    folder.draw(view_of_camera())
    assert panels.field("Search box to").value == (0.6, 0.3, 0.9) and not panels.field("Draw this box").value
    panels.type("Search box from", 2.0, at=2)
    panels.type("Search box from", 2000.0, at=1)
    folder.draw(view_of_camera(replace(SETTINGS, position=(1.0, 1.0, 1.0))))
    assert panels.field("Search box from").value == (0.0, -0.3, 2.0) and panels.field("Draw this box").value
    panels.set("Resets", 3)
    panels.press("Search")
    asked = SuggestionsWanted(("cube",), (0.0, -0.3, 0.9), (0.6, 0.3, 2.0), 3)
    assert folder.asked == [asked], "the corners must be sorted"
    panels.ask(ToggleWantedObject(name="cube"))
    panels.press("Search")
    assert folder.asked == [asked] and "at least one object" in panels.client.notices[-1]


def test_a_camera_is_measured_over_the_chosen_set(panels: Panels) -> None:
    folder = Folder(panels, CameraReportPanel)
    for over, fields, wanted in (
        ("all envs now", (False, False), MeasureWanted("envs", 32)),
        ("fresh resets", (False, True), MeasureWanted("resets", 32)),
        ("this env's episode so far", (True, False), MeasureWanted("steps", 50)),
    ):
        folder.draw(view_of_camera())
        panels.set("Over", over)
        folder.draw(view_of_camera())
        assert (panels.shows("Steps"), panels.shows("Resets")) == fields
        panels.press("Measure this camera")
        assert folder.asked[-1] == wanted
    folder.session.shown = running(1)
    panels.press("Pictures of all envs")
    assert len(folder.asked) == 3 and "Choose a camera" in panels.client.notices[-1]


def test_only_the_shown_change_can_be_saved(panels: Panels) -> None:
    writing, moved = writing_folder(panels), replace(SETTINGS, far=50.0)
    planned = EditState("planned", EditRequest("edit", ("sensor", "base_camera"), SETTINGS))
    writing.draw(view_of_camera())
    assert panels.button("Show the change").command is None and not panels.shows("Save")
    writing.draw(view_of_camera(edit_state=planned))
    assert not panels.shows("Show the change")
    writing.draw(view_of_camera(moved, edit_state=planned))
    assert not panels.shows("Save") and panels.shows("Discard the change")
    writing.draw(view_of_camera(edit_state=planned))
    panels.press("Save")
    assert writing.asked == [SaveCameraChange()]


def test_a_typed_name_is_used_once(panels: Panels) -> None:
    writing, key = writing_folder(panels), view_of_camera().of(StudioView).cameras[0].key
    writing.draw(view_of_camera())
    for name, button, why_not in (
        ("", "Rename", "Type a new name"),
        ("a b", "Duplicate", "has letters"),
        ("a-b", "Duplicate", "has letters"),
        (key[1], "Rename", "already"),
    ):
        panels.type("New name", name)
        panels.press(button)
        assert why_not in panels.client.notices[-1] and writing.asked == []
    panels.type("New name", "hand")
    panels.press("Duplicate")
    request = EditRequest("duplicate", key, name="hand")
    assert writing.asked == [EditWanted(request)]
    writing.draw(view_of_camera(edit_state=EditState("planned", replace(request, settings=SETTINGS))))
    assert panels.typed("New name") == "hand"
    writing.draw(view_of_camera(edit_state=EditState("checked", request)))
    assert panels.typed("New name") == ""
    panels.press("Duplicate")
    assert writing.asked[-1] == EditWanted(replace(request, name="base_camera_2"))


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
    folder = Folder(panels, CameraExport)
    folder.draw(view_of_camera())
    panels.press("Apply to the camera")
    assert folder.asked == [] and "Paste a calibration" in panels.client.notices[-1]
    panels.set("Convention", "OpenGL, Blender")
    panels.set("Direction", "camera to world")
    panels.set("Units", "millimetres")
    text = "1 0 0 500\n0 1 0 -60\n0 0 1 700\n0 0 0 1"
    panels.type("Calibration", text)
    panels.press("Apply to the camera")
    (placed,) = folder.asked
    assert placed.key == ("sensor", "base_camera")
    assert placed.settings.position == pytest.approx((0.5, -0.06, 0.7))
    assert np.allclose(axes_of(placed.settings.quaternion)[0], (0, 0, -1))
    folder.draw(view_of_camera())
    assert panels.typed("Calibration") == text and "x right, y up" in panels.html()


# --- what the folders show and send -------------------------------------------------------------------

KEY: CameraKey = ("sensor", "base_camera")


def seen(
    name: str,
    pixels: list[float],
    unhindered: list[float] | None = None,
    alone: list[float] | None = None,
    cut: tuple[int, ...] = (),
    present: list[bool] | None = None,
    scenery: bool = False,
    never_drawn: bool = False,
) -> ObjectSeen:
    count = len(pixels)
    unhindered = pixels if unhindered is None else unhindered
    return ObjectSeen(
        name=name,
        never_drawn=never_drawn,
        scenery=scenery,
        present=np.array([True] * count if present is None else present),
        pixels=np.array(pixels, np.float32),
        unhindered=np.array(unhindered, np.float32),
        alone=np.array(unhindered if alone is None else alone, np.float32),
        margin=np.zeros(count, np.float32),
        cut=np.isin(np.arange(count), cut),
    )


def report_of(
    *objects: ObjectSeen, envs: tuple[int, ...] | None = None, counts: dict[int, int] | None = None
) -> CameraReport:
    """Return a report with the depths of `counts` pixels by bin, in all envs unless given."""
    envs = tuple(range(len(objects[0].pixels))) if envs is None else envs
    rows = np.zeros((len(envs), len(DEPTH_EDGES_METRES) - 1), np.int64)
    for place, pixels in ({20: 10, 30: 5} if counts is None else counts).items():
        rows[:, place] = pixels
    share = np.linspace(0.2, 0.4, len(envs)).astype(np.float32)
    near, far = (np.full(len(envs), metres, np.float32) for metres in (0.4, 1.5))
    depth = DepthReport(rows, share, share * np.float32(0.5), near, far)
    return CameraReport(KEY, (128, 128), (64, 64), envs, objects, depth, 7, 100.0)


def test_rows_list_the_least_seen_object_first_without_scenery() -> None:
    report = report_of(
        seen("bowl", [90, 80, 70, 60]),
        seen("cube", [0, 50, 40, 30], unhindered=[20, 50, 80, 30], cut=(3,)),
        seen("table", [999, 999, 999, 999], scenery=True),
        seen("goal", [0, 0, 0, 0], never_drawn=True),
    )
    rows = object_rows(report)
    assert [row["name"] for row in rows] == ["cube", "bowl", "goal"]
    assert (rows[0]["seen"], rows[0]["pixels"], rows[0]["share"]) == ("75 %", "35", "0.21 %")
    assert rows[0]["cut"] == "25 %"
    assert rows[0]["bad"] == ["seen", "cut", "hidden"] and rows[1]["bad"] == []
    assert rows[2]["seen"] == "" and "hides" in rows[2]["note"]
    (half,) = object_rows(
        report_of(seen("cube", [40, 50, 60], unhindered=[80, 50, 60], present=[True, True, False]))
    )
    assert half["bad"] == ["hidden"] and "2 of 3" in half["note"] and half["hidden"] == "25 %"
    assert half["tones"] == ["good", "good", "none"]
    (little,) = object_rows(report_of(seen("cube", [90, 50], unhindered=[100, 50], alone=[100, 90])))
    assert little["bad"] == [] and "behind other objects" in little["note"]
    (absent,) = object_rows(report_of(seen("cube", [0], present=[False])))
    assert absent["seen"] == ""


@pytest.mark.parametrize(
    ("thing", "words"),
    [
        (seen("cube", [0, 90]), "cube is not visible in 1 of 2 envs."),
        (
            seen("cube", [50, 90], cut=(1,)),
            "Everything is visible; cube is cut by the border in 1 of 2 envs.",
        ),
        (seen("cube", [50, 90]), "Everything is visible, and nothing is cut."),
        (seen("table", [50, 90], scenery=True), "No object is visible in these envs."),
    ],
)
def test_the_headline_names_the_worst_problem(thing: ObjectSeen, words: str) -> None:
    assert headline(report_of(thing)) == words


def test_an_env_is_labelled_with_its_worst_problem() -> None:
    free = [0.0, 30.0, 80.0, 90.0, 90.0, 20.0, 0.0, 45.0]
    cube = seen("cube", [0, 0, 40, 90, 90, 20, 0, 45], free, alone=[*free[:6], 50, 90], cut=(3,))
    report = report_of(cube, seen("bowl", [200] * 8))
    assert [env_words(report, env) for env in range(8)] == [
        "no cube",
        "cube hidden",
        "cube 50 % hidden",
        "cube cut",
        "cube 90 px",
        "cube 20 px, small",
        "cube hidden",
        "cube 50 % behind objects",
    ]


def measured(report: CameraReport, **more: Any) -> StudioResults:
    return StudioResults(report=report, report_of=KEY, report_settings=SETTINGS, **more)


def test_a_report_over_steps_sends_the_page_to_each_moment(panels: Panels) -> None:
    folder = Folder(panels, CameraReportPanel)
    moments = tuple(MeasuredMoment(serial, 2, step) for serial, step in ((41, 0), (43, 5), (47, 9)))
    report = report_of(seen("cube", [30, 0, 20], [30, 30, 30], cut=(2,)), envs=(2, 2, 2))
    folder.draw(view_of_camera(results=measured(report, report_moments=moments)))
    html = panels.html("wb-seen-table")
    assert re.findall('<i class="wb-step-(\\w+)"[^>]*title="step (\\d+)', html) == [
        ("good", "0"),
        ("bad", "5"),
        ("warn", "9"),
    ]
    for number, moment in enumerate(moments):
        panels.ask(ShowMeasuredMoment(number=number))
        assert folder.asked[-1] == MomentShown(moment.serial, 2)
    for number in (-1, 3):
        panels.do(ShowMeasuredMoment(number=number))
    assert len(folder.asked) == 3, "there is no such moment"


def test_a_report_offers_the_planes_that_would_fit_and_uses_them(panels: Panels) -> None:
    folder = Folder(panels, CameraReportPanel)
    report = report_of(seen("cube", [30.0, 20.0]))
    near, far = report.depth.suggested_near, report.depth.suggested_far
    assert near is not None and far is not None

    def shows(camera: CameraSettings = SETTINGS, results: StudioResults | None = None) -> tuple[bool, bool]:
        folder.draw(view_of_camera(camera, results=results or measured(report)))
        return panels.presses(UseSuggestedPlane(plane="near")), panels.presses(UseSuggestedPlane(plane="far"))

    assert shows() == (True, True)
    panels.ask(UseSuggestedPlane(plane="near"))
    panels.ask(UseSuggestedPlane(plane="far"))
    assert folder.asked == [
        CameraPlaced(KEY, replace(SETTINGS, near=near)),
        CameraPlaced(KEY, replace(SETTINGS, far=far)),
    ]
    assert shows(replace(SETTINGS, near=near * 1.01, far=far)) == (False, False), "they fit"
    shows(replace(SETTINGS, near=far + 1))
    panels.do(UseSuggestedPlane(plane="far"))
    shows(results=replace(measured(report), report_of=("human", "render_camera")))
    assert panels.html("wb-seen-table") == "", "it is of another camera"
    panels.do(UseSuggestedPlane(plane="near"))
    assert len(folder.asked) == 2


def test_a_report_has_its_numbers_and_says_when_it_is_old(panels: Panels) -> None:
    folder = Folder(panels, CameraReportPanel)
    report = report_of(seen("cube", [30.0, 0.0, 20.0, 10.0], [30.0] * 4))

    def html(**more: Any) -> str:
        folder.draw(view_of_camera(**more))
        return panels.html("wb-seen-table")

    text = html(results=measured(report))
    for number in ("75 %", "15 px", "64 × 64", "30 %", "15 %"):
        assert number in text, number
    # Bars of 10 and 5 pixels in bins 20 and 30, with an empty one at each end; the planes are outside of them.
    assert re.findall('<rect( class="wb-beyond")? x="([\\d.]+)"[^>]* height="([\\d.]+)"', text) == [
        ("", "1.06", "29.00"),
        (' class="wb-beyond"', "11.06", "15.00"),
    ]
    assert 'class="wb-plane"' not in text and "wb-before" not in text
    assert html(results=measured(report), report_stale=True) != text
    assert "wb-before" in html(results=measured(report, measuring=True))
    assert html(results=measured(report)) == text
    assert "wb-histogram" not in html(
        results=measured(replace(report, depth=report_of(envs=(0, 1, 2, 3), counts={}).depth))
    )


def test_a_histogram_has_the_planes_at_their_depth() -> None:
    depth = report_of(envs=(0,), counts={10: 4, 12: 8}).depth
    edges = DEPTH_EDGES_METRES
    found = histogram(depth, near=float(edges[11]), far=float(np.sqrt(edges[12] * edges[13])))
    assert found is not None
    assert found.bars == ((0.0, False), (0.5, False), (0.0, False), (1.0, False), (0.0, False))
    assert (found.low, found.high) == (edges[9], edges[14])
    assert found.near == pytest.approx(2) and found.far == pytest.approx(3.5)
    outside = histogram(depth, near=float(edges[8]), far=float(edges[15]))
    assert outside is not None and (outside.near, outside.far) == (None, None)
    first = histogram(report_of(envs=(0,), counts={0: 1, len(edges) - 2: 2}).depth, 0.01, 100.0)
    assert first is not None and len(first.bars) == len(edges) - 1 and first.far == len(edges) - 1
    assert histogram(report_of(envs=(0,), counts={}).depth, 0.1, 1.0) is None


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.0, "0 %"),
        (0.004, "< 1 %"),
        (0.006, "1 %"),
        (0.994, "99 %"),
        (0.996, "> 99 %"),
        (1.0, "100 %"),
        (math.nan, "–"),
    ],
)
def test_only_exactly_none_and_all_are_shown_as_such(share: float, text: str) -> None:
    assert percent(share) == text


def picture(env: int, grey: int = 9, key: Any = KEY) -> Picture:
    pose = np.array([0, 0, 1, 1, 0, 0, 0], np.float32)
    return Picture(key[1], key[0], env, pose, np.full((6, 8, 3), grey, np.uint8))


def test_a_sheet_has_each_envs_picture_with_its_finding_and_selects_the_env(panels: Panels) -> None:
    folder = Folder(panels, CameraReportPanel)
    report = report_of(seen("cube", [50.0, 0.0], unhindered=[50.0, 50.0]), envs=(3, 1))
    sheet = tuple(picture(env, 80 * env) for env in (1, 3, 2))

    def cells(selected: int = 3, **more: Any) -> list[tuple[str, str, str]]:
        view = view_of_camera(**more)
        view = replace(view, settings=replace(view.settings, selected_env=selected))
        folder.draw(view)
        figures = re.findall(
            '<figure (.*?)data-env="(\\d+)"( class="wb-selected")?>.*?<figcaption>(.*?)</figcaption>',
            panels.html("wb-sheet"),
        )
        return [
            (env, "selected" if mark else "", re.sub("<.*?>", "", words).strip())
            for _, env, mark, words in figures
        ]

    assert cells(results=measured(report, sheet=sheet)) == [
        ("1", "", "1 cube hidden"),
        ("3", "selected", "3 cube 50 px"),
        ("2", "", "2"),
    ]
    assert [one[1] for one in cells(1, results=measured(report, sheet=sheet))] == ["selected", "", ""]
    for env in (1, 3, 2):
        assert panels.presses(SelectEnv(env=env))
    over_steps = measured(report, sheet=sheet, report_moments=(MeasuredMoment(1, 1, 1),))
    assert [words for _, _, words in cells(results=over_steps)] == ["1", "3", "2"], "its entries are no envs"
    addresses = re.findall('src="([^"]+)"', panels.html("wb-sheet"))
    assert addresses == [data_address(one.rgb, 128) for one in sheet if one.rgb is not None]
    many = tuple(picture(env) for env in range(70))
    assert len(cells(results=measured(report, sheet=many))) == 64
    assert cells(results=measured(report, sheet=(picture(0, key=("human", "base_camera")),))) == []


def test_a_comparison_is_shown_with_its_differences_until_another_camera_is_chosen(panels: Panels) -> None:
    folder = Folder(panels, CameraCompare)
    moved = replace(SETTINGS, far=50.0)
    folder.draw(view_of_camera(moved))
    assert not panels.shows("Return to A")
    panels.press("Show side by side")
    assert folder.asked == [ComparisonWanted(SETTINGS)]
    both = StudioResults(compared=(picture(2, 10), picture(2, 200)))

    def html(now: CameraSettings) -> str:
        folder.draw(view_of_camera(now, results=both))
        return panels.html("wb-pair")

    text = html(moved)
    addresses = [
        data_address(one.rgb, 256) for one in (picture(2, 10), picture(2, 200)) if one.rgb is not None
    ]
    assert re.findall('src="([^"]+)"', text) == addresses and "env 2" in text
    assert what_differs(SETTINGS, moved)[0] in text
    first, _ = captions(text)
    assert captions(html(SETTINGS))[0] != first, "the camera was moved since"
    panels.press("Keep this placement as A")
    html(SETTINGS)
    assert not panels.shows("Return to A"), "it is there"
    assert html(moved) and panels.shows("Return to A")
    people = picture(2, key=("human", "base_camera"))
    other = StudioResults(compared=(people, people))
    folder.draw(view_of_camera(moved, results=other))
    assert panels.html("wb-pair") == ""


def captions(html: str) -> list[str]:
    return re.findall("<figcaption>(.*?)</figcaption>", html)


def offer(position: tuple[float, float, float], score: float) -> OfferedPlacement:
    settings = replace(SETTINGS, position=position)
    report = report_of(seen("cube", [30.0]))
    return OfferedPlacement(settings, (0, 0, 0), score, "words", report, picture(0))


def test_an_offer_can_be_used_unless_the_camera_is_there(panels: Panels) -> None:
    folder = Folder(panels, CameraSuggest)
    offers = offer((0.1, 0.2, 0.3), 0.75), offer((0.4, 0.5, 0.6), 0.5)

    def used(now: CameraSettings, of: Any = KEY) -> list[bool]:
        folder.draw(view_of_camera(now, results=StudioResults(suggestions=offers, suggestions_of=of)))
        return [panels.presses(UsePlacement(number=number)) for number in (0, 1)]

    assert used(SETTINGS) == [True, True]
    assert re.findall('<b class="wb-num">([\\d.]+)</b>', panels.html("wb-offers")) == ["0.75", "0.50"]
    assert "eye 0.10, 0.20, 0.30" in panels.html("wb-offers")
    assert used(offers[1].settings) == [True, False]
    assert used(replace(offers[0].settings, fov=1.0)) == [False, True], "only the pose is offered"
    assert used(SETTINGS, ("human", "base_camera")) == [False, False], "they are of another camera"


def test_the_search_box_is_drawn_around_the_eye_in_the_frame_of_the_mount(panels: Panels) -> None:
    folder = Folder(panels, CameraSuggest)
    offset = np.array([10.0, -3.0, 0.0], np.float32)
    half = math.sqrt(0.5)
    mount = make_pose((0.5, 0.2, 0.4), (half, 0, 0, half)).astype(np.float32)  # turned to the left about z

    def corners(one: StudioCamera) -> list[list[float]]:
        view = running(1, studio=StudioView(cameras=(one,), selected=one.key))
        folder.part.draw_in_view(view, offset)
        boxes = [node.points.reshape(-1, 3) for node in panels.nodes("/bounds of the eye")]
        return [[*edges.min(axis=0), *edges.max(axis=0)] for edges in boxes]

    assert corners(camera()) == []
    panels.do(ShowSearchBox(on=True))
    (box,) = corners(camera())
    np.testing.assert_allclose(box, [10.0, -3.3, 0.3, 10.6, -2.7, 0.9], atol=1e-5)
    (edges,) = panels.nodes("/bounds of the eye")
    lengths = np.abs(np.diff(edges.points, axis=1)[:, 0])
    assert len(lengths) == 12 and (np.sort((lengths > 1e-6).sum(axis=1)) == 1).all(), "along one axis each"
    assert len({tuple(np.round(edge, 4).ravel()) for edge in edges.points}) == 12
    (box,) = corners(camera(mount))
    x, y, z = 10.5, -2.8 + 0.3, 1.0
    np.testing.assert_allclose(box, [x - 0.1, y - 0.1, z - 0.1, x + 0.1, y + 0.1, z + 0.1], atol=1e-5)
    assert corners(replace(camera(mount), mount_pose=None)) == [], "where the mount is not known"
    assert corners(camera()) and (panels.do(ShowSearchBox(on=False)), corners(camera()))[1] == []


def test_few_links_of_the_robot_are_offered_until_all_are_wanted(panels: Panels) -> None:
    folder = Folder(panels, CameraSuggest)
    links = tuple(f"arm/l{number}" for number in range(7))
    objects = ObjectToSee("cube", False), ObjectToSee("arm", False, links, robot=True)

    def offered() -> dict[str, bool]:
        view = view_of_camera()
        assert view.task is not None
        folder.draw(replace(view, task=replace(view.task, objects=objects)))
        pills = re.findall('aria-checked="(true|false)" title="([^"]+)"', panels.html("wb-objects"))
        return {name: on == "true" for on, name in pills}

    assert offered() == {"cube": True, **dict.fromkeys(links[:4], False)}
    panels.ask(ToggleAllLinks())
    assert offered() == {"cube": True, **dict.fromkeys(links, False)}
    panels.ask(ToggleWantedObject(name="arm/l6"))
    panels.ask(ToggleAllLinks())
    assert offered() == {"cube": True, **dict.fromkeys(links[:4], False), "arm/l6": True}
    panels.press("Search")
    assert folder.asked[-1].objects == ("cube", "arm/l6") and folder.asked[-1].seeds == 8
    objects = ObjectToSee("cube", False), ObjectToSee("goal", True)
    assert offered() == {"cube": True}, "a sensor does not see the goal"
    people = replace(camera(), key=("human", "people"))
    objects_seen = view_of_camera(cameras=(people,), selected=people.key)
    assert objects_seen.task is not None
    folder.draw(replace(objects_seen, task=replace(objects_seen.task, objects=objects)))
    assert "goal" in panels.html("wb-objects")


@dataclass
class Downloads:
    """The page that asks, with what it was sent."""

    files: list[tuple[str, str]] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    client_id: int = 1

    def send_file_download(self, name: str, content: bytes, save_immediately: bool) -> None:
        self.files.append((name, content.decode()))

    def add_notification(self, title: str, body: str, **_: object) -> None:
        self.notices.append(body)


def test_one_camera_or_all_are_downloaded_in_the_chosen_form(panels: Panels) -> None:
    folder, client = Folder(panels, CameraExport), Downloads()
    panels.visitor.client = client  # type: ignore[assignment]
    one, unknown = camera(), replace(camera(), key=("human", "people"), now=None)
    other = replace(one, key=("human", "people"), now=replace(SETTINGS, far=5.0))
    folder.draw(running(1, studio=StudioView(cameras=(one, other), selected=one.key)))
    panels.press("Download")
    panels.set("Of", "all cameras")
    panels.set("File", "OpenCV YAML")
    panels.press("Download")
    assert client.files == [
        ("base_camera.json", calibration_text([one], "json")),
        ("cameras_opencv.yaml", calibration_text([one, other], "opencv")),
    ]
    folder.session.shown = running(1, studio=StudioView(cameras=(one, unknown), selected=one.key))
    panels.press("Download")
    assert len(client.files) == 2 and panels.client.notices


def test_the_matrices_follow_camera_mount_convention_and_direction(panels: Panels) -> None:
    folder = Folder(panels, CameraExport)
    mount = make_pose((0.5, 0.2, 0.4), (0.6, 0, 0, 0.8)).astype(np.float32)

    def extrinsic(one: StudioCamera) -> np.ndarray:
        folder.draw(running(1, studio=StudioView(cameras=(one,), selected=one.key)))
        first, second = re.findall('data-copy="([^"]+)"', panels.html("wb-matrix"))
        np.testing.assert_allclose(json.loads(second), intrinsic_of(one.now or SETTINGS), rtol=1e-8)
        return np.array(json.loads(first))

    one = camera(mount)
    for convention, name in (
        ("opencv", "OpenCV"),
        ("opengl", "OpenGL, Blender"),
        ("maniskill", "ManiSkill, SAPIEN"),
    ):
        panels.do(ChooseConvention(convention=convention))  # type: ignore[arg-type]
        for direction in ("world_to_camera", "camera_to_world"):
            panels.do(ChooseDirection(direction=direction))
            wanted = matrix_of(pose_in_env(SETTINGS, mount), convention, direction)  # type: ignore[arg-type]
            np.testing.assert_allclose(extrinsic(one), wanted, atol=1e-8, err_msg=name)
    moved = replace(one, now=replace(SETTINGS, position=(1.0, 2.0, 3.0)))
    np.testing.assert_allclose(
        extrinsic(moved)[:3, 3], pose_in_env(moved.now or SETTINGS, mount)[:3], atol=1e-8
    )
    extrinsic(one)
    away = replace(one, mount_pose=make_pose((5, 0, 0), (1, 0, 0, 0)).astype(np.float32))
    np.testing.assert_allclose(extrinsic(away)[:3, 3], np.add((5, 0, 0), SETTINGS.position), atol=1e-6)


def test_each_request_for_a_change_names_the_chosen_camera(panels: Panels) -> None:
    writing = writing_folder(panels)
    moved = replace(SETTINGS, far=50.0)
    writing.draw(view_of_camera(moved))
    (one,) = view_of_camera(moved).of(StudioView).cameras
    writing.draw(view_of_camera(cameras=(replace(one, moved=True),)))
    panels.press("Show the change")
    panels.press("Remove")
    panels.type("New name", "wrist")
    panels.press("Rename")
    assert writing.asked == [
        EditWanted(EditRequest("edit", KEY)),
        EditWanted(EditRequest("remove", KEY)),
        EditWanted(EditRequest("rename", KEY, name="wrist")),
    ]
    refused = replace(one, refused="its pose is invalid")
    writing.draw(view_of_camera(cameras=(refused,)))
    panels.do(PlanCameraChange())
    writing.draw(running(1))
    for command in (PlanCameraChange(), RemoveCamera()):
        panels.do(command)
    assert len(writing.asked) == 3 and len(panels.client.notices) == 3
    assert not panels.shows("Remove") and panels.shows("Add sensor")


def test_an_added_sensor_looks_at_the_objects_with_the_lens_of_its_siblings(panels: Panels) -> None:
    writing = writing_folder(panels)
    (one,) = view_of_camera().of(StudioView).cameras
    mounted = replace(
        one,
        key=("sensor", "hand"),
        info=replace(one.info, mount="arm/hand", settings=replace(SETTINGS, fov=0.5)),
    )
    lens = replace(SETTINGS, fov=1.1, width=320)
    sibling = replace(one, key=("sensor", "side_camera"), info=replace(one.info, settings=lens))
    for command, cameras, name, like in (
        (AddCamera(kind="sensor"), (mounted, sibling, one), "side_camera_2", lens),
        (AddCamera(kind="sensor"), (mounted,), "side_camera", NEW),
        (AddCamera(kind="human"), (sibling,), "render_camera", replace(NEW, width=512, height=512)),
    ):
        writing.draw(view_of_camera(cameras=cameras, selected=None))
        panels.do(command)
        request = writing.asked[-1].request
        assert (request.what, request.key) == ("add", (command.kind, name))
        assert replace(request.settings, position=like.position, quaternion=like.quaternion) == like
    panels.type("New name", "top")
    panels.do(AddCamera(kind="sensor"))
    assert writing.asked[-1].request.key == ("sensor", "top")


def test_an_added_camera_looks_at_the_middle_of_the_objects_in_all_envs(panels: Panels) -> None:
    view = running(3)
    assert view.task is not None and view.step is not None
    poses = view.step.poses.copy()
    poses[:, view.task.geometry.body_names.index("cube"), :3] = [
        [2.0, 0.1, 0.0],
        [0.5, 0.1, 0.0],
        [9.0, 0.1, 0.0],
    ]
    task = replace(view.task, objects=(ObjectToSee("cube", False),))
    view = replace(view, task=task, step=replace(view.step, poses=poses))
    for position, forward, distance in (
        ((1.0, 0.1, 0.0), (1, 0, 0, 0), 1.0),
        ((-2.0, 5.0, 0.0), (1, 0, 0, 0), 4.0),
        ((2.5, 0.1, 0.0), (1, 0, 0, 0), None),
    ):
        there = {"position": position, "quaternion": forward}
        writing = writing_folder(panels, lambda _, lens, there=there: replace(lens, **there))
        writing.draw(view)
        panels.do(AddCamera(kind="human"))
        request = writing.asked[-1].request
        assert request.settings.position == position and request.settings.distance == (
            None if distance is None else pytest.approx(distance)
        )


@pytest.mark.parametrize(
    ("stage", "what", "offered"),
    [
        ("planned", "edit", {SaveCameraChange(), DropCameraChange()}),
        ("planned", "add", {SaveCameraChange(), DropCameraChange()}),
        ("written", "edit", {RevertCameraChange()}),
        ("checked", "edit", {RevertCameraChange(), DropCameraChange()}),
        ("mismatch", "remove", {RevertCameraChange(), DropCameraChange()}),
        ("undone", "edit", {DropCameraChange()}),
        ("refused", "edit", {DropCameraChange(), CopyTask()}),
        ("none", "edit", set()),
    ],
)
def test_a_change_offers_what_can_be_done_with_it_and_shows_its_diff(
    panels: Panels, stage: Any, what: Any, offered: set[Command]
) -> None:
    writing = writing_folder(panels)
    edit = SourceEdit(
        "/home/me/push.py", "    a = 1\n    b = 2\n", "    a = 1\n    b = 3\n", ("a note",), SETTINGS
    )
    request = EditRequest(what, KEY, SETTINGS)
    state = EditState(stage, request, edit, message="Why.", can_copy=stage == "refused")
    writing.draw(view_of_camera(edit_state=state))
    every = SaveCameraChange(), RevertCameraChange(), DropCameraChange(), CopyTask()
    assert {command for command in every if panels.presses(command)} == offered
    html = panels.html("wb-writing")
    assert html.count("Why.") == 1, "at one place"
    lines = re.findall('<span class="wb-diff-(\\w+)">(.*?)</span>', html)
    assert [line for line in lines if line[0] != "at"] == (
        [("same", "  a = 1"), ("del", "- b = 2"), ("add", "+ b = 3")] if stage != "undone" else []
    )
    assert ("a note" in html) is (stage != "undone")
    writing.draw(view_of_camera())
    assert panels.html("wb-writing") == ""


def test_a_planned_camera_shows_its_picture_and_a_stale_plan_is_planned_again(panels: Panels) -> None:
    writing = writing_folder(panels)
    request = EditRequest("add", ("sensor", "new"), SETTINGS, about="From there.")
    state = EditState("planned", request, drawing=True)
    writing.draw(view_of_camera(edit_state=state))
    assert "wb-first-sight" in panels.html("wb-writing") and "<img" not in panels.html("wb-writing")
    assert "From there." in panels.html("wb-writing")
    rgb = picture(0, 70).rgb
    assert rgb is not None
    writing.draw(view_of_camera(edit_state=replace(state, picture=picture(0, 70), drawing=False)))
    assert f'src="{data_address(rgb, 256)}"' in panels.html("wb-writing")
    (one,) = view_of_camera(replace(SETTINGS, far=50.0)).of(StudioView).cameras
    planned = EditState("planned", EditRequest("edit", KEY, SETTINGS))
    writing.draw(view_of_camera(cameras=(replace(one, moved=True),), edit_state=planned))
    panels.press("Show the change")
    assert writing.asked == [EditWanted(EditRequest("edit", KEY))]

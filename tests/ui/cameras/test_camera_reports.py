"""What the folders beside placing a camera say and show, without a page."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from tests.drive.panels import Panels
from tests.ui.scenes import description, running, table_scene
from workbench.core.camera_data import CameraInfo, CameraSettings
from workbench.core.cameras.report import ObjectToSee
from workbench.session.cameras.view import StudioCamera, StudioView
from workbench.session.live.view import SessionView
from workbench.ui.cameras.compare import BEFORE, CameraCompare, what_differs
from workbench.ui.cameras.export import file_name
from workbench.ui.cameras.suggest import choices_of

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
    assert file_name(name, "json", "json") == wanted
    assert file_name(name, "ros", "yaml") == wanted.replace(".json", "_ros.yaml")


class RecordedReports:
    """Stands where the session stands for the Compare folder, and notes what is compared."""

    def __init__(self) -> None:
        self.shown = running(1)
        self.compared: list[CameraSettings] = []
        self.studio = self.reports = self

    def view(self) -> SessionView:
        return self.shown

    def compare(self, other: CameraSettings) -> None:
        self.compared.append(other)


def test_a_placement_is_compared_with_that_of_the_file_before_it_was_saved(panels: Panels) -> None:
    session = RecordedReports()
    folder = CameraCompare(panels.server, cast(Any, session))

    def draw(settings: CameraSettings) -> None:
        one = camera()
        in_file = replace(one, info=replace(one.info, settings=settings), now=settings)
        session.shown = running(1, studio=StudioView(cameras=(in_file,), selected=in_file.key))
        folder.draw(session.shown)

    draw(SETTINGS)
    panels.set("Now, with", BEFORE)
    panels.press("Show side by side")
    assert session.compared == [] and "in one way" in panels.client.notices[-1]
    draw(replace(SETTINGS, far=50.0))
    draw(replace(SETTINGS, far=50.0))
    panels.press("Show side by side")
    assert session.compared == [SETTINGS]

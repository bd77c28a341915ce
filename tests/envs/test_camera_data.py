"""Camera settings as data: which differ, which are invalid, and the text of a moved camera."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from workbench.envs.camera_data import (
    CameraSettings,
    MovedCamera,
    Picture,
    differences,
    moved_cameras_text,
    why_no_camera,
)

K = ((50.0, 0.0, 32.0), (0.0, 50.0, 24.0), (0.0, 0.0, 1.0))
GIVEN = CameraSettings((1.0, 2.0, 300.0), (0.6, 0.0, 0.8, 0.0), 1.2, None, 64, 48, 0.01, 10.0, "minimal", 2.0)
CHANGES: list[tuple[str, dict[str, Any]]] = [
    ("position", {"position": (1.0, 2.0, 300.01)}),
    ("orientation", {"quaternion": (0.8, 0.0, 0.6, 0.0)}),
    ("fov", {"fov": 1.3}),
    ("fov intrinsic", {"fov": None, "intrinsic": K}),
    ("width", {"width": 65}),
    ("height", {"height": 49}),
    ("near", {"near": 0.02}),
    ("far", {"far": 11.0}),
    ("shader_pack", {"shader_pack": "rt"}),
    # The same rotation, rounding in single precision, and what changes no picture.
    ("", {"quaternion": (-0.6, 0.0, -0.8, 0.0)}),
    ("", {"position": (1.0, 2.0, 300.0001)}),
    ("", {"distance": 5.0}),
]


@pytest.mark.parametrize(("names", "change"), CHANGES, ids=str)
def test_each_setting_that_differs_is_named(names: str, change: dict[str, Any]) -> None:
    other = replace(GIVEN, **change)
    assert differences(GIVEN, other) == differences(other, GIVEN) == tuple(names.split())


def test_a_moved_camera_is_told_with_its_step_its_value_and_that_of_the_file() -> None:
    moved = replace(GIVEN, quaternion=(0.0, 1.0, 0.0, 0.0), far=7.5)
    text = moved_cameras_text(
        [MovedCamera(0, "sensor", "first", moved, GIVEN), MovedCamera(42, "human", "second", GIVEN, GIVEN)]
    )
    first, second = text.split("second")
    assert "first" in first and "42" not in first and "42" in second
    parts = ["0, 1, 0, 0", "0.6, 0, 0.8, 0", "far", "7.5", "10"]
    places = [first.index(part) for part in parts]
    assert places == sorted(places), "the value in use comes before that of the file"
    assert "fov" not in text and moved_cameras_text([]) == ""


LENS = {"fov": None, "intrinsic": K}


@pytest.mark.parametrize(
    "change",
    [
        {"position": (np.nan, 0.0, 0.0)},
        {"position": (0.0, 0.0, 2e6)},
        {"far": np.inf},
        {"quaternion": (0.6, 0.0, 0.9, 0.0)},
        {"quaternion": (0.0, 0.0, 0.0, 0.0)},
        {"near": 0.0},
        {"near": 10.0},
        {"width": 0},
        {"height": 4097},
        {"height": 48.0},
        {"shader_pack": "../minimal"},
        {"shader_pack": ""},
        {"fov": None},
        {"intrinsic": K},
        {"fov": 0.0},
        {"fov": 3.2},
        {**LENS, "intrinsic": (K[0], K[1])},
        {**LENS, "intrinsic": (K[0], K[1], (0.0, 0.0, np.nan))},
        {**LENS, "intrinsic": ((0.0, 0.0, 32.0), K[1], K[2])},
        {**LENS, "intrinsic": (K[0], (0.0, -50.0, 24.0), K[2])},
    ],
    ids=str,
)
def test_invalid_settings_have_a_reason(change: dict[str, Any]) -> None:
    assert why_no_camera(GIVEN) is None and why_no_camera(replace(GIVEN, **LENS)) is None
    assert why_no_camera(replace(GIVEN, **change))


def test_every_plane_of_a_picture_counts_as_memory() -> None:
    planes = {
        name: np.zeros((2, 3, 3), np.float32)
        for name in ("rgb", "depth", "segmentation", "position", "normal", "albedo")
    }
    empty = Picture("a", "sensor", 0, np.zeros(7, np.float32))
    for name, plane in planes.items():
        assert replace(empty, **{name: plane}).nbytes == empty.nbytes + plane.nbytes

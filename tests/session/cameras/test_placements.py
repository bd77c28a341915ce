"""Cameras that are placed by hand: what is one step of undo, and how far each of them looks."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.session.studio import BARE, EYE, FILE, INFO, KEY, LENS, TARGET
from tests.ui.scenes import description, step_of, table_scene
from workbench.core.camera_data import CameraSettings
from workbench.core.cameras.conventions import LookAt, pose_from_look_at, target_of, with_pose
from workbench.session.cameras import selection
from workbench.session.cameras.selection import StudioCameras
from workbench.session.cameras.view import StudioCamera


def opened(*said: CameraSettings, mount: str | None = None) -> StudioCameras:
    """With versions that say this of the camera, one after the other."""
    geometry, poses = table_scene(2)
    cameras = StudioCameras()
    for settings in said:
        info = replace(INFO, settings=settings, mount=mount)
        cameras.task = description(geometry, (info,))
        cameras.placements.loaded({KEY: settings})
        cameras.drawn = step_of(poses), 1
        cameras.all_cameras()
    return cameras


def shown(cameras: StudioCameras) -> StudioCamera:
    (found,) = cameras.all_cameras()
    return found


def looks_at(cameras: StudioCameras) -> object:
    now = shown(cameras).now
    assert now is not None
    return pytest.approx(target_of(now), abs=1e-6)


def test_the_target_is_the_one_that_the_file_gives_and_follows_it() -> None:
    """It was where the line of sight meets the ground."""
    assert looks_at(opened(FILE)) == TARGET
    # The file names another point that is seen the same way.
    further = replace(FILE, distance=1.5 * math.dist(EYE, TARGET))
    assert looks_at(opened(FILE, further)) == tuple(np.add(EYE, 1.5 * np.subtract(TARGET, EYE)))


def test_moved_it_looks_as_far_as_it_did_and_back_in_its_place_at_what_the_file_gives() -> None:
    cameras = opened(FILE)
    moved = replace(FILE, position=(0.45, 0.3, 0.6))
    assert cameras.placements.place(KEY, moved)
    assert looks_at(cameras) == (0.08, 0.3, 0.2) and shown(cameras).moved
    assert not cameras.placements.place(KEY, replace(moved, distance=2.0)), "no step of its own"
    found = shown(cameras).now
    assert found is not None and found.distance == 2.0
    cameras.placements.undo()
    assert looks_at(cameras) == TARGET and not shown(cameras).moved
    cameras.placements.redo()
    found = shown(cameras).now
    assert found is not None and found.distance == 2.0, "as it was set there"


def test_how_far_one_looks_that_was_not_moved_is_set_too_and_is_no_placement() -> None:
    cameras = opened(FILE)
    assert not cameras.placements.place(KEY, replace(FILE, distance=0.2))
    found = shown(cameras)
    assert found.now is not None and found.now.distance == 0.2
    assert not found.moved and cameras.placements.undo_label is None


def test_without_a_target_in_the_file_it_looks_at_the_ground_and_moved_it_goes_on_to_look_so_far() -> None:
    cameras = opened(BARE)
    assert looks_at(cameras) == (-0.105, 0, 0)
    now = shown(cameras).now
    assert now is not None
    cameras.placements.place(KEY, replace(now, position=(0.45, 0.0, 0.9)))
    assert looks_at(cameras) == (-0.105, 0, 0.3)
    # The version with it in the file names no target either.
    cameras.placements.loaded({KEY: replace(BARE, position=(0.45, 0.0, 0.9))}, frozenset({KEY}))
    assert looks_at(cameras) == (-0.105, 0, 0.3) and not shown(cameras).moved


@pytest.mark.parametrize("forward", [(1.0, 0.0, 0.0), (0.0, 0.6, 0.8), (0.999, 0.0, -0.0447)])
def test_where_the_ground_is_not_before_it_or_far_away_it_looks_a_metre_ahead(
    forward: tuple[float, float, float],
) -> None:
    ahead = tuple(np.add(EYE, forward))
    cameras = opened(with_pose(LENS, pose_from_look_at(LookAt(EYE, ahead))))
    now = shown(cameras).now
    assert now is not None and now.distance == 1.0


def test_the_ground_before_a_mounted_camera_is_that_of_the_env() -> None:
    """The hand is 0.5 m above it and upright: the camera looks from 0.1 m above the hand straight to the ground."""
    down = with_pose(LENS, pose_from_look_at(LookAt((0, 0, 0.1), (0, 0, 0))))
    now = shown(opened(down, mount="arm/hand")).now
    assert now is not None and now.distance == pytest.approx(0.6)
    # While it is not known where the hand is, nothing is settled.
    cameras = opened(down, mount="arm/hand")
    cameras.placements.loaded({})
    cameras.placements.loaded({KEY: down})
    cameras.drawn = None, 0
    now = shown(cameras).now
    assert now is not None and now.distance is None


DRAG = object()
A_STEP_EACH = [0.62, 0.61, 0.6]
"""Heights of `FILE`, and of the first two of three placements."""


@pytest.mark.parametrize(
    ("calls", "heights"),
    [
        ([("key", 0.0, 1.2), ("key", 1.1, 1.2), ("key", 2.3, 1.2)], [0.6]),
        ([("key", 0.0, 1.2), ("key", 1.3, 1.2), ("key", 2.6, 1.2)], A_STEP_EACH),
        ([("key", 0.0, 1.2), ("position", 0.1, 1.2), ("key", 0.2, 1.2)], A_STEP_EACH),
        ([(DRAG, 0.0, math.inf), (DRAG, 90.0, math.inf), (object(), 90.1, math.inf)], [0.62, 0.6]),
        ([(None, 0.0, math.inf), (None, 0.0, math.inf), (None, 0.0, math.inf)], A_STEP_EACH),
    ],
    ids=["followed at once", "after a pause", "by turns", "a drag that rests", "nobody's"],
)
def test_what_one_hand_does_without_a_pause_is_one_step_of_undo(
    calls: list[tuple[object, float, float]], heights: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    placements = opened(FILE).placements
    for height, (hand, at, pause) in zip((0.61, 0.62, 0.63), calls, strict=True):
        monkeypatch.setattr(selection, "time", SimpleNamespace(monotonic=lambda at=at: at))
        assert placements.place(KEY, replace(FILE, position=(0.45, 0.0, height)), hand, pause)
    undone = []
    while (taken := placements.undo()) is not None:
        undone.append(taken.before.position[2])
    assert undone == heights


def test_what_is_made_again_is_whole() -> None:
    placements = opened(FILE).placements
    moved, further = (replace(FILE, position=(0.45, 0.0, height)) for height in (0.7, 0.8))
    placements.place(KEY, moved, DRAG)
    placements.undo()
    placements.redo()
    placements.place(KEY, further, DRAG)
    placements.undo()
    assert placements.now(KEY) == moved


def test_what_was_taken_back_can_be_made_again_until_something_else_is_done() -> None:
    placements = opened(FILE).placements
    moved, other = (replace(FILE, position=(0.45, 0.0, height)) for height in (0.7, 0.8))
    assert placements.undo() is None and placements.redo() is None
    assert (placements.undo_label, placements.redo_label) == (None, None)
    placements.place(KEY, moved)
    assert (placements.undo_label, placements.redo_label) == ("moved base_camera", None)
    placements.undo()
    assert (placements.undo_label, placements.redo_label) == (None, "moved base_camera")
    placements.place(KEY, other)
    assert placements.redo() is None and placements.now(KEY) == other


def test_a_placement_that_is_out_of_the_file_again_is_a_step_of_undo_and_one_made_since_stays() -> None:
    written, since = (replace(FILE, position=(0.45, 0.0, height)) for height in (0.7, 0.8))
    placements = opened(FILE, written, FILE).placements
    assert placements.edit_undone(KEY, written, FILE) and placements.now(KEY) == FILE
    assert placements.undo_label == "reverted the change of base_camera"
    placements.undo()
    assert placements.now(KEY) == written
    placements.place(KEY, since)
    assert not placements.edit_undone(KEY, written, FILE)
    assert placements.now(KEY) == since and placements.undo_label == "moved base_camera"


def test_a_camera_that_there_is_not_cannot_be_exported() -> None:
    cameras = opened(FILE)
    assert cameras.to_export(KEY).settings == FILE
    with pytest.raises(ValueError, match="no sensor camera nothing whose settings are known"):
        cameras.to_export(("sensor", "nothing"))

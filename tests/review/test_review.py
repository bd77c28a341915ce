"""Opened recordings and their shared position: opening, playing, aligning, and changing files."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.episodes import made, poses_of, write
from tests.review.recordings import FakeLibrary, Row, close_one, opened, reach, review_of, select
from workbench.envs.camera_data import CameraSettings, MovedCamera
from workbench.episodes.episode import Episode
from workbench.episodes.row import UnreadableRecording
from workbench.library.folder import Library
from workbench.live.commands import TogglePlay
from workbench.live.messages import CameraRequest
from workbench.review.commands import OpenAgain
from workbench.review.panel import facts_html
from workbench.review.playback import Review
from workbench.review.view import Opened, PictureReader, column_at


def test_playback_runs_by_the_clock() -> None:
    review, library = review_of(a=made(10))
    opened(review, "a")
    review.do(TogglePlay())
    library.now += 0.26
    assert (review.view().position, review.view().playing) == (5, True)
    library.now += 10
    assert (review.view().position, review.view().playing) == (10, False)


def test_unreadable_recordings_are_reported_and_the_others_open() -> None:
    library = FakeLibrary(
        {
            "a": made(3),
            "b": UnreadableRecording("it is a picture of a cat"),
            "c": ZeroDivisionError("oh"),
            "d": OSError("gone"),
        }
    )
    readable = threading.Event()
    readable.set()

    def read(row: Row, *_: object) -> Episode:
        assert readable.wait(60)
        return library.read(row)

    review = Review(library, read, clock=library.clock)  # type: ignore[arg-type]
    review.open(["a", "b", "c", "d", "e"])
    view = reach(review, lambda view: bool(view.opened) and not view.loading, "the one that can be read")
    assert [o.id for o in view.opened] == ["a"]
    problems = " ".join(view.problems)
    assert (
        "file b was not opened. it is a picture of a cat" in problems
        and "ZeroDivisionError: oh" in problems
        and "file d was not opened. gone" in problems
    )
    assert view.not_opened == ("b", "c", "d")
    readable.clear()
    review.do(OpenAgain())
    assert review.view().not_opened == () and review.view().loading
    readable.set()
    view = reach(review, lambda view: len(view.not_opened) == 3 and not view.loading, "the second try")
    assert [o.id for o in view.opened] == ["a"]
    review.open(["b"])
    view = reach(review, lambda view: not view.loading and len(view.problems) == 1, "its problem")
    assert [o.id for o in view.opened] == ["a"], "the open recording stays"


def test_the_memory_of_open_recordings_is_limited() -> None:
    library, held = FakeLibrary({f"e{i}": made(2) for i in range(6)}), []

    def read(row: Row, *_: object) -> Episode:
        held.append(64 * 2**20)
        return library.read(row)

    review = Review(
        library,  # type: ignore[arg-type]
        read,  # type: ignore[arg-type]
        clock=library.clock,
        most_bytes=100 * 2**20,
        memory=lambda: 2**30 + sum(held),  # the process's own memory includes earlier tests, and may fall
    )
    review.open([f"e{i}" for i in range(6)])
    view = reach(review, lambda v: bool(v.problems) and not v.loading, "the word for it")
    assert len(view.opened) == 2 == len(held)
    assert "and 3 more were not opened: the recordings opened before take 100 MB" in view.problems[0]
    review.close()


def test_changed_and_deleted_files_are_reported_and_stay_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.review.playback.CHECK_SECONDS", 0.01)
    changed, gone = tmp_path / "a.rrd", tmp_path / "a.h5"
    changed.write_text("1")
    gone.write_text("1")
    review, library = review_of(a=made(3))
    library.extra["a"] = (changed, gone)
    opened(review, "a")
    time.sleep(0.1)  # let some checks pass
    assert review.view().problems == ()
    changed.write_text("another")
    gone.unlink()
    reach(review, lambda view: len(view.problems) == 2, "the word for both")
    problems = " ".join(review.view().problems)
    assert "a.rrd has changed" in problems and "a.h5 was deleted" in problems
    review.close()
    assert len(review.view().opened) == 1


def test_changes_of_the_selected_recordings_task_are_reported_at_once_and_after_a_save(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.review.playback.CHECK_SECONDS", 0.01)
    task = tmp_path / "push.py"
    task.write_text("SIZE = 2\nMASS = 1\n")

    def recorded_with(source: str) -> Episode:
        episode = made(3)
        return replace(episode, info=replace(episode.info, source_file=str(task), source={str(task): source}))

    review, _ = review_of(a=recorded_with("SIZE = 1\nMASS = 1\n"), b=recorded_with("SIZE = 2\nMASS = 2\n"))
    opened(review, "a", "b")
    reach(review, lambda view: view.changed_symbols == "SIZE", "what changed since the first")
    select(review, 1)
    reach(review, lambda view: view.changed_symbols == "MASS", "what changed since the second")
    task.write_text("SIZE = 3\nMASS = 2\n")
    reach(review, lambda view: view.changed_symbols == "SIZE", "what was saved")
    close_one(review, 1)
    close_one(review, 0)
    opened(review, "b")
    reach(review, lambda view: view.changed_symbols == "SIZE", "the same of one that is opened again")
    review.close()


def test_the_newest_recording_is_opened_beside_the_library_once_listed_and_only_once(
    child_process: None, tmp_path: Path
) -> None:
    for seed, minute in ((1, 10), (2, 20), (3, 15)):
        write(tmp_path, made(3, seed=seed, written_at=f"2026-11-22T10:{minute}:00+00:00"), pictures=False)
    library = Library(tmp_path)
    review = Review(library)
    library.on_change.add(review.library_changed)
    review.open_first("newest")
    review.add_problem("A killed program left half an episode.")
    assert not review.view().loading
    library.refresh()
    view = reach(review, lambda view: bool(view.opened) and not view.loading, "the newest")
    assert [one.episode.info.seed for one in view.opened] == [2] and view.library_stays
    assert view.problems == ("A killed program left half an episode.",), (
        "a person had no chance to read it yet"
    )
    close_one(review, 0)
    write(tmp_path, made(3, seed=4), pictures=False)
    library.refresh()
    assert not review.view().loading and not review.view().opened
    review.close()
    library.close()


def test_another_opening_ends_one_that_has_already_shown_recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("workbench.review.state.FIRST_SHOWN_SECONDS", 0.0)
    library = FakeLibrary({"a": made(10), "b": made(20), "c": made(30)})
    reached, go_on = threading.Event(), threading.Event()
    readers: list[threading.Thread] = []

    def read(row: Row, *_: object) -> Episode:
        readers.append(threading.current_thread())
        if row.id == "b":
            reached.set()
            assert go_on.wait(60)
        return library.read(row)

    review = Review(library, read, clock=library.clock)  # type: ignore[arg-type]
    review.open("ab")
    assert reached.wait(60)
    opened(review, "c")
    go_on.set()
    readers[0].join(60)
    assert [o.id for o in review.view().opened] == ["c"] and not review.view().loading


def test_real_files_are_read_with_scene_pictures_and_numbers(child_process: None, tmp_path: Path) -> None:
    write(tmp_path, made(4, success_from=3))
    library = Library(tmp_path)
    library.refresh()
    review = Review(library)
    view = opened(review, library.view().rows[0].id)
    one = view.opened[0]
    assert one.has_scene and one.length == 4 and one.first("success") == 3
    assert np.allclose(poses_of(one.episode)[:, 3, 0], np.arange(5) * 0.01)
    reader = PictureReader()
    assert [camera.modalities for camera in reader.cameras(one.episode)] == [("rgb", "depth", "segmentation")]
    wanted = (CameraRequest("base_camera", "sensor", ("rgb", "depth")),)
    seen = reader.pictures(one.episode, 2, wanted, env=0)["sensor", "base_camera"]
    assert seen.rgb is not None and seen.depth is not None
    assert abs(int(seen.rgb.mean()) - 40) <= 2 and np.allclose(seen.depth, 0.2) and seen.segmentation is None
    assert seen.degree is None, "only recordings that name fast pictures have a degree"
    library.close()


def test_an_incomplete_and_a_broken_recording(child_process: None, tmp_path: Path) -> None:
    """Without its .rrd a recording has no scene or pictures; with half of one there is a message."""
    half = write(tmp_path, made(4, seed=1))
    half.with_suffix(".rrd").unlink()
    broken = write(tmp_path, made(4, seed=2))
    rrd = broken.with_suffix(".rrd")
    rrd.write_bytes(b"RRF2" + b"\0" * 1000)
    broken.with_suffix(".h5").write_bytes(b"")
    library = Library(tmp_path)
    library.refresh()
    rows = {row.seed: row for row in library.view().rows}
    review = Review(library)
    review.open([rows[1].id, rows[2].id])
    view = reach(review, lambda view: bool(view.opened) and not view.loading, "the half one")
    assert [o.id for o in view.opened] == [rows[1].id]
    assert not view.opened[0].has_scene and view.opened[0].length == 4
    reach(review, lambda view: "no scene" in view.opened[0].scene, "the word for it")
    half, broken = view.problems
    assert rows[1].name in half and rows[2].name in broken
    library.close()


def test_what_is_known_of_a_recording_is_among_its_facts() -> None:
    def facts(changed: str = "", **info: Any) -> str:
        return facts_html(Opened("id", "push", made(2, **info), ()), changed)

    lens = CameraSettings((0.3, 0, 0.625), (1, 0, 0, 0), 1.0, None, 8, 6, 0.01, 10.0, "minimal")
    moved = MovedCamera(1, "sensor", "wrist_view", lens, replace(lens, position=(0.3, 0, 0.875)))
    known = {
        "moved_cameras": ((moved,), "wrist_view"),
        "acted_by": (((0, "lab.py:act"),), "lab.py:act"),
        "observed_by": ("rgbd_view", "rgbd_view"),
    }
    for field_name, (value, shown) in known.items():
        assert shown not in facts() and shown in facts(**{field_name: value}), field_name
    assert "and evaluate" in facts("and evaluate")


@given(
    length=st.integers(0, 30), anchor=st.integers(0, 30), first=st.integers(-40, 0), last=st.integers(0, 40)
)
def test_a_line_has_each_number_at_its_position(length: int, anchor: int, first: int, last: int) -> None:
    states = np.arange(length + 1)
    axis = np.arange(first, last + 1)
    line = column_at(states, states.astype(np.float64) * 1.5, anchor, axis)
    for place, value in zip(axis, line, strict=True):
        state = place + anchor
        assert value == state * 1.5 if 0 <= state <= length else np.isnan(value)

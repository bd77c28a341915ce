"""What the files of a recording say of its episode: the library's row, the recording's properties and the episode itself."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.drive.episodes import Made, Track
from tests.drive.equal import assert_equal
from tests.drive.rows import append
from tests.episodes.read_rrd import read_rrd
from workbench.envs.camera_data import CameraInfo, CameraKind, CameraSettings, MovedCamera
from workbench.episodes.document import differences_from_source, write_into_description
from workbench.episodes.episode import CameraTrack, Episode
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.reader.read_rows import read_found
from workbench.episodes.reader.scan import scan_folder
from workbench.episodes.rerun.read import read_properties
from workbench.episodes.row import Facts

Maker = Callable[..., Made]
STEPS = 3


def camera(name: str, kind: CameraKind, frame: list[int], shade: int) -> Track:
    """A camera whose picture of state k has the shade `shade` + 10 k."""
    matrix = np.array([[90, 0, 16], [0, 70, 12], [0, 0, 1]], np.float32)
    info = CameraInfo(
        name, kind, 32, 24, 0.75, 0.25, 12.5, matrix, "panda_hand", ("rgb", "depth"), replaced_shader="rt"
    )
    pose = np.array([[state, shade, 1, 0.5, 0.5, -0.5, 0.5] for state in frame], np.float32)
    rgb = np.stack([np.full((24, 32, 3), shade + 10 * state, np.uint8) for state in frame])
    return Track(info, np.array(frame), pose, rgb)


def settings(x: float) -> CameraSettings:
    return CameraSettings((x, 0, 1), (1, 0, 0, 0), 0.75, None, 32, 24, 0.25, 12.5, "rt")


@pytest.fixture
def episode(make_episode: Maker, tmp_path: Path) -> Made:
    """An episode of env 2 in which any two values differ; its seed is 0."""
    file = tmp_path / "tasks" / "push.py"
    file.parent.mkdir()
    file.write_text("Made-v1")
    plain = make_episode(STEPS)
    info = dataclasses.replace(
        plain.info,
        seed=0,
        env_index=2,
        source_file=str(file),
        source={str(file): "Made-v1", str(file.parent / "parts" / "lib.py"): "x = 1\n"},
        source_hash="0123456789ab",
        control_dt=0.04,
        control_mode="pd_ee_pose",
        backend="cpu (batched)",
        versions={"torch": "2.5", "sapien": "3.0"},
        env_kwargs={"obs_mode": "state", "sizes": [1, 2.5]},
        reset_options={"level": {"a": None}},
        max_episode_steps=50,
        written_at="2026-11-21T10:00:07+00:00",
        side_files={"meshes/a.obj": "00aa"},
        acted_by=((0, "random"), (2, "sliders")),
        pictures="fast",
        observed_by="later version",
    )
    return make_episode(
        STEPS,
        info=info,
        geometry=dataclasses.replace(plain.geometry, num_envs=3, visuals=()),
        segmentation={1: "floor", 7: "hand"},
        reward=np.array([1, 2, 4], np.float32),
        terminated=np.array([False, True, False]),
        truncated=np.array([False, False, True]),
        evaluate={"success": np.array([0, 1, 0, 0], bool), "fail": np.array([0, 0, 0, 1], bool)},
        cameras=[camera("eye", "sensor", [0, 1, 2, 3], 20), camera("view", "human", [0, 2], 100)],
    )


def row_of(folder: Path) -> tuple[Facts, bytes | None]:
    (found,) = scan_folder(folder).found.values()
    (row,) = read_found(folder, found)
    return row


def test_the_library_and_rerun_show_what_was_recorded(episode: Made, tmp_path: Path) -> None:
    files = episode.write(tmp_path / "recordings")
    write_into_description(files.json, ("good", "demo"), "a note")
    facts, picture = row_of(files.json.parent)
    shown = dataclasses.asdict(facts)
    expected = {
        "kind": "workbench",
        "task": "Made-v1",
        "uid": episode.info.id,
        "written": 1795255207.0,
        "seed": 0,
        "env_index": 2,
        "length": STEPS,
        "max_episode_steps": 50,
        "total_reward": 7.0,
        "success": False,
        "success_once": True,
        "fail": True,
        "control_mode": "pd_ee_pose",
        "acted_by": "random; from step 3 on: sliders",
        "source_hash": "0123456789ab",
    }
    assert shown == {**shown, **expected, "tags": ("good", "demo"), "note": "a note", "recovered": False}
    assert facts.problem is None and picture is not None
    # The last picture of the camera for people, although the sensor has a later one.
    assert np.asarray(Image.open(io.BytesIO(picture))).mean() == pytest.approx(120, abs=2)
    alone = tmp_path / "alone"
    alone.mkdir()
    shutil.copy(files.rrd, alone)
    facts, _ = row_of(alone)
    shown = dataclasses.asdict(facts)
    assert shown == {**shown, **expected, "kind": "rrd only", "tags": (), "note": ""}
    properties = read_properties(files.rrd)
    assert properties["versions"] == episode.info.versions
    assert properties["source"]["files"] == ["push.py", "parts/lib.py"]
    seen = properties["episode"]
    assert (seen["fail_once"], seen["observed_by"], seen["return"]) == (True, "later version", 7.0)
    assert json.loads(seen["reset_options"]) == episode.info.reset_options
    of_file = read_rrd(files.rrd)["/__properties"]
    (title,) = of_file["RecordingInfo:name"].values[0]
    assert {"Made-v1", "seed", "0", "env", "2:", "fail,", "3"} <= set(title.split())
    (start,) = of_file["RecordingInfo:start_time"].values[0]
    assert int(start) == 1795255207 * 10**9


def shades_of(track: CameraTrack) -> list[float]:
    assert track.rgb is not None
    return [float(picture.mean()) for picture in track.rgb]


def assert_as_recorded(read: Episode, episode: Made, source_file: str) -> None:
    texts = {"push.py": "Made-v1", "parts/lib.py": "x = 1\n"}
    wanted = dataclasses.replace(episode.info, source=texts, source_file=source_file)
    assert read.info == wanted
    assert read.segmentation == episode.segmentation and read.geometry is not None
    assert read.geometry.num_envs == 1 and read.geometry.body_kinds == episode.geometry.body_kinds
    for name in ("reward", "terminated", "truncated"):
        np.testing.assert_array_equal(getattr(read, name), getattr(episode, name), strict=True)
    for track, original in zip(read.cameras, episode.cameras, strict=True):
        assert_equal((track.info, track.frame), (original.info, original.frame))
        np.testing.assert_allclose(track.pose, original.pose, atol=1e-6)
        assert original.rgb is not None and track.depth is None
        assert shades_of(track) == pytest.approx([one.mean() for one in original.rgb], abs=2)


def test_every_field_is_read_back_with_and_without_the_other_files(
    episode: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = episode.write(tmp_path / "recordings")
    assert episode.info.source_file is not None
    assert_as_recorded(read_episode(files.json), episode, episode.info.source_file)
    monkeypatch.chdir(tmp_path / "tasks")
    files.h5.unlink()
    files.json.unlink()
    assert_as_recorded(read_episode(files.rrd), episode, "push.py")


def test_a_return_that_is_no_number_is_shown_as_that(make_episode: Maker, tmp_path: Path) -> None:
    files = make_episode(3, reward=np.array([1, np.nan, 2], np.float32)).write(tmp_path)
    facts, _ = row_of(tmp_path)
    assert facts.problem is None and facts.total_reward is not None and np.isnan(facts.total_reward)
    assert files.json.read_text().startswith("{\n  ") and read_episode(files.json).broken_files == ()
    write_into_description(files.json, ("odd",), "")
    assert files.json.read_text().startswith("{\n  ") and row_of(tmp_path)[0].tags == ("odd",)


def test_moved_cameras_are_recorded_with_the_states_from_which_they_were_moved(
    episode: Made, tmp_path: Path
) -> None:
    for track, x in zip(episode.cameras, (0.0, 5.0)):
        track.info = dataclasses.replace(track.info, settings=settings(x))
    writer = episode.writer(tmp_path)
    for state, row in enumerate(episode.rows()):
        if state == 1:
            writer.placed(("human", "view"), settings(6.0))
        if state == 2:
            writer.placed(("sensor", "eye"), settings(1.0), settings(2.0))
        if state == 3:
            writer.placed(("human", "view"), None)
            writer.acted_by("policy")
        # In another order than the cameras were announced.
        append(writer, dataclasses.replace(row, pictures=row.pictures[::-1]))
    files = writer.finish()
    for track in read_episode(files.json).cameras:
        first = 20 if track.info.name == "eye" else 100
        assert shades_of(track) == pytest.approx([first + 10 * state for state in track.frame], abs=2)
        assert track.pose[:, 1].tolist() == pytest.approx([first] * len(track.frame))
    moved = (
        MovedCamera(1, "human", "view", settings(6.0), settings(5.0)),
        MovedCamera(2, "sensor", "eye", settings(1.0), settings(2.0)),
        MovedCamera(3, "human", "view", settings(5.0), settings(5.0)),
    )
    info = read_episode(files.json).info
    assert info.moved_cameras == moved
    assert info.acted_by == (*episode.info.acted_by, (2, "policy"))
    held = differences_from_source(info)
    assert held["observed_by"] == "later version"
    assert [one["state"] for one in held["moved_cameras"]] == [1, 2, 3]
    plain = dataclasses.replace(info, moved_cameras=(), observed_by="")
    assert differences_from_source(plain) == {}
    assert "eye" in read_properties(files.rrd)["episode"]["moved_cameras"]


def test_a_camera_without_settings_cannot_have_been_moved(episode: Made, tmp_path: Path) -> None:
    writer = episode.writer(tmp_path)
    writer.placed(("sensor", "eye"), settings(1.0))
    for row in episode.rows():
        append(writer, row)
    assert read_episode(writer.finish().json).info.moved_cameras == ()


@pytest.mark.parametrize(
    ("success", "fail", "last", "once", "outcome"),
    [
        ([1, 1, 0, 0], [0, 1, 0, 0], (False, False), (True, True), "no success"),
        ([1, 0, 0, 1], [0, 0, 0, 1], (True, True), (True, True), "success"),
        ([0, 0, 0, 0], [1, 0, 0, 1], (False, True), (False, True), "fail"),
        (None, [0, 0, 0, 0], (None, False), (None, False), "no success"),
    ],
)
def test_an_outcome_is_told_of_the_last_state_and_of_any(
    make_episode: Maker,
    tmp_path: Path,
    success: list[int] | None,
    fail: list[int],
    last: tuple[bool | None, bool],
    once: tuple[bool | None, bool],
    outcome: str,
) -> None:
    flags = {"success": success, "fail": fail}
    evaluate = {name: np.array(flag, bool) for name, flag in flags.items() if flag is not None}
    recovered = dataclasses.replace(make_episode().info, recovered=True)
    files = make_episode(3, info=recovered, evaluate=evaluate).write(tmp_path)
    described = json.loads(files.json.read_bytes())["workbench"]
    assert (described["success"], described["fail"]) == last
    assert (described["success_once"], described["fail_once"]) == once
    facts, _ = row_of(tmp_path)
    assert (facts.success, facts.fail, facts.success_once, facts.recovered) == (*last, once[0], True)
    (title,) = read_rrd(files.rrd)["/__properties"]["RecordingInfo:name"].values[0]
    assert title.endswith(f": {outcome}, 3 steps")
    assert_equal(read_episode(files.json).flags, evaluate)
    for suffix, other in ((".rrd", ".h5"), (".h5", ".rrd")):
        files.json.with_suffix(suffix).rename(tmp_path / "away")
        problem = row_of(tmp_path)[0].problem
        assert problem is not None and f"{files.json.stem}{suffix}" in problem and other not in problem
        if suffix == ".rrd":
            # The file of the states lacks the flags of the first state.
            flags = read_episode(files.json).flags
            assert_equal(
                {name: flag[1:] for name, flag in flags.items()}, {n: f[1:] for n, f in evaluate.items()}
            )
        (tmp_path / "away").rename(files.json.with_suffix(suffix))
    assert row_of(tmp_path)[0].problem is None


@pytest.mark.parametrize(
    ("size", "form", "small"),
    [((60, 90), "PNG", (60, 90)), ((900, 600), "PNG", (96, 64)), ((150, 180), "JPEG", (80, 96))],
)
def test_a_thumbnail_of_another_program_is_made_small(
    episode: Made, tmp_path: Path, size: tuple[int, int], form: str, small: tuple[int, int]
) -> None:
    files = episode.write(tmp_path / "recordings")
    document: dict[str, Any] = json.loads(files.json.read_bytes())
    noise = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8)
    given = Image.fromarray(noise) if form == "JPEG" else Image.new("RGBA", size, (9, 200, 9, 255))
    content = io.BytesIO()
    given.save(content, form)
    encoded = "data:image/png;base64," + base64.b64encode(content.getvalue()).decode()
    document["workbench"]["thumbnail"] = encoded
    files.json.write_text(json.dumps({**document, "workbench_checksum": None}))
    _, picture = row_of(files.json.parent)
    assert picture is not None
    image = Image.open(io.BytesIO(picture))
    assert image.format == "JPEG" and image.size == small
    assert form == "JPEG" or np.abs(np.asarray(image).astype(int) - [9, 200, 9]).max() < 12

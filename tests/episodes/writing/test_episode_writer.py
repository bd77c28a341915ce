"""A recording is written completely under a unique name or not at all, and the recording program continues."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.episodes import Made, Track, journal_of
from tests.drive.rows import EpisodeRow, append
from workbench.envs.camera_data import CameraInfo, Picture
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.rerun.read import read_properties
from workbench.episodes.writing.finish_or_recover import episode_stem, recover
from workbench.episodes.writing.journal import FOLDER
from workbench.episodes.writing.publish import RecordingError

Maker = Callable[..., Made]


@contextmanager
def size_limit(size: int) -> Iterator[None]:
    """Make writes fail half way, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def wide(make_episode: Maker, steps: int = 3) -> Made:
    noise = np.random.default_rng(0).random((steps, 2000)).astype(np.float32)
    return make_episode(steps, action=noise, action_names=tuple(map(str, range(2000))))


def left(folder: Path) -> list[str]:
    """Names of the files in `folder` and in its folder of journals."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_an_episode_is_three_files_of_one_name_and_nothing_else(make_episode: Maker, tmp_path: Path) -> None:
    episode = make_episode()
    files = episode.write(tmp_path / "a" / "b")
    assert {path.stem for path in (files.rrd, files.h5, files.json)} == {episode_stem(episode.info)}
    assert left(tmp_path / "a" / "b") == sorted(path.name for path in (files.rrd, files.h5, files.json))


def test_an_episode_without_a_reward_has_no_return(make_episode: Maker, tmp_path: Path) -> None:
    without = dataclasses.replace(make_episode().info, env_kwargs={"reward_mode": "none"})
    files = make_episode(info=without).write(tmp_path)
    assert json.loads(files.json.read_bytes())["workbench"]["return"] is None
    assert read_properties(files.rrd)["episode"].get("return") is None


def test_existing_files_are_never_overwritten(make_episode: Maker, tmp_path: Path) -> None:
    episode = make_episode()
    stem = episode_stem(episode.info)
    (tmp_path / f"{stem}.rrd").write_text("mine")
    (tmp_path / f"{stem}_2.json").write_text("mine too")
    names = [episode.write(tmp_path).json.stem for _ in range(2)]
    assert names == [f"{stem}_3", f"{stem}_4"]
    assert (tmp_path / f"{stem}.rrd").read_text() == "mine"
    assert not (tmp_path / f"{stem}.h5").exists() and not (tmp_path / f"{stem}_2.rrd").exists()


def test_invalid_rows_are_refused_and_the_episode_continues(make_episode: Maker, tmp_path: Path) -> None:
    info = CameraInfo("eye", "sensor", 4, 3, 1.0, 0.01, 10.0, np.eye(3, dtype=np.float32), None, ("rgb",))
    image, pose = np.zeros((3, 4, 3), np.uint8), np.array([0, 0, 0, 1, 0, 0, 0], np.float32)
    track = Track(info, np.arange(4), np.tile(pose, (4, 1)), rgb=np.tile(image, (4, 1, 1, 1)))
    episode = make_episode(cameras=[track])
    first, second, *_ = episode.rows()
    (picture,) = first.pictures
    writer = episode.writer(tmp_path)

    def assert_refused(row: EpisodeRow, why: str, **changes: Any) -> None:
        with pytest.raises(ValueError, match=why):
            append(writer, dataclasses.replace(row, **changes))

    other, low = (
        Picture("nose", "sensor", 0, pose, rgb=image),
        Picture("eye", "sensor", 0, pose, rgb=image[:2]),
    )
    assert_refused(first, "the scene has 2 bodies", poses=first.poses[:1])
    assert_refused(first, "dtype <U5", evaluate={"phase": np.array("reach")})
    assert_refused(first, "camera nose, which the task does not have", pictures=(other,))
    assert_refused(first, "4 x 2, but the camera is 4 x 3", pictures=(low,))
    assert_refused(
        first, "float32", pictures=(dataclasses.replace(picture, segmentation=np.zeros((3, 4), np.float32)),)
    )
    assert_refused(first, "two pictures of one state", pictures=first.pictures * 2)
    with pytest.raises(ValueError, match="no state yet"):
        make_episode().writer(tmp_path).finish()
    append(writer, first)
    depth = Picture("eye", "sensor", 0, pose, depth=np.zeros((3, 4), np.float32))
    assert_refused(second, "3 numbers; the number of action names is 1", action=np.zeros(3))
    assert_refused(second, "gave rgb first and now depth", pictures=(depth,))
    append(writer, second)
    assert len(writer) == 1
    found = read_episode(writer.finish().rrd)
    assert found.length == 1 and len(found.cameras[0].frame) == 2 and found.evaluate == {}


def test_a_discarded_episode_leaves_no_file(make_episode: Maker, tmp_path: Path) -> None:
    writer = make_episode().writer(tmp_path)
    for row in make_episode().rows():
        append(writer, row)
    assert left(tmp_path) and writer.bytes_written > 500
    writer.discard()
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("room", [0, 4000, 40_000])
def test_a_full_disk_leaves_the_journal_or_nothing(make_episode: Maker, tmp_path: Path, room: int) -> None:
    episode = wide(make_episode)
    with size_limit(room):
        with pytest.raises(RecordingError, match=r"Cannot record Made-v1 .*limit"):
            writer = episode.writer(tmp_path)
            for row in episode.rows():
                append(writer, row)
                journal_of(writer).write()
        if room:
            writer.close()
    assert {Path(name).parent.name for name in left(tmp_path)} <= {FOLDER}
    recovered = recover(tmp_path)
    # Rows of 8 kB: those written before the disk was full are an episode if they hold at least one step.
    assert [read_episode(files.rrd).length for files in recovered] == ([1] if room == 40_000 else [])
    assert len(left(tmp_path)) == 3 * len(recovered)
    assert read_episode(episode.write(tmp_path).rrd).length == 3


@given(task=st.text(max_size=200), seed=st.integers(-1, 2**31 - 1), env=st.integers(0, 5000))
def test_file_names_are_safe_on_any_file_system(task: str, seed: int, env: int) -> None:
    stem = episode_stem(dataclasses.replace(INFO, task=task, seed=seed, env_index=env))
    assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,150}", stem)


def test_a_file_name_tells_task_seed_env_and_local_time(monkeypatch: pytest.MonkeyPatch) -> None:
    written_at = "2026-11-21T08:15:30+00:00"
    info = dataclasses.replace(INFO, task="a/b v1", seed=3, env_index=2, written_at=written_at)
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    time.tzset()
    try:
        assert episode_stem(info) == "a-b-v1_seed0003_env02_2026-11-21T17-15-30"
        assert episode_stem(dataclasses.replace(info, seed=0)).startswith("a-b-v1_seed0000_env02_")
        assert episode_stem(dataclasses.replace(info, seed=-1)).startswith("a-b-v1_noseed_env02_")
    finally:
        monkeypatch.undo()
        time.tzset()


def test_a_row_is_copied_from_the_batch(make_episode: Maker, tmp_path: Path) -> None:
    episode = make_episode()
    poses = episode.poses[0].copy()
    writer = episode.writer(tmp_path)
    append(writer, EpisodeRow(poses))
    poses[:] = -1
    assert len(writer) == 0
    files = writer.finish()
    assert writer.finish() == files and len(left(tmp_path)) == 3
    found = read_episode(files.json)
    assert found.poses is not None
    np.testing.assert_array_equal(found.poses[0], episode.poses[0])


INFO = EpisodeInfo("PushCube-v1", 0, 0, None, "", {}, 0.05, None, "cpu")

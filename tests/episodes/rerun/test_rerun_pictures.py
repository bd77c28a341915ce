"""Pictures of a recording are read lazily."""

from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pytest

from tests.drive.episodes import made, write
from tests.episodes.refused_calls import descriptors
from workbench.episodes.episode import CameraTrack, Episode
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.rerun import entities as layout
from workbench.episodes.rerun import read
from workbench.episodes.row import UnreadableRecording


def camera_of(episode: Episode, rgb: bool = True) -> CameraTrack:
    (track,) = episode.cameras
    assert (track.rgb is not None) == rgb and track.segmentation is not None
    return track


def brightness(episode: Episode, index: int) -> int:
    track = camera_of(episode)
    assert track.rgb is not None
    return int(np.rint(track.rgb[index].mean()))


def test_reading_pictures_of_a_file_damaged_while_open_is_an_error(tmp_path: Path) -> None:
    rrd = write(tmp_path, made(9)).with_suffix(".rrd")
    intact, damaged = read_episode(rrd), read_episode(rrd)
    assert brightness(intact, 4) == pytest.approx(80, abs=3)
    with rrd.open("r+b") as file:
        file.write(bytes(rrd.stat().st_size))
    assert brightness(intact, 5) == pytest.approx(100, abs=3), "its neighbours were read with it"
    with pytest.raises(OSError, match="damaged"):
        brightness(damaged, 4)


@pytest.fixture
def alone(tmp_path: Path) -> Path:
    """An .rrd without its .json and .h5."""
    return write(tmp_path, made(9)).with_suffix(".rrd").rename(tmp_path / "alone.rrd")


@pytest.mark.parametrize("part", np.linspace(0.3, 0.9, 7))
def test_a_damaged_rrd_is_read_in_part_or_refused(alone: Path, part: float) -> None:
    with alone.open("r+b") as file:
        file.seek(int(part * alone.stat().st_size))
        file.write(bytes(500))
    try:
        episode = read_episode(alone)
    except UnreadableRecording as error:
        assert alone.name in str(error)
        return
    assert episode.reward.tolist() == list(range(1, 10))
    (camera,) = episode.cameras
    lost = {name for name in ("rgb", "depth", "segmentation") if getattr(camera, name) is None}
    sentences = " ".join(broken.sentence for broken in episode.broken_files)
    assert lost == {name for name in ("rgb", "depth", "segmentation") if f"base_camera/{name}" in sentences}


def test_damaged_pictures_do_not_cost_the_other_cameras(alone: Path) -> None:
    content = alone.read_bytes()
    place = content.index(b"\xff\xd8\xff\xe0")  # the first JPEG
    alone.write_bytes(content[:place] + bytes(64) + content[place + 64 :])
    episode = read_episode(alone)
    track = camera_of(episode, rgb=False)
    assert track.rgb is None and track.depth is not None
    assert track.depth[3] == pytest.approx(0.3)
    (broken,) = episode.broken_files
    assert broken.sentence == "alone.rrd was changed: pictures are missing (base_camera/rgb)."


def test_pictures_of_several_chunks_are_read_in_any_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(layout, "MAX_PICTURES", 3)
    monkeypatch.setattr(read, "CACHE_BYTES", 0)
    episode = read_episode(write(tmp_path, made(10)).with_suffix(".rrd"))
    assert camera_of(episode).frame.tolist() == list(range(11))
    order = [10, 0, 5, 3, 9, 2, 2, 7]
    assert [brightness(episode, i) for i in order] == pytest.approx([20 * i for i in order], abs=3)
    segmentation = camera_of(episode).segmentation
    assert segmentation is not None
    assert all((segmentation[i] == 1).all() for i in order)


def test_the_file_is_closed_when_the_recording_is_freed(tmp_path: Path) -> None:
    rrd = write(tmp_path, made(9)).with_suffix(".rrd")
    episode = read_episode(rrd)
    assert str(rrd) in descriptors()
    del episode
    gc.collect()
    assert str(rrd) not in descriptors()

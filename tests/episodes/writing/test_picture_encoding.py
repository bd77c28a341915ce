"""Pictures encoded in the background are recorded as if encoded at once, and errors are still reported."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.drive.episodes import Made, Track
from tests.drive.rows import append
from tests.drive.waiting import until
from workbench.envs.camera_data import CameraInfo
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.writing import episode_writer
from workbench.episodes.writing.finish_or_recover import recover
from workbench.episodes.writing.publish import RecordingError

Maker = Callable[..., Made]
STATES = 7


@pytest.fixture
def seen(make_episode: Maker) -> Made:
    """An episode in which each picture is filled with its own number."""
    info = CameraInfo(
        "eye", "sensor", 40, 30, 1.0, 0.01, 10.0, np.eye(3, dtype=np.float32), None, ("segmentation",)
    )
    ids = np.broadcast_to(np.arange(STATES, dtype=np.int32)[:, None, None], (STATES, 30, 40)).copy()
    poses = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (STATES, 1))
    return make_episode(STATES - 1, cameras=[Track(info, np.arange(STATES), poses, segmentation=ids)])


@pytest.fixture
def encoding_blocked(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Block the encoding of pictures until the event is set."""
    go, encode = threading.Event(), episode_writer.encode

    def wait(*args: Any) -> bytes:
        assert go.wait(60)
        return encode(*args)

    monkeypatch.setattr(episode_writer, "encode", wait)
    yield go
    go.set()


def pictures_of(path: Path) -> list[int]:
    (camera,) = read_episode(path).cameras
    assert camera.segmentation is not None
    assert camera.frame.tolist() == list(range(len(camera.segmentation)))
    return [int(camera.segmentation[k][0, 0]) for k in range(len(camera.segmentation))]


def test_steps_do_not_wait_for_their_pictures(
    seen: Made, encoding_blocked: threading.Event, tmp_path: Path
) -> None:
    writer = seen.writer(tmp_path)
    for row in seen.rows():
        append(writer, row)
    assert not encoding_blocked.is_set()
    encoding_blocked.set()
    assert pictures_of(writer.finish().json) == list(range(STATES))


def test_an_encoding_error_is_reported_and_earlier_states_are_kept(
    seen: Made, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    encode = episode_writer.encode

    def fails(modality: Any, picture: np.ndarray) -> bytes:
        if picture[0, 0] == 4:
            raise MemoryError("no room for a picture")
        return encode(modality, picture)

    monkeypatch.setattr(episode_writer, "encode", fails)
    writer = seen.writer(tmp_path)
    with pytest.raises(RecordingError, match="no room for a picture"):
        for row in seen.rows():
            append(writer, row)
        writer.finish()
    writer.close()
    (files,) = recover(tmp_path)
    assert pictures_of(files.json) == [0, 1, 2, 3]


def test_encoded_pictures_no_longer_count_as_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """The total number does not matter: only when too many wait at once does the caller encode them."""
    picture = np.zeros((30, 40), np.int32)
    monkeypatch.setattr(episode_writer, "MAX_PENDING_BYTES", 2 * picture.nbytes)
    encode, by = episode_writer.encode, []

    def noted(*args: Any) -> bytes:
        by.append(threading.current_thread())
        return encode(*args)

    monkeypatch.setattr(episode_writer, "encode", noted)

    def encoded_by_another_thread() -> bool:
        soon = episode_writer.encode_async([("picture/0/segmentation", 3, "segmentation", picture)])
        assert [entry.number for entry in soon.result(60)] == [3]
        return by[-1] is not threading.current_thread()

    for _ in range(8):
        # A picture is done a moment before it no longer counts.
        until(encoded_by_another_thread, "nothing that waits")

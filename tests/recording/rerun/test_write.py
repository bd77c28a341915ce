"""An .rrd is whole whatever the process and the disk around its writer are like, or it is an error."""

from __future__ import annotations

import dataclasses
import errno
import os
import resource
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from tests.drive.episodes import Made, header_of, journal_of
from tests.drive.rows import append
from tests.recording.verify_rrd import verify_rrd
from workbench.recording.rerun import shared_bytes
from workbench.recording.rerun import write as rrd
from workbench.recording.rerun.append_blueprint import blueprint_stream
from workbench.recording.writing.from_journal import episode_in
from workbench.recording.writing.journal import JournalReader

Maker = Callable[..., Made]


@pytest.mark.parametrize("most_kept", [0, 1])
def test_a_disk_that_is_full_at_any_byte_is_an_error_of_the_disk(
    child_process: None,
    make_episode: Maker,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    most_kept: int,
) -> None:
    """Also where the last that it takes is a part of the blueprint, or of the index; with the scene's bytes kept and not."""
    monkeypatch.setattr(shared_bytes, "_MOST_KEPT", most_kept)
    episode = make_episode(30, action=np.random.default_rng(0).random((30, 1)).astype(np.float32))
    writer = episode.writer(tmp_path)
    for row in episode.rows():
        append(writer, row)
    journal = journal_of(writer)
    journal.finish()
    reader = JournalReader(journal.path)
    recorded = episode_in(reader, header_of(journal.path))
    assert recorded is not None
    path = tmp_path / "some.rrd"

    def size_with_room(room: int) -> int:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
        try:
            rrd.write_rrd(recorded, path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        return path.stat().st_size

    whole = [size_with_room(1 << 30) for _ in range(3)][-1]
    before = len(os.listdir("/proc/self/fd"))
    fitted = 0
    for room in [*range(0, whole - 128, whole // 80), *range(whole - 128, whole, 8)]:
        try:
            size = size_with_room(room)
        except OSError as error:
            assert error.errno == errno.EFBIG, room
        else:
            # Where what is compressed says when it was written, two files differ by some bytes: this one found room.
            assert room > whole - 128 and size <= room and verify_rrd(path) is None, (room, size, whole)
            fitted += 1
    assert fitted < 8, "the last bytes were hardly ever too many"
    assert len(os.listdir("/proc/self/fd")) == before
    assert size_with_room(whole + 64) > 0
    assert verify_rrd(path) is None
    reader.close()
    writer.discard()


def test_whoever_has_turned_rerun_off_still_gets_the_whole_recording(
    child_process: None, make_episode: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RERUN", "off")
    episode = make_episode()
    # Blueprints are kept by the task's name.
    episode.info = dataclasses.replace(episode.info, task="NobodyElses-v1")
    files = episode.write(tmp_path)
    assert len(RrdReader(files.rrd).blueprints()) == 1
    assert os.environ["RERUN"] == "off"


def test_a_blueprint_can_be_shown_before_the_recording(make_episode: Maker, tmp_path: Path) -> None:
    path = make_episode().write(tmp_path).rrd
    (inside,) = RrdReader(path).blueprints()
    alone = tmp_path / "alone.rbl"
    content = blueprint_stream(path)
    assert content is not None
    alone.write_bytes(content)
    again = RrdReader(alone)
    assert [entry.recording_id for entry in again.blueprints()] == [inside.recording_id]
    assert again.recordings() == []

"""What of a recording is read only when it is looked at, or not at all because another one has brought it."""

from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from tests.drive.episodes import made, write
from tests.recording.refused_calls import descriptors
from workbench.recording.episode.episode import CameraTrack, Episode
from workbench.recording.reader.read_episode import read_episode
from workbench.recording.rerun import read
from workbench.recording.rerun.chunks import STEP
from workbench.recording.rerun.private_api import IndexedChunk, decode_chunk, index_of


def camera_of(episode: Episode) -> CameraTrack:
    (track,) = episode.cameras
    assert track.rgb is not None and track.segmentation is not None
    return track


def brightness(episode: Episode, index: int) -> int:
    track = camera_of(episode)
    assert track.rgb is not None
    return int(np.rint(track.rgb[index].mean()))


def pictures_in(rrd: Path) -> list[IndexedChunk]:
    places = index_of(RrdReader(rrd).store(), STEP)
    return [place for place in places if "EncodedImage:blob" in place.components and not place.static]


def test_a_chunk_is_decoded_as_rerun_decodes_it(tmp_path: Path) -> None:
    rrd = write(tmp_path, made(5)).with_suffix(".rrd")
    content = rrd.read_bytes()
    theirs = {}
    for chunk in RrdReader(rrd).stream():
        batch = chunk.to_record_batch()
        theirs[chunk.entity_path, chunk.is_static, tuple(sorted(batch.schema.names))] = batch
    places = index_of(RrdReader(rrd).store(), STEP)
    assert len(places) == len(theirs) > 20
    for place in places:
        ours = decode_chunk(content[place.begin : place.end])
        expected = theirs[place.entity, place.static, tuple(sorted(ours.schema.names))]
        for name in ours.schema.names:
            # As words: nan is not nan.
            assert repr(ours.column(name).to_pylist()) == repr(expected.column(name).to_pylist()), (
                place.entity
            )


def test_pictures_are_read_when_they_are_looked_at(tmp_path: Path) -> None:
    rrd = write(tmp_path, made(9)).with_suffix(".rrd")
    intact, damaged = read_episode(rrd), read_episode(rrd)
    assert brightness(intact, 4) == pytest.approx(80, abs=3)
    with rrd.open("r+b") as file:
        for place in pictures_in(rrd):
            file.seek(place.begin)
            file.write(bytes(place.end - place.begin))
    assert brightness(intact, 5) == pytest.approx(100, abs=3), "its neighbours came with it"
    with pytest.raises(OSError, match="damaged"):
        brightness(damaged, 4)
    assert len(read_episode(rrd).reward) == 9, "all else can be read"


def test_a_picture_here_and_there_is_of_the_state_that_it_was_taken_at(tmp_path: Path) -> None:
    episode = read_episode(write(tmp_path, made(10), every=3).with_suffix(".rrd"))
    assert camera_of(episode).frame.tolist() == [0, 3, 6, 9]
    assert [brightness(episode, i) for i in range(4)] == pytest.approx([0, 60, 120, 180], abs=3)


def test_its_file_is_closed_when_a_recording_is_let_go_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rrd = write(tmp_path, made(9)).with_suffix(".rrd")
    monkeypatch.setattr(read, "_chunk_cache", read._ChunkCache())
    episode = read_episode(rrd)
    assert str(rrd) in descriptors()
    del episode
    gc.collect()
    assert str(rrd) not in descriptors()

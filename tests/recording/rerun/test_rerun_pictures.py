"""What of a recording is read only when it is looked at, or not at all because another one has brought it."""

from __future__ import annotations

import dataclasses
import gc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rerun.chunk import RrdReader

from tests.drive.episodes import made, write
from tests.recording.refused_calls import descriptors
from workbench.core.scene.shapes import SharedShapes
from workbench.recording.episode.episode import CameraTrack, Episode
from workbench.recording.reader.read_episode import read_episode
from workbench.recording.rerun import read
from workbench.recording.rerun.chunks import STEP
from workbench.recording.rerun.private_api import IndexedChunk, decode_chunk, index_of
from workbench.recording.rerun.read import RerunTable


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


@given(st.binary(max_size=60))
def test_what_is_no_chunk_is_said_to_be_none(content: bytes) -> None:
    with pytest.raises(ValueError, match="not a chunk"):
        decode_chunk(content)


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


def test_a_deleted_recording_that_is_open_still_has_its_pictures(tmp_path: Path) -> None:
    rrd = write(tmp_path, made(9)).with_suffix(".rrd")
    episode = read_episode(rrd)
    rrd.unlink()
    assert brightness(episode, 6) == pytest.approx(120, abs=3)
    assert camera_of(episode).segmentation[3].tolist() == [[1] * 8] * 6  # type: ignore[index]


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


def test_meshes_of_one_scene_are_read_once(tmp_path: Path) -> None:
    first = made(3, seed=1)
    second = dataclasses.replace(made(3, seed=2), geometry=first.geometry)
    files = [write(tmp_path, episode).with_suffix(".rrd") for episode in (first, second)]
    shapes = SharedShapes()
    known = [len(RerunTable(file, shapes)._known) for file in files]
    assert known == [0, 0], "until somebody has seen what they look like"
    one, two = (read_episode(file, shapes) for file in files)
    alone = read_episode(files[1])
    table = RerunTable(files[1], shapes)
    assert len(table._known) > 2
    assert not any(entity in table._known for entity, _ in table._static)
    assert one.geometry is not None and two.geometry is not None and alone.geometry is not None
    for a, b, c in zip(one.geometry.visuals, two.geometry.visuals, alone.geometry.visuals, strict=True):
        assert a.mesh is b.mesh and a.material is b.material
        assert (b.name, b.bodies.tolist()) == (c.name, c.bodies.tolist())
        np.testing.assert_array_equal(b.mesh.vertices, c.mesh.vertices)
        np.testing.assert_array_equal(b.mesh.faces, c.mesh.faces)
        assert b.material.base_color == c.material.base_color

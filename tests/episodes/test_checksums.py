"""A changed byte in a file of a recording is reported, and the other files are still read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drive.episodes import Made
from workbench.episodes.document import write_into_description
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.reader.read_rows import read_found
from workbench.episodes.reader.scan import scan_folder
from workbench.episodes.row import UnreadableRecording
from workbench.episodes.writing.finish_or_recover import EpisodeFiles

pytestmark = pytest.mark.thorough

Maker = Callable[..., Made]


@pytest.fixture(scope="module")
def episode(make_episode: Maker) -> Made:
    return make_episode(3, env_states={"actors/cube": np.arange(4 * 13, dtype=np.float32).reshape(4, 13)})


@pytest.fixture(scope="module")
def whole(episode: Made, tmp_path_factory: pytest.TempPathFactory) -> EpisodeFiles:
    return episode.write(tmp_path_factory.mktemp("whole"))


@settings(max_examples=150)
@given(
    suffix=st.sampled_from([".json", ".json", ".h5", ".rrd"]),
    places=st.sets(st.floats(0, 1, exclude_max=True), min_size=1, max_size=5),
    bit=st.integers(0, 7),
)
def test_changed_bits_are_reported_wherever_they_are(
    whole: EpisodeFiles, suffix: str, places: set[float], bit: int
) -> None:
    file = whole.json.with_suffix(suffix)
    content = file.read_bytes()
    changed = bytearray(content)
    for place in {int(place * len(content)) for place in places}:
        changed[place] ^= 1 << bit
    file.write_bytes(changed)
    try:
        reported = [broken.file for broken in read_episode(whole.json).broken_files]
    except UnreadableRecording as error:
        reported = [file.name] if file.stem in str(error) else []
    try:
        assert reported == [file.name]
        if suffix == ".json":
            (row,) = scan_folder(file.parent).found.values()
            assert all(facts.problem is not None for facts, _ in read_found(file.parent, row))
    finally:
        file.write_bytes(content)


def test_tagging_keeps_the_checksum_valid_and_an_edit_that_removes_it_is_accepted(
    episode: Made, tmp_path: Path
) -> None:
    files = episode.write(tmp_path)
    write_into_description(files.json, ("good",), "a note")
    assert read_episode(files.json).broken_files == ()
    with files.rrd.open("ab") as file:
        file.write(b" ")
    size = files.rrd.stat().st_size
    assert f"it has {size} bytes, and had {size - 1}" in read_episode(files.json).broken_files[0].what
    (row,) = scan_folder(tmp_path).found.values()
    ((facts, _),) = read_found(tmp_path, row)
    assert facts.problem is not None and f"{files.rrd.name} was cut short or changed" in facts.problem
    files.rrd.write_bytes(files.rrd.read_bytes()[:-1])
    content = bytearray(files.h5.read_bytes())
    content[-100] ^= 1
    files.h5.write_bytes(content)
    document = json.loads(files.json.read_bytes())
    del document["workbench"]["files"][".h5"]
    files.json.write_text(json.dumps(document))
    assert [broken.file for broken in read_episode(files.json).broken_files] == [files.json.name]
    files.json.write_text(json.dumps({**document, "workbench_checksum": None}))
    assert read_episode(files.json).broken_files == ()
    write_into_description(files.json, ("better",), "")
    assert read_episode(files.json).broken_files == ()


def test_tagging_a_changed_document_writes_no_new_checksum(episode: Made, tmp_path: Path) -> None:
    files = episode.write(tmp_path)
    content = files.json.read_bytes().replace(b'"task": "Made-v1"', b'"task": "Fade-v1"')
    files.json.write_bytes(content)
    with pytest.raises(ValueError, match="changed"):
        write_into_description(files.json, ("good",), "")
    assert files.json.read_bytes() == content

"""A changed byte in a file of a recording is said, and what the others hold is there."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xxhash

from tests.drive.episodes import Made
from workbench.recording.episode.document import Checksum, check, checksum, write_into_description
from workbench.recording.episode.row import UnreadableRecording
from workbench.recording.reader.read_episode import read_episode
from workbench.recording.reader.read_rows import read_found
from workbench.recording.reader.scan import scan_folder

Maker = Callable[..., Made]


def flip(path: Path, at: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)


@pytest.fixture
def episode(make_episode: Maker) -> Made:
    return make_episode(
        3,
        action=np.array([[0.5], [1.5], [2.5]], np.float32),
        env_states={"actors/cube": np.arange(4 * 13, dtype=np.float32).reshape(4, 13)},
    )


@pytest.mark.parametrize("suffix", [".rrd", ".h5"])
def test_any_changed_byte_is_said_and_the_other_file_is_read(
    episode: Made, tmp_path: Path, suffix: str
) -> None:
    path = episode.write(tmp_path).json
    file = path.with_suffix(suffix)
    chance = random.Random(0)
    size = file.stat().st_size
    for at in [0, size - 1, *(chance.randrange(size) for _ in range(30))]:
        flip(file, at)
        found = read_episode(path)
        (said,) = found.broken_files
        assert said.sentence.startswith(f"{file.name} was cut short or changed (its checksum differs"), at
        assert (found.poses is None) == (suffix == ".rrd")
        assert (found.env_states == {}) == (suffix == ".h5")
        np.testing.assert_array_equal(found.action, episode.action)
        flip(file, at)
    assert read_episode(path).broken_files == ()


def test_where_both_are_changed_there_is_no_recording(episode: Made, tmp_path: Path) -> None:
    files = episode.write(tmp_path)
    flip(files.rrd, 3000)
    flip(files.h5, 3000)
    with pytest.raises(UnreadableRecording, match=r"\.rrd was cut short or changed .*\.h5 was cut short"):
        read_episode(files.json)


def test_tags_are_no_change_and_a_change_on_purpose_is_believed(episode: Made, tmp_path: Path) -> None:
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
    flip(files.h5, files.h5.stat().st_size - 100)
    said = json.loads(files.json.read_bytes())
    del said["workbench"]["files"][".h5"]
    files.json.write_text(json.dumps(said))
    assert read_episode(files.json).broken_files == ()


@pytest.mark.parametrize("size", [0, 1, 1 << 20, (1 << 20) + 1, 3_000_000])
def test_a_checksum_is_of_the_whole_file(tmp_path: Path, size: int) -> None:
    path = tmp_path / "a.h5"
    content = np.random.default_rng(size).bytes(size)
    path.write_bytes(content)
    found = checksum(path)
    assert found == Checksum(size, xxhash.xxh3_128(content).hexdigest())
    described = {".h5": found, ".rrd": Checksum(5)}
    check(path, described)
    if size:
        flip(path, size - 1)
        with pytest.raises(OSError, match="its checksum differs"):
            check(path, described)

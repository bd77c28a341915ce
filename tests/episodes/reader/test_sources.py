"""Files and folders are resolved to recordings with names."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.episodes.foreign_h5 import write as write_h5
from tests.episodes.library_files import describe
from workbench.episodes.reader.reading import find_all_sources
from workbench.episodes.row import UnreadableRecording


def test_each_recording_is_found_once_however_it_is_named(child_process: None, tmp_path: Path) -> None:
    second, first = describe(tmp_path, "b", id="two"), describe(tmp_path / "a", "z", id="one")
    describe(tmp_path / "c", "copy", id="one")
    theirs = write_h5(tmp_path)
    found = find_all_sources([tmp_path])
    assert [(source.id, source.path, source.name) for source in found] == [
        ("one", first, "z"),
        ("two", second, "b"),
        (f"{theirs}#traj_0", theirs, "theirs#traj_0"),
    ]
    assert find_all_sources([second.with_suffix(".rrd"), tmp_path, second]) == (found[1], found[0], found[2])
    assert find_all_sources([second.with_suffix(".h5")]) == (found[1],)


def test_an_empty_folder_is_skipped_and_a_file_that_is_no_recording_is_refused(
    child_process: None, tmp_path: Path
) -> None:
    folder, empty, other = tmp_path / "recordings", tmp_path / "empty", tmp_path / "notes.txt"
    describe(folder, "a", id="one")
    empty.mkdir()
    other.write_text("")
    assert [source.id for source in find_all_sources([empty, folder])] == ["one"]
    with pytest.raises(UnreadableRecording, match=f"no recording in {other}. Recordings are"):
        find_all_sources([folder, other])
    with pytest.raises(UnreadableRecording, match=f"no recording in {empty}, {empty}. Recordings are"):
        find_all_sources([empty, empty])
    with pytest.raises(FileNotFoundError, match=f"{tmp_path / 'none'} does not exist:"):
        find_all_sources([folder, tmp_path / "none"])
    with pytest.raises(UnreadableRecording, match="No recording given"):
        find_all_sources([])

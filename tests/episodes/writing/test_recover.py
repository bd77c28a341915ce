"""What a dead writer leaves becomes an episode, whatever fails meanwhile; nothing else is touched."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.drive.episodes import Made, entries_of, journal_of
from tests.drive.rows import append
from tests.drive.waiting import until
from tests.episodes.refused_calls import descriptors, refused
from workbench.envs.scene.shapes import Mesh
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.writing.finish_or_recover import recover
from workbench.episodes.writing.journal import FOLDER, Journal, JournalEntry
from workbench.episodes.writing.publish import RecordingError

Maker = Callable[..., Made]


@pytest.mark.thorough
def test_a_killed_writer_was_given_time_to_lose_nothing(make_episode: Maker, tmp_path: Path) -> None:
    """Rows that were appended long ago are there though none came after them."""
    episode = make_episode(5)
    writer = episode.writer(tmp_path)
    for k, row in enumerate(episode.rows()):
        if k == 4:
            writer.acted_by("somebody else")
        append(writer, row)
    journal = next((tmp_path / FOLDER).glob("*.arrow"))
    until(lambda: journal.stat().st_size == writer.bytes_written, "all rows")
    assert recover(tmp_path) == []  # its writer lives
    writer.close()
    (files,) = recover(tmp_path)
    found = read_episode(files.h5)
    acted_by = (*episode.info.acted_by, (3, "somebody else"))
    assert found.info == dataclasses.replace(episode.info, recovered=True, acted_by=acted_by)
    assert found.length == 5


SCHEMA = 200
"""Bytes with which a journal begins and that hold no data."""
DAMAGE = st.one_of(
    st.tuples(st.just("cut"), st.floats(0, 1)),
    st.tuples(st.just("flip"), st.floats(0, 0.03) | st.floats(0, 0.999)),
    st.tuples(st.just("more"), st.binary(min_size=1, max_size=300)),
)


@pytest.mark.thorough
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(damage=DAMAGE, bit=st.integers(0, 7))
def test_a_journal_that_is_cut_or_changed_anywhere_gives_its_whole_states_or_stays(
    make_episode: Maker, tmp_path: Path, damage: tuple[str, Any], bit: int
) -> None:
    """A killed process cuts it, and after a power cut a file may be as long as it was meant to be, and hold something else."""
    folder = Path(tempfile.mkdtemp(dir=tmp_path))
    episode = make_episode(6)
    writer = episode.writer(folder)
    ends = []
    for row in episode.rows():
        append(writer, row)
        journal_of(writer).write()
        ends.append(journal_of(writer).size)
    writer.close()
    path = folder / FOLDER / f"{episode.info.id}.arrow"
    content = bytearray(path.read_bytes())
    (kind, where), whole = damage, len(ends)
    place = int(where * len(content)) if kind != "more" else 0
    if kind == "cut":
        # At the end of a state, as often as in one.
        place = ends[place % len(ends)] if bit % 2 else place
        del content[place:]
        whole = sum(end <= place for end in ends)
    elif kind == "flip":
        content[place] ^= 1 << bit
    else:
        content += bytes(1000) + where
    path.write_bytes(content)
    try:
        recover(folder)
    except RecordingError:
        assert kind == "flip" and place >= SCHEMA
        left_over = [one for one in (folder / FOLDER).iterdir() if one.suffix in (".arrow", ".damaged")]
        assert [one.read_bytes() for one in left_over] == [bytes(content)]
        if left_over[0].suffix == ".damaged":
            recover(folder)  # it was said once
            assert left_over[0].exists()
        return
    found = [read_episode(path) for path in folder.glob("*.json")]
    states = [len(one.poses) for one in found if one.poses is not None]
    # All of it is there, or all but what stands last and cannot be told from what was being written.
    assert states == ([whole] if whole > 1 else []) or (kind == "flip" and states == [6] and place >= SCHEMA)
    for one in found if kind != "flip" else ():  # no checksum is in a journal
        np.testing.assert_array_equal(one.poses, episode.poses[: states[0]])
        np.testing.assert_array_equal(one.action, episode.action[: states[0] - 1])


def test_a_journal_without_a_step_is_cleared_away(make_episode: Maker, tmp_path: Path) -> None:
    writer = make_episode().writer(tmp_path)
    append(writer, next(iter(make_episode().rows())))
    journal_of(writer).write()
    writer.close()
    Journal(tmp_path / FOLDER / "empty.arrow").close()
    (tmp_path / FOLDER / "stray.rrd").write_text("half")
    (tmp_path / "mine.txt").write_text("mine")
    assert recover(tmp_path) == []
    assert os.listdir(tmp_path) == ["mine.txt"]
    assert recover(tmp_path / "nowhere") == []


def test_without_its_meshes_an_episode_is_recovered_bare(make_episode: Maker, tmp_path: Path) -> None:
    episode = make_episode()
    writer = episode.writer(tmp_path)
    for row in episode.rows():
        append(writer, row)
    journal_of(writer).write()
    writer.close()
    scene = next((tmp_path / FOLDER).glob("*.scene"))
    scene.write_bytes(scene.read_bytes()[:-100])
    (files,) = recover(tmp_path)
    found = read_episode(files.rrd)
    assert found.geometry is not None and found.poses is not None
    assert found.geometry.visuals == () and found.geometry.body_names == episode.geometry.body_names
    np.testing.assert_array_equal(found.poses, episode.poses)


def test_files_of_another_folder_are_no_strays(tmp_path: Path) -> None:
    folder, other = tmp_path / "recordings", tmp_path / "other"
    folder.mkdir()
    other.mkdir()
    (other / "precious.json").write_text("{}")
    (folder / FOLDER).symlink_to(other)
    with pytest.raises(RecordingError, match="is a link"):
        recover(folder)
    assert (other / "precious.json").exists()


def left(episode: Made, folder: Path, **info: object) -> Path:
    """The journal of `episode` as a writer leaves it that dies before it makes the files."""
    episode.info = dataclasses.replace(episode.info, **info)  # type: ignore[arg-type]
    writer = episode.writer(folder)
    for row in episode.rows():
        append(writer, row)
    journal_of(writer).write()
    writer.close()
    return folder / FOLDER / f"{episode.info.id}.arrow"


def lengths(folder: Path) -> dict[str, int]:
    """Of each whole recording, by its id; there is nothing else in the folder."""
    found = {episode.info.id: episode.length for episode in map(read_episode, folder.glob("*.json"))}
    assert len(list(folder.iterdir())) == 3 * len(found), sorted(path.name for path in folder.iterdir())
    return found


@pytest.mark.parametrize("named", [[".h5"], [".h5", ".rrd"]])
def test_of_a_writer_that_died_between_two_names_only_what_it_named_itself_is_taken_back(
    make_episode: Maker, tmp_path: Path, named: list[str]
) -> None:
    """The first name was another recording's, so it was at the second."""
    left(make_episode(2), tmp_path, id="0", written_at="2026-11-21T12:00:00+00:00")
    (first,) = recover(tmp_path)
    journal = left(make_episode(4), tmp_path, id="1", written_at="2026-11-21T12:00:00+00:00")
    for suffix in named:
        journal.with_suffix(suffix).write_text("made, and not named in full")
        os.link(journal.with_suffix(suffix), tmp_path / f"{first.json.stem}_2{suffix}")
    (second,) = recover(tmp_path)
    assert second.json.stem == f"{first.json.stem}_2"
    assert lengths(tmp_path) == {"0": 2, "1": 4}


@pytest.mark.thorough
@pytest.mark.parametrize("then", [0, pytest.param(errno.EROFS, marks=pytest.mark.slow)])
def test_whatever_call_fails_the_next_recovery_makes_each_episode_whole_and_once(
    make_episode: Maker, tmp_path: Path, then: int
) -> None:
    def begun(folder: Path) -> Path:
        left(make_episode(2), folder, id="0")
        (folder / FOLDER / "stray.rrd").write_text("half")
        return folder

    folder = begun(tmp_path / "0")
    with refused() as calls:
        recover(folder)
    assert {call.split()[0] for call in calls} >= {"open", "fsync", "link", "unlink", "rmdir"}
    for at, call in enumerate(calls, 1):
        folder = begun(tmp_path / str(at))
        before = descriptors()
        with refused(at, then=then):
            try:
                recover(folder)
            except RecordingError:
                pass
        assert descriptors() == before, call
        recover(folder)
        assert lengths(folder) == {"0": 2}, call


def refused_by_rerun(make_episode: Maker, folder: Path) -> None:
    episode = make_episode()
    (visual,) = episode.geometry.visuals
    flat = dataclasses.replace(visual, mesh=Mesh(np.zeros((3, 2), np.float32), visual.mesh.faces))
    episode.geometry = dataclasses.replace(episode.geometry, visuals=(flat,))
    left(episode, folder, id="0")


def not_a_state(make_episode: Maker, folder: Path) -> None:
    changed(left(make_episode(), folder, id="0"), "layout", lambda text: text.replace(b"<f4", b"<f8"))


def of_a_camera_that_is_not_there(make_episode: Maker, folder: Path) -> None:
    path = left(make_episode(), folder, id="0")
    changed(path, "acted", lambda text: text, more=JournalEntry("camera/7", 0, bytes(28)))


def of_another_version(make_episode: Maker, folder: Path) -> None:
    def further(text: bytes) -> bytes:
        header = json.loads(text)
        return json.dumps({**header, "info": json.dumps({**json.loads(header["info"]), "later": 1})}).encode()

    changed(left(make_episode(), folder, id="0"), "header", further)


def changed(
    path: Path, kind: str, change: Callable[[bytes], bytes], more: JournalEntry | None = None
) -> None:
    """Write the journal again with another value of the entries of a kind, and one entry `more` before the last row."""
    entries = entries_of(path)
    path.unlink()
    journal = Journal(path)
    for number, entry in enumerate(entries):
        if more is not None and number == len(entries) - 1:
            journal.append(more)
        value = change(entry.value) if entry.kind == kind else entry.value
        journal.append(JournalEntry(entry.kind, entry.number, value))
    journal.finish()
    journal.close()


@pytest.mark.parametrize(
    "broken",
    [refused_by_rerun, not_a_state, of_a_camera_that_is_not_there, of_another_version],
)
def test_one_that_cannot_be_an_episode_is_told_and_kept_and_the_others_are_made(
    make_episode: Maker, tmp_path: Path, broken: Callable[[Maker, Path], None]
) -> None:
    broken(make_episode, tmp_path)
    left(make_episode(4), tmp_path, id="1")
    before = descriptors()
    for _ in range(2):
        with pytest.raises(RecordingError, match="Cannot recover|Cannot write"):
            recover(tmp_path)
        (path,) = tmp_path.glob("*.json")
        assert read_episode(path).length == 4
        assert sorted(path.name for path in (tmp_path / FOLDER).iterdir()) == ["0.arrow", "0.scene"]
    assert descriptors() == before

"""The journal of a dead writer is recovered to an episode, whatever fails meanwhile; no other file is touched."""

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
from tests.episodes.refused_calls import descriptors, left_open, refused
from workbench.envs.scene.shapes import Mesh, SceneGeometry
from workbench.envs.task_drawings import Drawing
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.writing.finish_or_recover import recover, remove_episode
from workbench.episodes.writing.journal import FOLDER, Journal, JournalEntry, read_visuals, write_scene
from workbench.episodes.writing.publish import RecordingError

Maker = Callable[..., Made]


@pytest.mark.thorough
def test_a_killed_writer_loses_no_row_that_had_time_to_be_written(
    make_episode: Maker, tmp_path: Path
) -> None:
    """Rows that were appended long ago are written though no further row followed."""
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


def dot(state: int) -> Drawing:
    """A drawing that changes with every state."""
    return Drawing("points", np.full((1, 1, 3), state, np.float32))


SCHEMA_BYTES = 200
"""Length of a journal's schema, which precedes the data."""
DAMAGE = st.one_of(
    st.tuples(st.just("cut"), st.floats(0, 1)),
    st.tuples(st.just("flip"), st.floats(0, 0.03) | st.floats(0, 0.999)),
    st.tuples(st.just("more"), st.binary(min_size=1, max_size=300)),
)


@pytest.mark.thorough
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(damage=DAMAGE, bit=st.integers(0, 7))
def test_a_truncated_or_changed_journal_gives_its_complete_states_or_is_kept(
    make_episode: Maker, tmp_path: Path, damage: tuple[str, Any], bit: int
) -> None:
    """A killed process truncates it; after a power failure it may have its full length but other content."""
    folder = Path(tempfile.mkdtemp(dir=tmp_path))
    episode = make_episode(6)
    episode.drawn = [{"dot": dot(state)} for state in range(7)]
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
        # Half of the cuts are at the end of a state, half within one.
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
        assert kind == "flip" and place >= SCHEMA_BYTES
        left_over = [one for one in (folder / FOLDER).iterdir() if one.suffix in (".arrow", ".damaged")]
        assert [one.read_bytes() for one in left_over] == [bytes(content)]
        if left_over[0].suffix == ".damaged":
            recover(folder)  # it was already reported
            assert left_over[0].exists()
        return
    found = [read_episode(path) for path in folder.glob("*.json")]
    states = [len(one.poses) for one in found if one.poses is not None]
    # All states are recovered, or all but the last entry, which may look like an unfinished write.
    assert states == ([whole] if whole > 1 else []) or (
        kind == "flip" and states == [6] and place >= SCHEMA_BYTES
    )
    for one in found if kind != "flip" else ():  # a journal has no checksums
        np.testing.assert_array_equal(one.poses, episode.poses[: states[0]])
        np.testing.assert_array_equal(one.action, episode.action[: states[0] - 1])
        for state in range(states[0]):
            np.testing.assert_array_equal(one.drawings_at(state)["dot"].data, dot(state).data)


def test_a_journal_without_a_step_is_removed(make_episode: Maker, tmp_path: Path) -> None:
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


def test_files_of_another_folder_are_not_taken_for_leftovers(tmp_path: Path) -> None:
    folder, other = tmp_path / "recordings", tmp_path / "other"
    folder.mkdir()
    other.mkdir()
    (other / "precious.json").write_text("{}")
    (folder / FOLDER).symlink_to(other)
    with pytest.raises(RecordingError, match="is a link"):
        recover(folder)
    assert (other / "precious.json").exists()


def left(episode: Made, folder: Path, **info: object) -> Path:
    """Write the journal of `episode` as left by a writer that dies before it writes the files; returns its path."""
    episode.info = dataclasses.replace(episode.info, **info)  # type: ignore[arg-type]
    writer = episode.writer(folder)
    for row in episode.rows():
        append(writer, row)
    journal_of(writer).write()
    writer.close()
    return folder / FOLDER / f"{episode.info.id}.arrow"


def lengths(folder: Path) -> dict[str, int]:
    """Length of each complete recording, by its id; asserts that the folder holds nothing else."""
    found = {episode.info.id: episode.length for episode in map(read_episode, folder.glob("*.json"))}
    assert len(list(folder.iterdir())) == 3 * len(found), sorted(path.name for path in folder.iterdir())
    return found


def test_an_episode_is_recovered_without_its_lost_meshes(make_episode: Maker, tmp_path: Path) -> None:
    episode = make_episode()
    scene = left(episode, tmp_path).with_suffix(".scene")
    scene.write_bytes(scene.read_bytes()[:-100])
    (files,) = recover(tmp_path)
    found = read_episode(files.rrd)
    assert found.geometry is not None and found.poses is not None
    assert found.geometry.visuals == () and found.geometry.body_names == episode.geometry.body_names
    np.testing.assert_array_equal(found.poses, episode.poses)


@pytest.mark.parametrize("named", [[".h5"], [".h5", ".rrd"]])
def test_after_a_death_between_two_renames_only_the_writers_own_names_are_undone(
    make_episode: Maker, tmp_path: Path, named: list[str]
) -> None:
    """The first name belonged to another recording, so the writer was at its second choice."""
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
def test_whatever_call_fails_the_next_recovery_completes_each_episode_once(
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
        assert left_open(before) == [], call
        recover(folder)
        assert lengths(folder) == {"0": 2}, call


def change_journal(
    path: Path,
    kind: str = "",
    change: Callable[[bytes], bytes] = lambda text: text,
    more: JournalEntry | None = None,
) -> None:
    """Rewrite the journal with changed values of the entries of a kind, and one entry `more` before the last row."""
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


def of_a_later_version(text: bytes) -> bytes:
    header = json.loads(text)
    return json.dumps({**header, "info": json.dumps({**json.loads(header["info"]), "later": 1})}).encode()


def flatten_mesh(journal: Path) -> None:
    """Store a mesh that rerun refuses."""
    scene = journal.with_suffix(".scene")
    (visual,) = read_visuals(scene)
    flat = dataclasses.replace(visual, mesh=Mesh(np.zeros((3, 2), np.float32), visual.mesh.faces))
    scene.unlink()
    write_scene(SceneGeometry(1, (), (), (), (flat,)), scene)


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: change_journal(path, "layout", lambda text: text.replace(b"<f4", b"<f8")),
        lambda path: change_journal(path, "header", of_a_later_version),
        lambda path: change_journal(path, more=JournalEntry("camera/7", 0, bytes(28))),
        lambda path: change_journal(path, more=JournalEntry("drawing", 0, b"\x93\xa1a\xa4blob\x90")),
        flatten_mesh,
    ],
    ids=["no state", "a later version", "a missing camera", "no drawing", "a flat mesh"],
)
def test_an_unrecoverable_journal_is_reported_and_kept_and_the_others_are_recovered(
    make_episode: Maker, tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    damage(left(make_episode(), tmp_path, id="0"))
    left(make_episode(4), tmp_path, id="1")
    before = descriptors()
    for _ in range(2):
        with pytest.raises(RecordingError, match="Cannot recover|Cannot write"):
            recover(tmp_path)
        (path,) = tmp_path.glob("*.json")
        assert read_episode(path).length == 4
        assert sorted(path.name for path in (tmp_path / FOLDER).iterdir()) == ["0.arrow", "0.scene"]
    assert left_open(before) == []


def test_only_the_traces_of_one_episode_are_removed(make_episode: Maker, tmp_path: Path) -> None:
    for id in ("1", "2"):
        left(make_episode(2), tmp_path, id=id)
    assert len(recover(tmp_path)) == 2
    for id in ("3", "33"):
        left(make_episode(3), tmp_path, id=id)
    remove_episode(tmp_path, "Made-v1", 8, "1")
    remove_episode(tmp_path, "Made-v1", 7, "2")
    remove_episode(tmp_path, "Made-v1", 7, "3")
    remove_episode(tmp_path, "Made-v1", 7, "none")
    assert {path.stem for path in (tmp_path / FOLDER).iterdir()} == {"33"}
    assert len(recover(tmp_path)) == 1
    assert lengths(tmp_path) == {"1": 2, "33": 3}

"""The end of an episode: whatever system call fails, either its files exist or its journal does."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.drive.episodes import Made, journal_of
from tests.drive.rows import append
from tests.episodes.refused_calls import descriptors, left_open, refused
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.writing.episode_writer import EpisodeWriter
from workbench.episodes.writing.finish_or_recover import SUFFIXES, recover
from workbench.episodes.writing.journal import FOLDER
from workbench.episodes.writing.publish import RecordingError

pytestmark = pytest.mark.thorough

Maker = Callable[..., Made]


def recorded(make_episode: Maker, folder: Path) -> EpisodeWriter:
    episode = make_episode(2)
    writer = episode.writer(folder)
    for row in episode.rows():
        append(writer, row)
    return writer


@pytest.mark.parametrize(
    "again, then",
    [
        ("finish", 0),
        pytest.param("recover", 0, marks=pytest.mark.slow),
        pytest.param("recover", errno.EROFS, marks=pytest.mark.slow),
    ],
)
def test_whatever_call_fails_the_retry_writes_the_files_once(
    make_episode: Maker, tmp_path: Path, again: str, then: int
) -> None:
    writer = recorded(make_episode, tmp_path / "0")
    with refused() as calls:
        writer.finish()
    assert {call.split()[0] for call in calls} >= {"pwrite", "open", "fsync", "link", "unlink", "rmdir"}
    of_files = [n for n, call in enumerate(calls) if call.startswith("fsync") and call.endswith(SUFFIXES)]
    assert len(of_files) == 3 and max(of_files) < min(n for n, c in enumerate(calls) if c.startswith("link"))
    for at, call in enumerate(calls, 1):
        folder, before = tmp_path / str(at), descriptors()
        writer = recorded(make_episode, folder)
        made = True
        with refused(at, then=then):
            try:
                writer.finish()
            except RecordingError:
                made = False
        whole = list(folder.glob("*.json"))
        assert len(whole) == made or then, call
        if again == "finish":
            writer.finish()
        writer.close()
        assert left_open(before) == [], call
        recover(folder)
        if again == "recover" and call.startswith("pwrite"):
            assert os.listdir(folder) == [], "its rows were only in memory"
            continue
        (path,) = folder.glob("*.json")
        assert read_episode(path).length == 2 and read_episode(path).broken_files == (), call
        assert len(os.listdir(folder)) == 3, call
        assert not (folder / FOLDER).exists()


@pytest.mark.parametrize("then", [0, errno.EROFS])
def test_whatever_call_fails_when_an_episode_begins_is_reported(
    make_episode: Maker, tmp_path: Path, then: int
) -> None:
    episode = make_episode(2)
    with refused() as calls:
        episode.writer(tmp_path / "0").discard()
    for at, call in enumerate(calls, 1):
        folder, before = tmp_path / str(at), descriptors()
        episode.geometry = make_episode().geometry  # no other episode of the process shares its meshes
        with refused(at, then=then):
            try:
                episode.writer(folder).discard()
            except RecordingError as error:
                assert "Cannot record Made-v1" in str(error), call
        assert left_open(before) == [], call
        recover(folder)
        assert not folder.exists() or os.listdir(folder) == [], call


@pytest.mark.parametrize("lost", [1, 3])
def test_an_episode_of_which_the_disk_lost_states_is_not_exported_and_keeps_its_journal(
    make_episode: Maker, tmp_path: Path, lost: int
) -> None:
    episode, ends = make_episode(6), []
    writer = episode.writer(tmp_path)
    for row in episode.rows():
        append(writer, row)
        journal_of(writer).write()
        ends.append(journal_of(writer).size)
    os.truncate(journal_of(writer).path, ends[-1 - lost])
    with pytest.raises(RecordingError):
        writer.finish()
    assert [path.name for path in tmp_path.iterdir()] == [FOLDER]
    (made,) = recover(tmp_path)
    assert read_episode(made.json).length == 6 - lost

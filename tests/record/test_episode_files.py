"""The files of episodes are written one by one, at the end on two threads, and each reports its own result."""

from __future__ import annotations

import shutil
from pathlib import Path

from tests.drive.episodes import appended, made
from workbench.episodes.writing.episode_writer import EpisodeFiles
from workbench.record.gather import EpisodeFinisher, GatheredEpisode


def test_the_error_of_one_episode_is_not_lost_when_the_next_is_written(tmp_path: Path) -> None:
    folders = (tmp_path / "gone", tmp_path / "there")
    episodes = [
        GatheredEpisode(appended(folder, made(3), pictures=False), env=env, seed=0)
        for env, folder in enumerate(folders)
    ]
    shutil.rmtree(folders[0])
    finisher = EpisodeFinisher()
    futures = [finisher.finish(episode) for episode in episodes]
    finisher.close()
    lost, kept = (future.result() for future in futures)
    assert isinstance(lost, str) and "env 0" in lost and "gone" in lost
    assert isinstance(kept, EpisodeFiles) and kept.rrd.is_file()


class Panic(BaseException):
    """Like a panic in rerun's Rust code: not an `Exception`."""


def test_a_panic_fails_one_episode_and_is_no_longer_waited_for(tmp_path: Path) -> None:
    panics = [Panic("in Rust")]

    def then(files: EpisodeFiles) -> None:
        while panics:
            raise panics.pop()

    finisher = EpisodeFinisher(then=then)
    episodes = [
        GatheredEpisode(appended(tmp_path / name, made(3), pictures=False), env=0, seed=0) for name in "ab"
    ]
    lost, kept = (finisher.finish(episode).result(60) for episode in episodes)
    assert isinstance(lost, str) and "in Rust" in lost
    assert isinstance(kept, EpisodeFiles)
    assert finisher.waiting == 0 and finisher.finished.count == 1
    finisher.close()

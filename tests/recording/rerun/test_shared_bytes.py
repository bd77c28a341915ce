"""A file that is put together of kept bytes is one that rerun could have written."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from tests.drive.episodes import Made
from tests.recording.read_rrd import read_rrd
from tests.recording.verify_rrd import verify_rrd
from workbench.recording.reader.read_episode import read_episode

Maker = Callable[..., Made]
EPISODES = 4
"""The first is written as a whole, the second too, and its bytes are kept."""


@pytest.fixture
def written(make_episode: Maker, tmp_path: Path) -> list[Path]:
    """Recordings of one scene, without pictures; all but the seed is the same."""
    episode = make_episode(5)
    paths = []
    for seed in range(EPISODES):
        episode.info = dataclasses.replace(episode.info, seed=seed, id=f"{seed}")
        paths.append(episode.write(tmp_path).rrd)
    return paths


def test_every_file_holds_the_same(written: list[Path]) -> None:
    first, *others = (read_rrd(path) for path in written)
    for other in others:
        assert other.keys() == first.keys()
        for entity, columns in first.items():
            assert other[entity].keys() == columns.keys()
            if entity.startswith(("/__properties", "/logs")):  # with the seed in them
                continue
            for name, column in columns.items():
                again = other[entity][name]
                np.testing.assert_equal((again.steps, again.values), (column.steps, column.values))
    for seed, path in enumerate(written):
        episode = read_episode(path)
        assert episode.info.seed == seed and not episode.broken_files


def test_rerun_finds_nothing_wrong(child_process: None, written: list[Path]) -> None:
    for path in (written[0], written[-1]):
        assert verify_rrd(path) is None
    readers = [RrdReader(path) for path in written]
    recordings = [recording for reader in readers for recording in reader.recordings()]
    assert len({recording.recording_id for recording in recordings}) == EPISODES
    assert [len(reader.blueprints()) for reader in readers] == [1] * EPISODES
    # Chunks are where the index says: each is read from there.
    for reader in readers:
        streamed = sorted(chunk.id for chunk in reader.stream() if chunk.entity_path.startswith("/world"))
        found = sorted(
            chunk.id for chunk in reader.store().stream() if chunk.entity_path.startswith("/world")
        )
        assert found == streamed

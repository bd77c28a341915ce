"""Non-numeric entries of ``evaluate``: written where they change, bounded, recovered, and read back."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.drive.entries import ENTRIES
from tests.drive.episodes import Made, journal_of
from tests.drive.rows import append
from tests.episodes.read_rrd import read_rrd
from tests.episodes.verify_rrd import verify_rrd
from workbench.envs.evaluate_entries import split_entries
from workbench.envs.step_result import OtherEntry
from workbench.episodes.columns import CUT_MESSAGE, MAX_TEXT_BYTES, TextEntry, TextWriter, text_tracks
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.writing.episode_writer import EpisodeFiles
from workbench.episodes.writing.finish_or_recover import recover

Maker = Callable[..., Made]
Others = Mapping[str, OtherEntry]


def text_entry(text: str) -> OtherEntry:
    return OtherEntry("str", (text,))


def write(made: Made, folder: Path, others: list[Others], finish: bool = True) -> EpisodeFiles | None:
    """Write an episode whose states have these `others`."""
    writer = made.writer(folder)
    for row, entries in zip(made.rows(), others, strict=True):
        append(writer, dataclasses.replace(row, others=entries))
    if finish:
        return writer.finish()
    journal_of(writer).sync()
    writer.close()
    return None


def test_an_entry_that_changes_too_often_is_named_and_no_longer_stored() -> None:
    writer = TextWriter()
    lines = [
        line
        for state in range(5000)
        for line in writer.changes(state, {"clock": text_entry(f"{state:050}"), "a": text_entry("x")})
    ]
    assert sum(len(line[1]) for line in lines) < MAX_TEXT_BYTES + 400
    tracks = text_tracks(lines)
    last_state, last = tracks["clock"][-1]
    assert last is not None and last.text == CUT_MESSAGE and not last.whole and 100 < last_state < 5000
    assert tracks["a"] == ((0, TextEntry("str", "x", False, True)),)


def test_numbers_texts_and_both_are_read_back(
    child_process: None, make_episode: Maker, tmp_path: Path
) -> None:
    number = OtherEntry("float", numbers=np.array(0.5))
    nothing = OtherEntry("None", ("None",))
    part, word = OtherEntry("T", ("9",), whole=False), OtherEntry("list", ("b",), per_env=True)
    changing = [{"best": nothing}, {"best": number}, {"best": number, "map": part}, {"word": word}]
    states: list[Others] = [{"goal": OtherEntry("list", numbers=np.arange(2)), **one} for one in changing]
    files = write(make_episode(3), tmp_path, states)
    assert files is not None
    assert verify_rrd(files.rrd) is None
    episode = read_episode(files.json)
    np.testing.assert_array_equal(episode.batch["best"], [np.nan, 0.5, 0.5, np.nan])
    np.testing.assert_array_equal(episode.batch["goal"], [[0, 1]] * 4)
    assert episode.batch["goal"].dtype.kind == "i"
    found = [episode.other_entries_at(state) for state in range(4)]
    assert found[0]["best"] == nothing and found[1]["best"].numbers == 0.5
    assert [one.get("map") for one in found] == [None, None, part, None]
    assert [one.get("word") for one in found] == [None, None, None, word]
    entities = read_rrd(files.rrd)
    assert {"/batch/best", "/batch/goal"} <= set(entities)
    log = [value[0] for value in entities["/logs/evaluate"]["TextLog:text"].values]
    gone = [f"{name} is no longer returned" for name in ("best", "map")]
    assert log == ["best: None", gone[0], "map: 9", gone[1], "word: b"]


def test_a_killed_writers_texts_are_recovered(make_episode: Maker, tmp_path: Path) -> None:
    states: list[Others] = [*({"phase": text_entry(f"{state // 2}")} for state in range(4)), {}]
    write(make_episode(4), tmp_path, states, finish=False)
    (files,) = recover(tmp_path)
    episode = read_episode(files.json)
    assert [episode.other_entries_at(state) for state in range(5)] == states


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(states=st.lists(ENTRIES, min_size=3, max_size=3), num_envs=st.integers(1, 3))
def test_any_result_of_evaluate_is_recorded(
    make_episode: Maker, states: list[dict[Any, Any]], num_envs: int
) -> None:
    env = num_envs - 1
    halves = [split_entries(entries, num_envs) for entries in states]
    made = make_episode(2)
    with tempfile.TemporaryDirectory() as folder:
        writer = made.writer(Path(folder))
        for row, (columns, others) in zip(made.rows(), halves, strict=True):
            append(
                writer,
                dataclasses.replace(
                    row,
                    evaluate={name: values[env] for name, values in columns.items()},
                    others={name: entry.of_env(env) for name, entry in others.items()},
                ),
            )
        files = writer.finish()
        episode = read_episode(files.json)
    for state, (columns, others) in enumerate(halves):
        there = episode.other_entries_at(state)
        assert columns.keys() <= episode.evaluate.keys() and others.keys() <= there.keys()
        for name, entry in others.items():
            if entry.numbers is None:
                assert there[name].texts == entry.of_env(env).texts and there[name].what == entry.what
            else:
                kept = np.asarray(episode.batch[name][state]).reshape(-1)[: entry.numbers.size]
                np.testing.assert_array_equal(kept, entry.numbers.reshape(-1).astype(kept.dtype))

"""The results file of a sweep: read as written, and harmless where another program wrote it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from workbench.episodes.sweep_results import (
    NoSweep,
    SweepEpisode,
    SweepResults,
    clean_results,
    read_results,
    value_text,
    wilson,
    write_results,
)

RESULTS = SweepResults(
    "push.py",
    "random",
    2,
    ({"REACH": "0.5", "robot": '"panda"'}, {"REACH": "1", "robot": '"fetch"'}),
    (
        SweepEpisode(0, 0, True, False, 7, 10, 2.5, {"reward_terms/reach": 0.25}, "0_REACH=0.5/a.rrd"),
        SweepEpisode(0, 1, False, False, None, 10, 1.5, {"reward_terms/reach": 0.75}, "0_REACH=0.5/b.rrd"),
        SweepEpisode(1, 0, failure="push.py:3: ValueError: no"),
    ),
)


def test_results_are_read_back_as_written(tmp_path: Path) -> None:
    write_results(tmp_path / "results.parquet", RESULTS)
    assert clean_results(read_results(tmp_path / "results.parquet")) == RESULTS
    assert [file.name for file in tmp_path.iterdir()] == ["results.parquet"]


def test_each_point_is_summarised_by_its_own_episodes_only() -> None:
    nan = math.nan
    values: list[tuple[int, bool | None, bool | None, float | None, dict[str, float]]] = [
        (0, True, False, 1.0, {"a": 1.0}),
        (0, True, False, 3.0, {"a": 3.0, "b": 8.0}),
        (0, False, False, None, {}),
        (1, True, True, 9.0, {}),
        (1, False, False, 1.0, {}),
        (2, None, None, 7.0, {}),
        (3, None, None, nan, {}),
        (5, True, True, 12.0, {}),
        (5, False, False, 0.0, {}),
    ]
    rows = [
        SweepEpisode(point, seed, once, last, None, 10, total, means)
        for seed, (point, once, last, total, means) in enumerate(values)
    ]
    rows += [SweepEpisode(1, 90, failure="first"), SweepEpisode(1, 91, failure="second")]
    points = tuple({"x": str(k)} for k in range(6))
    summaries = SweepResults("t", "a", 4, points, tuple(rows)).summaries()
    assert [one.index for one in summaries] == [0, 5, 1, 2, 3, 4], "no return and NaN come last"
    assert [one.values["x"] for one in summaries] == ["0", "5", "1", "2", "3", "4"]
    best, even, second, unjudged, lost, nothing = summaries
    assert (best.episodes, best.solved, best.solved_at_end, best.rate) == (3, 2, 0, 2 / 3)
    assert (best.mean_return, best.means, best.failed) == (2.0, {"a": 2.0, "b": 8.0}, 0)
    assert best.interval == wilson(2, 3) and unjudged.interval is None
    assert (second.episodes, second.solved_at_end, second.failed, second.failure) == (2, 1, 2, "first")
    assert (even.mean_return, second.mean_return, second.rate) == (6.0, 5.0, 0.5)
    assert (unjudged.solved, unjudged.solved_at_end, unjudged.rate) == (None, None, None)
    assert lost.mean_return is not None and math.isnan(lost.mean_return)
    assert (nothing.episodes, nothing.mean_return, nothing.rate) == (0, None, None)


@pytest.mark.parametrize(
    ("texts", "column"),
    [
        (["1", "2"], [1, 2]),
        (["1", "2.5"], [1.0, 2.5]),
        (["true", "false"], [True, False]),
        (["true", "1"], ["true", "1"]),
        (['"a"', '"b"'], ["a", "b"]),
        (['"a"', "1"], ['"a"', "1"]),
        (["[1]", "null"], ["[1]", "null"]),
    ],
)
def test_other_programs_read_each_value_of_a_point_as_it_is(
    tmp_path: Path, texts: list[str], column: list[object]
) -> None:
    rows = [SweepEpisode(k, seed, means={} if k else {"m": 0.5}) for k in (0, 1) for seed in (0, 1)]
    results = SweepResults("t", "a", 2, tuple({"x": text} for text in texts), tuple(rows))
    write_results(tmp_path / "r.parquet", results)
    table = pq.read_table(tmp_path / "r.parquet")
    assert table["set.x"].to_pylist() == [value for value in column for _ in (0, 1)]
    assert table["mean.m"].to_pylist() == [0.5, 0.5, None, None]
    assert clean_results(read_results(tmp_path / "r.parquet")) == results


def test_a_value_is_shown_as_written_and_a_text_without_quotes() -> None:
    assert [value_text(text) for text in ('"a b"', "1.5", "true", "[1]", "{")] == [
        "a b",
        "1.5",
        "true",
        "[1]",
        "{",
    ]


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    # Expected values from statsmodels' proportion_confint (Wilson).
    [(0, 10, 0.0, 0.2775), (5, 10, 0.2366, 0.7634), (10, 10, 0.7225, 1.0), (90, 100, 0.8256, 0.9448)],
)
def test_the_interval_is_wilsons(successes: int, count: int, low: float, high: float) -> None:
    assert wilson(successes, count) == pytest.approx((low, high), abs=1e-4)


def rewritten(path: Path, about: object = None, **columns: Sequence[object]) -> Path:
    """Write the file again with other columns, or another description."""
    write_results(path, RESULTS)
    table = pq.read_table(path)
    for name, values in columns.items():
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    if about is not None:
        table = table.replace_schema_metadata({b"workbench.sweep": json.dumps(about).encode()})
    pq.write_table(table, path)
    return path


@pytest.mark.parametrize(
    "recording",
    ["../../secret.rrd", "/etc/passwd", "a/../../b.rrd", "a\nb.rrd", "x" * 9999],
)
def test_a_path_that_leaves_the_folder_is_dropped(recording: str, tmp_path: Path) -> None:
    file = rewritten(tmp_path / "r.parquet", recording=[recording, "a/b.rrd", None])
    assert [row.recording for row in clean_results(read_results(file)).episodes] == ["", "a/b.rrd", ""]


def test_rows_of_unknown_points_and_invalid_numbers_are_left_out(tmp_path: Path) -> None:
    file = rewritten(tmp_path / "r.parquet", point=[99, 0, -1], **{"return": [1.0, math.inf, math.nan]})
    cleaned = clean_results(read_results(file))
    assert [(row.seed, row.total_reward) for row in cleaned.episodes] == [(1, None)]
    wild = {"a": math.nan, "b": 1.0, "c": math.inf, "d\n": 2.0}
    many = replace(RESULTS.episodes[0], means=wild, failure="x" * 9999)
    (row,) = clean_results(replace(RESULTS, episodes=(many, replace(many, seed=2**63)))).episodes
    assert row.means == {"b": 1.0, "d": 2.0} and len(row.failure) < 9999


@pytest.mark.parametrize(
    "about",
    [
        {},
        {"format": 2},
        {"format": 1, "task": "t", "actions": "a", "seeds": 1, "points": [{"a": "1"}, {"b": "1"}]},
        {"format": 1, "task": "t", "actions": "a", "seeds": 1, "points": [{}] * 1001},
        {"format": 1, "task": "t", "actions": "a", "seeds": "x", "points": [{"a": "1"}]},
    ],
)
def test_a_file_that_is_no_sweep_is_refused(about: object, tmp_path: Path) -> None:
    with pytest.raises(NoSweep):
        clean_results(read_results(rewritten(tmp_path / "r.parquet", about)))


def test_a_file_of_more_rows_than_a_sweep_can_have_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_results(tmp_path / "r.parquet", RESULTS)
    monkeypatch.setattr("workbench.episodes.sweep_results.MAX_ROWS", 3)
    assert len(read_results(tmp_path / "r.parquet").episodes) == 3
    monkeypatch.setattr("workbench.episodes.sweep_results.MAX_ROWS", 2)
    with pytest.raises(NoSweep):
        read_results(tmp_path / "r.parquet")


@pytest.mark.parametrize("content", [b"", b"PAR1", b"PAR1" + bytes(1000) + b"PAR1"])
def test_a_broken_file_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "r.parquet").write_bytes(content)
    with pytest.raises(NoSweep):
        read_results(tmp_path / "r.parquet")

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


def test_points_are_summarised_best_first() -> None:
    best, failed = replace(RESULTS, points=RESULTS.points[::1]).summaries()
    assert (best.index, best.episodes, best.solved, best.solved_at_end, best.mean_return) == (0, 2, 1, 0, 2.0)
    assert best.means == {"reward_terms/reach": 0.5} and best.rate == 0.5
    assert (failed.episodes, failed.failed, failed.failure) == (0, 1, "push.py:3: ValueError: no")


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


@pytest.mark.parametrize("content", [b"", b"PAR1", b"PAR1" + bytes(1000) + b"PAR1"])
def test_a_broken_file_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "r.parquet").write_bytes(content)
    with pytest.raises(NoSweep):
        read_results(tmp_path / "r.parquet")

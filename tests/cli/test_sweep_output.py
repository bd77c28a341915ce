"""The table, the JSON and the CSV of a sweep whose points all differ."""

from __future__ import annotations

import csv
import io
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from workbench.cli.arguments import JobArguments
from workbench.cli.sweep import (
    SweepOutput,
    as_csv,
    as_json,
    parse_settings,
    print_points,
    sweep_in_terminal,
    write_reports,
)
from workbench.episodes.sweep_results import SweepEpisode, SweepResults
from workbench.library.job_status import read_jobs
from workbench.record.job import RecordProgress
from workbench.sweep.job import Setting, SweepOptions, SweepReport
from workbench.task.description import TaskOptions

TERMS = {"reward_terms/reach": 0.25, "reward_terms/grip": 2.0, "height": 7.0}


def episode(
    point: int, seed: int, total: float, success: bool, at_end: bool, terms: float = 1.0
) -> SweepEpisode:
    means = {name: value * terms for name, value in TERMS.items()}
    solved_at = 3 if success else None
    recording = f"p{point}/{seed}.rrd"
    return SweepEpisode(point, seed, success, at_end, solved_at, 10 + seed, total, means, recording)


RESULTS = SweepResults(
    "Push-v1",
    "random",
    2,
    (
        {"MOST": "5", "robot": '"panda"'},
        {"MOST": "1", "robot": '"fetch"'},
        {"MOST": "2", "robot": '"nobody"'},
    ),
    (
        episode(0, 0, 1.0, False, False),
        episode(0, 1, 2.0, True, False, terms=3.0),
        episode(1, 0, 10.5, True, True),
        episode(1, 1, 11.5, True, False),
        SweepEpisode(2, 0, failure="no such robot"),
        SweepEpisode(2, 1, failure="no such robot"),
    ),
)


def printed(results: SweepResults, capsys: pytest.CaptureFixture[str]) -> list[list[str]]:
    print_points(results)
    return [line.split() for line in capsys.readouterr().out.splitlines()]


def test_the_best_point_comes_first_with_its_own_numbers(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    head, best, second, failed, *rest = printed(RESULTS, capsys)
    assert head == "MOST robot success (95 %) at the end return reach grip".split()
    assert best == "1 fetch 100 % (34 - 100) 50 % 11.000 0.25 2".split()
    assert second == "5 panda 50 % (9 - 91) 0 % 1.500 0.5 4".split()
    assert failed == "2 nobody 2 failed - - - -".split()
    assert not any("results.parquet" in line for line in rest)
    # A point with some failures keeps its numbers.
    some = replace(RESULTS, episodes=(*RESULTS.episodes[:3], SweepEpisode(1, 1, failure="it broke")))
    (row,) = [line for line in printed(some, capsys) if line[:1] == ["1"]]
    assert row == "1 fetch 100 % (21 - 100), 1 failed 100 % 10.500 0.25 2".split()


def test_columns_that_do_not_fit_are_named_below(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "64")
    head, *_, last = printed(RESULTS, capsys)
    assert head == "MOST robot success (95 %) at the end return reach".split()
    assert last[-1] == "grip" and "results.parquet:" in last
    monkeypatch.setenv("COLUMNS", "20")
    *_, last = printed(RESULTS, capsys)
    assert last[-3:] == ["results.parquet:", "reach,", "grip"], "the points and their success stay"


def test_without_reward_terms_all_means_are_columns_and_many_points_are_counted(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    points = tuple({"MOST": str(k)} for k in range(52))
    episodes = tuple(replace(episode(k, 0, float(k), True, True), means={"height": 7.0}) for k in range(52))
    lines = printed(SweepResults("Push-v1", "random", 1, points, episodes), capsys)
    assert lines[0][-1] == "height" and lines[1][0] == "51" and lines[1][-1] == "7"
    assert [line[0] for line in lines[1:51]] == [str(k) for k in range(51, 1, -1)]
    assert lines[51][:4] == ["...", "and", "2", "more"]


def test_the_files_have_each_point_with_its_own_episodes(tmp_path: Path) -> None:
    report = json.loads(as_json(RESULTS))
    assert (report["task"], report["actions"], report["seeds"]) == ("Push-v1", "random", 2)
    best, second, failed = report["points"]
    assert [one["point"] for one in report["points"]] == [1, 0, 2]
    assert best["set"] == {"MOST": 1, "robot": "fetch"} and best["success_rate"] == 1.0
    assert (best["success_rate_at_end"], best["mean_return"], best["failed"]) == (0.5, 11.0, 0)
    assert second["means"] == {"reward_terms/reach": 0.5, "reward_terms/grip": 4.0, "height": 14.0}
    assert second["success_interval_95"] == pytest.approx([0.0945, 0.9055], abs=1e-3)
    assert (failed["failed"], failed["failure"], failed["success_rate"]) == (2, "no such robot", None)
    assert failed["success_rate_at_end"] is None
    rows = best["episodes"]
    assert [(one["seed"], one["steps"], one["return"]) for one in rows] == [(0, 10, 10.5), (1, 11, 11.5)]
    assert rows[0]["recording"] == "p1/0.rrd" and rows[0]["solved_at"] == 3
    assert [one["success_at_end"] for one in rows] == [True, False]
    table = list(csv.DictReader(io.StringIO(as_csv(RESULTS))))
    assert [row["set.MOST"] for row in table] == ["5", "5", "1", "1", "2", "2"]
    assert [row["set.robot"] for row in table] == ["panda"] * 2 + ["fetch"] * 2 + ["nobody"] * 2
    assert [row["return"] for row in table] == ["1.0", "2.0", "10.5", "11.5", "", ""]
    assert [row["mean.reward_terms/grip"] for row in table] == ["2.0", "6.0", "2.0", "2.0", "", ""]
    assert [row["failure"] for row in table] == [""] * 4 + ["no such robot"] * 2
    assert [(row["point"], row["recording"]) for row in table[:3]] == [
        ("0", "p0/0.rrd"), ("0", "p0/1.rrd"), ("1", "p1/0.rrd"),
    ]  # fmt: skip
    write_reports(RESULTS, SweepOutput(tmp_path / "a.json", tmp_path / "a.csv"))
    assert (tmp_path / "a.json").read_text() == as_json(RESULTS)
    assert (tmp_path / "a.csv").read_text() == as_csv(RESULTS)
    write_reports(RESULTS, SweepOutput())
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize(
    "given",
    [[], ["a"], ["a-b=1"], ["a.=1"], ["a=1", "a=2"], ["a=1,1.0"], ["a=x,x"], ["a="], ["a=1,,2"], ["a=x,"]],
)
def test_unclear_settings_are_refused(given: list[str]) -> None:
    with pytest.raises(ValueError, match="--set"):
        parse_settings(given)
    assert len(parse_settings(["a=1", "b=1,'1'"])) == 2


def test_a_part_keeps_no_table_and_an_old_table_is_not_mixed_with_a_new_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    totals = set[str]()

    def swept(what: SweepOptions, describe: Any, on_progress: Any, *_: object) -> SweepReport:
        on_progress(RecordProgress(0, 1, over=(what.items[-1], None)))
        return SweepReport(RESULTS, stopped=False)

    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    monkeypatch.setattr("workbench.cli.sweep.sweep", swept)
    task = Path(__file__).parents[2] / "tasks" / "reward_terms.py"
    options = TaskOptions(num_envs=2, seed=30)
    what = SweepOptions(str(task), (Setting("MOST", (5, 1, 2)),), tmp_path / "out", 5, options=options)
    for shard, code in (("1/2", 0), ("2/2", 0), (None, 0), (None, 2)):
        run = JobArguments(workers=1, shard=shard)
        assert sweep_in_terminal(what, SweepOutput(json_file=tmp_path / "a.json"), run) == code
        assert (tmp_path / "out" / "results.parquet").exists() == (shard is None)
        totals |= {f"{one.total} {one.part} {one.state}" for one in read_jobs(what.out, time.time())}
        assert (tmp_path / "a.json").exists()
    printed = capsys.readouterr()
    assert totals == {"7 1/2 done", "8 2/2 done", "15  done"} and printed.out.count("workbench review") == 1
    assert f"seed 34 of {what.points[2].folder}: not kept, 0 of 7 kept" in printed.err
    # Its own job file continues it.
    run = JobArguments(workers=1, job=tmp_path / "sweep-1-of-2.job")
    assert sweep_in_terminal(what, SweepOutput(), run) == 0
    run = JobArguments(workers=1, job=tmp_path / "gone.job")
    assert sweep_in_terminal(what, SweepOutput(), run) == 2

"""``workbench sweep``: its table, its files, merged parts, and a resumed job."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest

from tests.drive.commands import exit_code
from workbench.episodes.sweep_results import RESULTS, SweepResults, read_results

pytestmark = pytest.mark.usefixtures("child_process")

REWARD_TERMS = Path(__file__).parents[2] / "tasks" / "reward_terms.py"
SHORT = "--seeds 3 --max-steps 2 --num-envs 2 --env render_backend=none --workers 1".split()


def sweep(*given: str) -> int:
    return exit_code("sweep", REWARD_TERMS, *SHORT, *given)


def numbers(folder: Path) -> SweepResults:
    results = read_results(folder / RESULTS)
    return replace(results, episodes=tuple(replace(row, recording="") for row in results.episodes))


def test_a_sweep_prints_its_points_and_writes_its_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    settings = ("--set", "MOST=5,1", "--set", "robot_uids=panda,nobody")
    code = sweep(*settings, "--json-file", "a.json", "--csv-file", "a.csv")
    printed = capsys.readouterr()
    assert code == 1
    assert "3 failed" in printed.out and "0 % (0 - 56)" in printed.out
    assert "workbench review sweeps/reward_terms" in printed.out and "nobody" in printed.err
    results = read_results(tmp_path / "sweeps" / "reward_terms" / RESULTS)
    assert len(results.episodes) == 12
    report = json.loads((tmp_path / "a.json").read_text())
    assert [point["set"]["MOST"] for point in report["points"]] == [1, 5, 5, 1]
    rows = list(csv.DictReader((tmp_path / "a.csv").read_text().splitlines()))
    assert [row["set.robot_uids"] for row in rows] == (["panda"] * 3 + ["nobody"] * 3) * 2
    assert rows[0]["return"] == str(results.episodes[0].total_reward)
    # Another sweep must not be mixed with it.
    kept = tmp_path / "sweeps" / "reward_terms" / RESULTS
    before = kept.read_bytes()
    assert sweep("--set", "MOST=3") == 2
    assert "sweeps/reward_terms" in capsys.readouterr().err and kept.read_bytes() == before


def test_a_job_is_resumed_after_its_finished_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    given = ("--set", "MOST=5,1", "--out", "out", "--job", "s.job")
    assert sweep(*given) == 0
    before = numbers(tmp_path / "out")
    made = {file: file.stat().st_mtime_ns for file in (tmp_path / "out").glob("*/*")}
    capsys.readouterr()
    assert sweep(*given) == 0
    assert "resuming after 6 results" in capsys.readouterr().err
    assert numbers(tmp_path / "out") == before
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "out").glob("*/*")} == made
    # Another sweep must not use its job file.
    assert sweep("--set", "MOST=5,2", "--out", "other", "--job", "s.job") == 2
    assert "belongs to another job" in capsys.readouterr().err


def test_an_upload_is_a_complete_sweep_and_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    there = tmp_path / "there"
    given = ("--set", "MOST=5,1", "--out", "here", "--upload", there.as_uri(), "--job", "s.job")
    assert sweep(*given) == 0
    results = read_results(there / RESULTS)
    assert results == read_results(tmp_path / "here" / RESULTS) and len(results.episodes) == 6
    assert all((there / row.recording).is_file() for row in results.episodes)
    assert not list((tmp_path / "here").glob("*/*"))
    printed = capsys.readouterr().out
    assert f"workbench review here, after copying the contents of {there.as_uri()} into it" in printed
    made = {file: file.stat().st_mtime_ns for file in there.glob("*/*")}
    assert sweep(*given) == 0
    assert {file: file.stat().st_mtime_ns for file in there.glob("*/*")} == made
    # A sweep copied back from the upload opens like one made locally.
    assert exit_code("merge", "s.job") == 0
    assert read_results(there / RESULTS) == results

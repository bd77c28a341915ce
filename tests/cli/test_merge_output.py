"""``workbench merge`` on job files made by hand: each command's parts give its output, files and exit code."""

from __future__ import annotations

import csv
import json
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from workbench.checks.job_items import CheckedTask, CheckOptions, ItemOutcome
from workbench.checks.results import RuleResult
from workbench.cli.merge import MergeOutput, merge_in_terminal
from workbench.cli.rescore import RescoreRequest
from workbench.envs.gpu_rules import Finding
from workbench.episodes.row import Source
from workbench.episodes.sweep_results import RESULTS, read_results
from workbench.jobs.results_file import JobFile, JobKey, job_of
from workbench.planning.options import PlanOptions
from workbench.planning.planned_episodes import PlannedEpisode
from workbench.record.job_worker import Written
from workbench.rescore.job import RescoredRecording
from workbench.rescore.verdict import Verdict
from workbench.solve.job import SolveOptions
from workbench.sweep.job import Setting, SweepOptions
from workbench.task.description import TaskOptions


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


def parts(job: JobKey, *results: dict[int, Any]) -> list[Path]:
    paths = [Path(f"{number}.job") for number in range(1, len(results) + 1)]
    for path, some in zip(paths, results, strict=True):
        with closing(JobFile(path, job)) as file:
            for number, result in some.items():
                file.keep(number, result)
    return paths


def merged(files: list[Path], output: MergeOutput | None = None, **where: Path) -> int:
    return merge_in_terminal(files, where.get("job"), where.get("out"), output or MergeOutput())


def test_a_rescoring_in_parts_is_one_table_in_the_order_of_the_files(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def rescored(place: int, **verdict: Any) -> RescoredRecording:
        source = Source(Path(f"/r/{place}.json"), None, str(place), f"episode{place}")
        return RescoredRecording(
            place, Verdict(source, length=5 + place, **verdict), note=f"note {place % 2}"
        )

    request = RescoreRequest(3, "recorded", "code", False, False, 2, TaskOptions())
    job = job_of("rescore", "as recorded", request, ())
    files = parts(
        job,
        {0: rescored(2, metres=0.5, missed={"plug": "it has no state"}), 2: rescored(0, returns=(1.0, 2.0))},
        {4: rescored(1, damaged=True, why_not="cut")},
    )
    assert merged(files, MergeOutput(Path("a.json"), Path("a.csv"))) == 1, "a damaged recording"
    printed = capsys.readouterr()
    names = [line.split()[0] for line in printed.out.splitlines() if line.startswith("episode")]
    assert names == ["episode", "episode0", "episode1", "episode2"]
    assert printed.err.count("note 0") == printed.err.count("note 1") == 1
    assert "it has no state" in printed.err and "episode2" in printed.err
    assert [row["episode"] for row in json.loads(Path("a.json").read_text())] == names[1:]
    assert [row["episode"] for row in csv.DictReader(Path("a.csv").read_text().splitlines())] == names[1:]
    assert merged(files[:1]) == 1 and "1 of the job's recordings" in capsys.readouterr().out
    whole = parts(
        job_of("rescore", "as recorded", RescoreRequest(1, "", "", False, False, 2, TaskOptions()), ()), *[]
    )
    assert whole == [] and merged(whole) == 2


def planned(seed: int, solved: bool) -> PlannedEpisode:
    numbers = np.full(4, 0.5, np.float32)
    success = np.array([False, False, solved, solved])
    never = np.zeros(4, bool)
    return PlannedEpisode(seed, 3, numbers, success, never, numbers, numbers, numbers, plan_seconds=2.5)


def written(number: int, folder: Path, solved: bool = True) -> Written:
    path = folder / f"e{number}.rrd"
    path.parent.mkdir(exist_ok=True)
    for suffix in (".rrd", ".h5", ".json"):
        path.with_suffix(suffix).write_text(f"{path.stem}{suffix}")
    planned_episode, solved_at = planned(10 + number, solved), 3 if solved else None
    return Written(
        number, path, 10 + number, 4, 2.0 + number, solved, planned=planned_episode, solved_at=solved_at
    )


def test_solved_seeds_in_parts_are_one_report_and_their_episodes_are_copied(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    what = SolveOptions(
        "Push-v1", place / "one", 3, plan=PlanOptions(), options=TaskOptions(num_envs=1, seed=10)
    )
    job = job_of("solve", what.task, what, ("out", "workers", "upload"))
    other = JobKey(job.command, job.about, job.request, str(place / "two"))
    parts(job, {0: written(0, place / "one"), 1: written(1, place / "one", solved=False)})
    with closing(JobFile(Path("2.job"), other)) as file:
        file.keep(2, written(2, place / "two"))
    files = [Path("1.job"), Path("2.job")]
    assert merged(files) == 2 and "2 folders" in capsys.readouterr().err
    out = place / "all"
    files_of = MergeOutput(Path("a.json"), Path("a.csv"), Path("a.xml"), fail_on="warn")
    assert merged(files, files_of, out=out, job=Path("whole.job")) == 1, "an unsolved seed breaks a rule"
    report = json.loads(Path("a.json").read_text())
    assert (report["solved"], report["tried"], report["first_seed"], report["fail_on"]) == (2, 3, 10, "warn")
    assert [(one["seed"], one["solved_at"], one["return"]) for one in report["seeds"]] == [
        (10, 3, 2.0), (11, None, 3.0), (12, 3, 4.0),
    ]  # fmt: skip
    assert {Path(one["recording"]).parent for one in report["seeds"]} == {out}
    assert {path.name: path.read_text() for path in out.iterdir()} == {
        f"e{k}{suffix}": f"e{k}{suffix}" for k in range(3) for suffix in (".rrd", ".h5", ".json")
    }
    assert len(Path("a.csv").read_text().splitlines()) == 4 and Path("a.xml").exists()
    assert str(out) in capsys.readouterr().out
    # Copied files are not copied again, and the parts may be gone by then.
    for path in (place / "one").iterdir():
        path.unlink()
    (out / "e0.h5").write_text("mine")
    assert merged(files, out=out) == 0 and (out / "e0.h5").read_text() == "mine"
    (out / "e1.json").unlink()
    assert merged(files, out=out) == 2 and "e1.json does not exist" in capsys.readouterr().err
    assert merged([Path("whole.job")]) == 0
    assert merged([Path("2.job")]) == 1
    assert "2 of the job's episodes" in (said := capsys.readouterr().out) and "number 0, number 1" in said


def test_a_check_in_parts_is_one_report(capsys: pytest.CaptureFixture[str]) -> None:
    what = CheckOptions("Push-v1", TaskOptions(num_envs=2), 2, select=("entry-name", "success-at-reset"))
    job = job_of("check", what.task, what, ("workers",))
    found = Finding("success-at-reset", "stop", "too early", None, None, "", "evaluate", 2, 0)
    task = CheckedTask("Push-v1", "PushEnv", None)
    outcomes = {
        "success-at-reset": ItemOutcome((RuleResult("success-at-reset", "broken", (found,)),), task=task),
        "entry-name": ItemOutcome((RuleResult("entry-name", "kept"),), task=task),
    }
    files = parts(job, {0: outcomes["success-at-reset"]}, {1: outcomes["entry-name"]})
    output = MergeOutput(Path("a.json"), None, Path("a.xml"), Path("a.sarif"))
    assert merged(files, output) == 1
    report = json.loads(Path("a.json").read_text())
    assert {one["rule"]: one["state"] for one in report["rules"]} == {
        "entry-name": "kept", "success-at-reset": "broken",
    }  # fmt: skip
    assert report["fails"] and Path("a.xml").exists() and Path("a.sarif").exists()
    assert "success-at-reset (stop" in capsys.readouterr().out
    assert merged(files, MergeOutput(fail_on="never")) == 0
    assert merged(files[1:], MergeOutput(fail_on="never")) == 1, "a part is missing"
    assert merged(files, MergeOutput(csv_file=Path("a.csv"))) == 2 and not Path("a.csv").exists()
    assert "--csv-file" in capsys.readouterr().err


def test_a_sweep_in_parts_has_a_folder_of_each_point(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    what = SweepOptions(
        "Push-v1", (Setting("MOST", (5, 1)),), place / "one", 2, options=TaskOptions(num_envs=2, seed=10)
    )
    first, second = what.points
    job = job_of("sweep", what.task, what, ("out", "workers", "upload"))
    (place / "one").mkdir()
    at = [*what.items]
    files = parts(
        job,
        {at[k]: written(k, place / "one" / first.folder, k == 1) for k in (0, 1)},
        {at[k]: written(k - 2, place / "one" / second.folder) for k in (2, 3)},
    )
    assert merged(files, MergeOutput(Path("a.json"), Path("a.csv")), out=place / "all") == 0
    results = read_results(place / "all" / RESULTS)
    assert [(one.point, one.seed, one.success_at_end) for one in results.episodes] == [
        (0, 10, False), (0, 11, True), (1, 10, True), (1, 11, True),
    ]  # fmt: skip
    assert all((place / "all" / one.recording).is_file() for one in results.episodes)
    assert {path.name for path in (place / "all").iterdir()} == {first.folder, second.folder, RESULTS}
    assert [point["set"] for point in json.loads(Path("a.json").read_text())["points"]] == [
        {"MOST": 1}, {"MOST": 5},
    ]  # fmt: skip
    assert len(Path("a.csv").read_text().splitlines()) == 5 and str(place / "all") in capsys.readouterr().out
    assert merged(files[:1], out=place / "half") == 1
    assert f"number {at[2]}, number {at[3]}" in capsys.readouterr().out


def test_a_command_that_merge_does_not_know_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    files = parts(JobKey("square", {"command": "square"}, b""), {0: 0})
    assert merged(files) == 2 and "square" in capsys.readouterr().err

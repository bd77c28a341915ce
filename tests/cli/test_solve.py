"""``workbench solve``: a row per seed, verdicts, reports for programs, and the episodes in the library."""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
import pty
import subprocess
import sys
import termios
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from tests.drive.commands import exit_code
from tests.drive.waiting import until
from workbench.checks.job import CheckReport
from workbench.checks.job_items import CheckedTask
from workbench.checks.results import RuleResult
from workbench.cli.output import Exit
from workbench.cli.solve import (
    SolveOutput,
    as_csv,
    as_json,
    as_junit,
    print_report,
    solve_in_terminal,
    write_reports,
)
from workbench.envs.gpu_rules import FailOn, Finding
from workbench.episodes.reader.read_episode import read_episode
from workbench.jobs.scheduler import Failure
from workbench.planning.options import PlanOptions
from workbench.planning.seeds_report import SolvedSeed, SolveReport
from workbench.planning.verdicts import RewardVerdict
from workbench.record.job import RecordProgress
from workbench.solve.job import SolveOptions, solve
from workbench.task.description import TaskOptions
from workbench.task.problem import Problem

pytestmark = pytest.mark.usefixtures("child_process")

LIFT = '''
"""The hand is to rise; with `pays` the same without it."""
from mani_skill.envs.tasks import PushCubeEnv
from mani_skill.utils.registration import register_env


@register_env("SolveLift-v1", max_episode_steps=8)
class LiftEnv(PushCubeEnv):
    def evaluate(self):
        height = self.agent.tcp.pose.p[:, 2]
        return {"success": (height > 0.22) & (self.start < 1), "height": height}

    def _initialize_episode(self, env_idx, options):
        super()._initialize_episode(env_idx, options)
        if not hasattr(self, "start"):
            self.start = self.elapsed_steps * 0
        self.start[env_idx] = (self.obj.pose.p[env_idx, 0] > self.half).to(self.start.dtype)

    half = 9.0

    def compute_dense_reward(self, obs, action, info):
        return info["height"]

    def compute_normalized_dense_reward(self, obs, action, info):
        return self.compute_dense_reward(obs, action, info)
'''


@pytest.fixture
def lift(tmp_path: Path) -> Path:
    file = tmp_path / "lift.py"
    file.write_text(LIFT)
    return file


def options_of(file: Path, seeds: int = 3) -> SolveOptions:
    return SolveOptions(
        str(file),
        file.parent / "out",
        seeds,
        plan=PlanOptions(rollouts=16, horizon=0.2),
        options=TaskOptions(num_envs=1, seed=4, env_kwargs={"render_backend": "none"}),
    )


@pytest.mark.slow
def test_each_seed_is_reported_and_its_episode_is_in_the_library(lift: Path) -> None:
    report = solve(options_of(lift))
    assert [one.seed for one in report.seeds] == [4, 5, 6]
    assert all(1 <= one.solved_at <= 8 and one.in_the_way == "" for one in report.seeds)
    assert report.verdicts == () and report.median_steps is not None
    for one in report.seeds:
        episode = read_episode(one.path)
        assert (episode.info.seed, episode.length) == (one.seed, one.steps)
        assert bool(episode.evaluate["success"][one.solved_at])
        assert episode.info.control_mode == "pd_ee_delta_pose"
        assert one.steps == min(8, one.solved_at + 5)


@pytest.mark.slow
def test_reward_without_success_is_reported_with_its_seeds(lift: Path) -> None:
    # If the cube starts beyond x, no height is a success, but the reward does not reflect that.
    lift.write_text(LIFT.replace("half = 9.0", "half = 0.013"))
    report = solve(options_of(lift, seeds=4))
    (verdict,) = [one for one in report.verdicts if one.rule == "reward-exploited"]
    unsolved = [one.seed for one in report.seeds if not one.solved_at]
    assert unsolved and set(verdict.seeds) <= set(unsolved)
    assert "height" in verdict.message


def test_a_seed_that_times_out_ends_at_its_next_step_and_reports_its_progress(lift: Path) -> None:
    seen: list[RecordProgress] = []
    what = replace(options_of(lift, seeds=2), seconds_per_seed=1e-6)
    report = solve(what, on_progress=seen.append)
    assert [one.steps for one in report.seeds] == [1, 1] and all(one.cut_off for one in report.seeds)
    assert "wall time limit reached after 1 step (" in report.seeds[0].in_the_way and report.verdicts == ()
    # The first plan is not made yet, so no seed is done.
    assert (seen[0].by_seed(4), seen[0].limit, seen[0].done) == ({4: 0}, 8, 0)
    assert (seen[1].by_seed(4), seen[1].done) == ({4: 1}, 1 / 8)
    assert (seen[-1].running, seen[-1].done, seen[-1].steps) == ({}, 2, 2)


FOUND = SolveReport(
    (
        SolvedSeed(2, 8, 13, 9.25, 3.2, "", Path("2.rrd")),
        SolvedSeed(3, 0, 50, 21.5, 9.0, "it pays", Path("3.rrd")),
    ),
    (RewardVerdict("reward-exploited", "1 of 2 episodes earned more", (3,)),),
    20.0,
    False,
    2,
)


@pytest.mark.parametrize(
    ("fail_on", "found", "unsolved"), [("stop", False, True), ("warn", True, True), ("never", False, False)]
)
def test_the_exit_code_follows_the_degrees_of_the_verdicts(
    fail_on: FailOn, found: bool, unsolved: bool
) -> None:
    output = SolveOutput(fail_on=fail_on)
    assert output.fails(FOUND) == found
    rule = RuleResult(
        "reward-exploited", "broken", (Finding("reward-exploited", "warn", "", None, None, "", "", 1, 0),)
    )
    checked = CheckReport(CheckedTask("x", "", None), (rule,), 1.0, 1.0)
    assert checked.fails(fail_on) == found
    assert output.fails(replace(FOUND, seeds=FOUND.seeds[1:], verdicts=())) == unsolved
    suite = ElementTree.fromstring(as_junit(FOUND, SolveOptions("x"), output))
    assert suite.get("failures") == str(int(found))


def test_each_seed_is_a_row_with_its_own_numbers_in_every_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    what = replace(options_of(tmp_path / "lift.py"), plan=PlanOptions(rollouts=32))
    print_report(FOUND)
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["2", "8", "13", "9.250", "3.2"]
    assert lines[2].split() == ["3", "-", "50", "21.500", "9.0", "it", "pays"]
    assert "reward-exploited (warn)" in lines and "  1 of 2 episodes earned more" in lines
    (seeds,) = [line for line in lines if "workbench help reward-exploited" in line]
    assert seeds.split(";")[0].split() == ["seeds", "3"] and lines[-1].endswith("workbench review .")
    many = replace(FOUND.verdicts[0], seeds=tuple(range(13)))
    print_report(replace(FOUND, seeds=(), verdicts=(many,), wanted=4))
    printed = capsys.readouterr().out
    assert "10, 11 ..." in printed and "workbench review" not in printed and "note" in printed
    report = json.loads(as_json(FOUND, what, SolveOutput(fail_on="warn")))
    assert {name: report[name] for name in ("task", "first_seed", "solved", "tried", "median_steps", "seconds")} == {
        "task": what.task, "first_seed": 4, "solved": 1, "tried": 2, "median_steps": 8, "seconds": 20.0,
    }  # fmt: skip
    assert report["plan"]["rollouts"] == 32 and report["env"] == {"render_backend": "none"}
    assert (report["fails"], report["fail_on"], report["stopped"]) == (True, "warn", False)
    assert report["verdicts"] == [
        {"rule": "reward-exploited", "message": "1 of 2 episodes earned more", "seeds": [3]}
    ]
    assert report["notes"] == list(FOUND.notes)
    first, second = report["seeds"]
    assert first == {
        "seed": 2, "solved_at": 8, "steps": 13, "return": 9.25, "seconds": 3.2, "in_the_way": "", "rules": [],
        "recording": "2.rrd",
    }  # fmt: skip
    assert (second["solved_at"], second["in_the_way"]) == (None, "it pays")
    assert second["rules"] == ["reward-exploited"]
    both = replace(FOUND, verdicts=(*FOUND.verdicts, RewardVerdict("reward-flat", "flat", (2, 3))))
    rows = list(csv.DictReader(io.StringIO(as_csv(both, what, SolveOutput()))))
    assert [row["rules"] for row in rows] == ["reward-flat", "reward-exploited reward-flat"]
    assert [row["seed"] for row in rows] == ["2", "3"] and rows[1]["solved_at"] == ""
    suite = ElementTree.fromstring(as_junit(both, what, SolveOutput(fail_on="warn")))[0]
    assert (suite.get("tests"), suite.get("failures"), suite.get("skipped")) == ("4", "2", "1")
    assert [case.get("name") for case in suite] == ["reward-exploited", "reward-flat", "seed 2", "seed 3"]
    assert [[child.tag for child in case] for case in suite] == [["failure"], ["failure"], [], ["skipped"]]
    assert suite[2].get("time") == "3.200" and suite.get("time") == "20.000"
    suite = ElementTree.fromstring(as_junit(both, what, SolveOutput()))[0]
    assert [child.tag for child in suite[0]] == ["system-out"] and suite.get("failures") == "0"
    none = replace(FOUND, seeds=FOUND.seeds[1:], verdicts=())
    suite = ElementTree.fromstring(as_junit(none, what, SolveOutput()))[0]
    assert (suite.get("tests"), suite.get("failures")) == ("2", "1") and suite[0].find("failure") is not None
    output = SolveOutput(json_file=tmp_path / "a.json", csv_file=tmp_path / "a.csv", junit=tmp_path / "a.xml")
    write_reports(FOUND, what, output)
    assert (tmp_path / "a.json").read_text() == as_json(FOUND, what, output)
    assert (tmp_path / "a.csv").read_text() == as_csv(FOUND, what, output)
    assert "<testsuites" in (tmp_path / "a.xml").read_text()


@pytest.mark.slow
def test_the_report_is_the_same_with_several_processes(lift: Path) -> None:
    def same(report: SolveReport) -> list[tuple[int, int, int, float]]:
        return [(one.seed, one.solved_at, one.steps, one.total_reward) for one in report.seeds]

    what = options_of(lift)
    assert same(solve(what)) == same(solve(replace(what, workers=2, out=lift.parent / "two")))


@pytest.mark.slow
def test_a_stopped_job_keeps_and_reports_its_finished_seeds(lift: Path) -> None:
    done = threading.Event()

    def on_progress(progress: RecordProgress) -> None:
        if progress.over is not None:
            done.set()

    report = solve(options_of(lift), on_progress=on_progress, stop=done.is_set)
    assert report.stopped and len(report.seeds) == 1 and report.seeds[0].path.is_file()


@pytest.mark.slow
def test_ctrl_c_in_a_terminal_keeps_and_reports_the_finished_seeds(lift: Path) -> None:
    ours, theirs = pty.openpty()
    kept, folder = lift.parent / "out", lift.parent
    given = ["--seeds", "500", "--workers", "2", "--rollouts", "16", "--horizon", "0.2"]
    given += ["--env", "render_backend=none", "--out", str(kept), "--json-file", str(folder / "solved.json")]
    process = subprocess.Popen(
        [sys.executable, "-m", "workbench.cli.main", "solve", str(lift), *given],
        env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "200"},
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
        # Only processes with this controlling terminal get the signals of its keys.
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )
    os.close(theirs)
    pieces: list[bytes] = []

    def read() -> None:
        try:
            while piece := os.read(ours, 65536):
                pieces.append(piece)
        except OSError:  # the other end was closed
            return

    reader = threading.Thread(target=read, daemon=True)
    reader.start()

    def printed() -> str:
        return b"".join(pieces).decode(errors="replace")

    try:
        until(lambda: len(list(kept.glob("*.json"))) >= 2, "two episodes", seen=printed)
        os.write(ours, b"\x03")
        assert process.wait(timeout=60) == 130
    finally:
        process.kill()
        process.wait()
        reader.join(timeout=10)
        os.close(ours)
    report = json.loads((folder / "solved.json").read_text())
    count = len(list(kept.glob("*.json")))
    assert report["stopped"] and 2 <= report["tried"] == count < 500
    assert f"{count} of 500 seeds are done, {report['solved']} solved" in printed()
    assert "interrupted" in printed() and "Traceback" not in printed()


@pytest.mark.parametrize("failing", [True, False])
def test_seeds_without_a_result_make_the_exit_code_1_whatever_the_degree(
    failing: bool, lift: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def solved(*args: Any, on_failures: Any, **named: Any) -> SolveReport:
        on_failures([Failure((1,), Problem("worker", "it was killed", None, None, None, ""))] * failing)
        return FOUND

    monkeypatch.setattr("workbench.cli.solve.solve", solved)
    code = solve_in_terminal(options_of(lift), SolveOutput(fail_on="never"))
    assert code == (Exit.FAILED if failing else Exit.DONE)


def test_the_command_prints_and_writes_reports(lift: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = {name: lift.parent / f"solved.{name}" for name in ("json", "csv", "xml")}
    call = f"solve {lift} --seeds 2 --workers 1 --rollouts 16 --horizon 0.2 --env render_backend=none --out {lift.parent}/out"
    # A seed ends after its first step.
    ends = "--seconds-per-seed 1e-6 --fail-on never"
    written = f"--json-file {files['json']} --csv-file {files['csv']} --junit {files['xml']}"
    assert exit_code(*f"{call} {ends} {written}".split()) == 0
    stdout = capsys.readouterr().out
    assert "Solved 0 of 2 seeds" in stdout and "workbench review" in stdout
    report = json.loads(files["json"].read_text())
    assert (report["solved"], report["tried"], report["plan"]["rollouts"]) == (0, 2, 16)
    rows = list(csv.DictReader(io.StringIO(files["csv"].read_text())))
    assert [(row["seed"], row["steps"]) for row in rows] == [("0", "1"), ("1", "1")]
    assert all(Path(row["recording"]).is_file() for row in rows)
    assert ElementTree.fromstring(files["xml"].read_text()).get("tests") == "2"

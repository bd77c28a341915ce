"""What ``workbench record`` prints while it runs and at its end, and its exit codes."""

from __future__ import annotations

import io
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TextColumn

from workbench.cli.arguments import JobArguments
from workbench.cli.output import Exit
from workbench.cli.record import RecordBar, print_recorded
from workbench.cli.run_by import (
    exit_after,
    items_of,
    job_path,
    print_part,
    require_job,
    run_by,
    status_in_folder,
)
from workbench.jobs.results_file import JobKey, Kept
from workbench.jobs.scheduler import Failure, PoolError, ThisProcess
from workbench.library.job_status import JobStatus, read_jobs
from workbench.record.job import Recorded, RecordProgress
from workbench.record.job_worker import RecordOptions, Written
from workbench.task.problem import Problem, TaskError

PROBLEM = Problem("step", "it broke", "task.py", 3, "1 / 0", "Traceback")
FIRST = Written(0, Path("out dir/a.rrd"), 5, 40, 1.5, True)
SECOND = Written(1, Path("out dir/b.rrd"), 6, 7, None, None)
THIRD = Written(2, Path("out dir/c.rrd"), 7, 9, -2.0, False)
ASKED = RecordOptions("task.py", Path("out dir"), 3)


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")


def test_the_episodes_are_listed_with_what_they_earned(capsys: pytest.CaptureFixture[str]) -> None:
    recorded = Recorded((FIRST, SECOND, replace(THIRD, start_corrected=True)), 3, False, start_corrected=1)
    assert print_recorded(ASKED, recorded) == Exit.DONE
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ") for line in lines[:3]] == [
        ["out dir/a.rrd", "40 steps", "return 1.500", "success"],
        ["out dir/b.rrd", "7 steps", "no reward"],
        ["out dir/c.rrd", "9 steps", "return -2.000", "no success"],
    ]
    assert lines[3].startswith("1 episode ") and lines[4].endswith("workbench review 'out dir'")
    uploaded = Recorded((replace(FIRST, address="s3://there/a.rrd"),), 1, False)
    assert print_recorded(ASKED, uploaded) == Exit.DONE
    assert capsys.readouterr().out.splitlines() == ["s3://there/a.rrd  40 steps  return 1.500  success"]


@pytest.mark.parametrize(
    ("successes", "recorded", "code", "said"),
    [
        (2, Recorded((FIRST, SECOND), 7, False), Exit.DONE, "2 of 7 episodes"),
        (3, Recorded((FIRST, SECOND), 40, False), Exit.REFUSED, "after 40 episodes"),
        (1, Recorded((), 1, False), Exit.REFUSED, "after 1 episode"),
        (None, Recorded((FIRST,), 1, True), Exit.INTERRUPTED, "finished episodes were kept"),
        (None, Recorded((), 0, True), Exit.INTERRUPTED, "interrupted"),
        (
            None,
            Recorded((FIRST,), 3, False, failures=(Failure((1, 2), PROBLEM),)),
            Exit.FAILED,
            "episode 1, episode 2",
        ),
        (
            2,
            Recorded((FIRST,), 3, True, failures=(Failure((1,), PROBLEM),)),
            Exit.INTERRUPTED,
            "1 episode recorded, 1 without",
        ),
    ],
)
def test_the_exit_code_says_whether_all_that_was_asked_for_is_there(
    successes: int | None, recorded: Recorded, code: Exit, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = replace(ASKED, episodes=None if successes else 3, successes=successes)
    assert print_recorded(asked, recorded) == code
    printed = capsys.readouterr()
    assert said in printed.out + printed.err


class Shown:
    """A progress bar on a console whose text can be read."""

    def __init__(self, **how: object) -> None:
        self.text = io.StringIO()
        self.bar = Progress(
            TextColumn("{task.description}"), MofNCompleteColumn(), console=Console(file=self.text, width=200)
        )
        self.record_bar = RecordBar(self.bar, 4, **how)  # type: ignore[arg-type]

    def line(self) -> str:
        (task,) = self.bar.tasks
        return f"{task.description} {task.completed:g}/{task.total}"


def test_the_bar_shows_episodes_seeds_and_failures(capsys: pytest.CaptureFixture[str]) -> None:
    shown = Shown()
    assert shown.line() == "opening 0/4"
    failures = (Failure((1,), PROBLEM), Failure((3,), PROBLEM))
    shown.record_bar.show(RecordProgress(1, 20, (0, FIRST), {2: 5}, 50, 1.1, failures))
    assert shown.line().startswith("recording, ") and shown.line().endswith("2 failed 1.1/4")
    shown.record_bar.show(RecordProgress(1, 25, (2, None), {}, 50, 1.0))
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "episode 0: 40 steps, return 1.500, success, 1 of 4 kept",
        "episode 2: not kept, 1 of 4 kept",
    ]
    shown.record_bar.describe("recorded", 3)
    assert shown.line() == "recorded 3/4"


def test_the_bar_names_seeds_if_actions_are_planned(capsys: pytest.CaptureFixture[str]) -> None:
    shown = Shown(doing="solving", first_seed=10)
    shown.record_bar.show(RecordProgress(0, 3, None, {0: 3, 2: 1}, 50, 0.08))
    assert shown.line() == "solving, seeds 10 and 12 at steps 3 and 1 of 50 0.08/4"
    shown.record_bar.show(RecordProgress(1, 9, (2, THIRD), {}, 50, 1.0))
    assert capsys.readouterr().err.startswith("seed 12: 9 steps")


def test_episodes_of_an_earlier_run_are_counted_and_not_reported(capsys: pytest.CaptureFixture[str]) -> None:
    shown = Shown(named=lambda number: f"point {number}")
    shown.record_bar.show(RecordProgress(2, 0, (1, SECOND), {}, 50, 2.0, was_there=True))
    assert shown.line() == "opening 2/4" and not capsys.readouterr().err
    shown.record_bar.show(RecordProgress(3, 9, (2, THIRD), {}, 50, 3.0))
    assert capsys.readouterr().err.startswith("point 2: ")


def test_ctrl_c_stops_after_this_step_and_a_second_one_at_once() -> None:
    before = signal.getsignal(signal.SIGINT)
    shown = Shown()
    with pytest.raises(KeyboardInterrupt), shown.record_bar:
        os.kill(os.getpid(), signal.SIGINT)  # nothing has begun that could be kept
    assert not shown.record_bar.stop_requested and signal.getsignal(signal.SIGINT) is before
    with pytest.raises(KeyboardInterrupt), shown.record_bar:
        shown.record_bar.show(RecordProgress(0, 1))
        os.kill(os.getpid(), signal.SIGINT)
        assert shown.record_bar.stop_requested
        said = shown.line()
        shown.record_bar.show(RecordProgress(0, 2))
        assert shown.line() == said, "the advice stays"
        os.kill(os.getpid(), signal.SIGINT)
        raise AssertionError("the second one ends at once")
    assert signal.getsignal(signal.SIGINT) is before


# --- where a job runs ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (TaskError(PROBLEM), Exit.FAILED, "task.py:3"),
        (PoolError("a process was killed"), Exit.FAILED, "was killed"),
        (ValueError("--workers"), Exit.REFUSED, "--workers"),
        (OSError("no such folder"), Exit.REFUSED, "no such folder"),
        (KeyboardInterrupt(), Exit.INTERRUPTED, "all kept"),
    ],
)
def test_each_early_end_has_its_exit_code(
    error: BaseException, code: Exit, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_after(error, "all kept") == code and said in capsys.readouterr().err


def test_a_part_counts_its_own_items_and_is_kept_in_its_own_file() -> None:
    parts = [JobArguments(shard=f"{k}/3") for k in (1, 2, 3)]
    # 10 items in chunks of 3: four chunks, of which the last part has two with 3 + 1 items.
    assert [items_of(one, 10, 3) for one in (JobArguments(), *parts)] == [10, 3, 3, 4]
    assert [job_path(one, "solve") for one in (JobArguments(), parts[1])] == [None, Path("solve-2-of-3.job")]
    assert job_path(JobArguments(job=Path("mine.job"), shard="2/3"), "solve") == Path("mine.job")


@pytest.mark.parametrize(
    ("how", "named"),
    [
        ({"workers": 0}, "--workers"),
        ({"cpus_per_worker": 0}, "--cpus-per-worker"),
        ({"cpus_per_worker": -1}, "--cpus-per-worker"),
        ({"gpus_per_worker": -0.5}, "--gpus-per-worker"),
        ({"shard": "3/2"}, "--shard"),
        ({"workers": 1, "cpus_per_worker": 0.5, "gpus_per_worker": 0, "shard": "2/2"}, ""),
    ],
)
def test_a_job_with_an_impossible_place_is_refused(how: dict[str, object], named: str) -> None:
    arguments = JobArguments(**how)  # type: ignore[arg-type]
    if not named:
        return require_job(arguments)
    with pytest.raises(ValueError, match=named):
        require_job(arguments)


@pytest.fixture
def cores(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(4)))
    yield


@pytest.mark.parametrize(
    ("how", "chunks", "here"),
    [
        ({"workers": 1}, 9, True),
        ({}, 9, False),
        ({}, 1, True),
        ({"workers": 3}, 1, True),
        ({"workers": 3}, 2, False),
        ({"shard": "1/9", "workers": 3}, 9, True),
    ],
)
def test_one_chunk_or_one_worker_needs_no_other_process(
    how: dict[str, object],
    chunks: int,
    here: bool,
    cores: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    job = JobKey("square", {"command": "square"}, b"")
    with run_by(JobArguments(**how), "square", chunks, lambda: job) as (executor, name):  # type: ignore[arg-type]
        if isinstance(executor, Kept):
            assert name and (tmp_path / "square-1-of-9.job").exists()
            executor = executor.executor
        else:
            assert name == "" and not list(tmp_path.iterdir())
        assert isinstance(executor, ThisProcess) == here


def test_a_job_that_fails_says_so_in_its_folder_with_the_failures_by_kind(tmp_path: Path) -> None:
    def read() -> JobStatus:
        (status,) = read_jobs(tmp_path, time.time())
        return status

    failures = (Failure((1,), PROBLEM), Failure((3, 4), PROBLEM), Failure((2,), replace(PROBLEM, line=9)))
    shown: list[RecordProgress] = []
    part = JobArguments(shard="2/3")
    with (
        pytest.raises(KeyboardInterrupt),
        status_in_folder(part, "solve", "task.py", tmp_path, 9, lambda number: f"seed {number}") as status,
    ):
        status.with_status(shown.append)(RecordProgress(4, 30, done=4.5, failures=failures))
        raise KeyboardInterrupt
    found = read()
    assert (found.state, found.command, found.task, found.done, found.total) == (
        "failed",
        "solve",
        "task.py",
        4,
        9,
    )
    assert found.part == "2/3" and len(shown) == 1
    assert [(one.items, one.count) for one in found.failures] == [
        ("seed 1, seed 3, seed 4", 3),
        ("seed 2", 1),
    ]
    assert "task.py:3" in found.failures[0].message
    # A job that fails before it began leaves no line, and one without a folder writes nothing.
    other = tmp_path / "other"
    other.mkdir()
    for out in (other, None):
        with (
            pytest.raises(ValueError),
            status_in_folder(JobArguments(), "solve", "task.py", out, 9, str) as status,
        ):
            raise ValueError
        status.end("failed")
    assert read_jobs(other, time.time()) == ()


def test_a_part_without_work_is_said_and_a_stopped_one_can_be_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    job = JobKey("square", {"command": "square"}, b"")
    with run_by(JobArguments(shard="1/3"), "square", 2, lambda: job):
        pass
    assert "2 batches" in capsys.readouterr().err
    part = JobArguments(shard="2/3")
    for arguments, stopped, said in (
        (JobArguments(), False, ""),
        (JobArguments(), True, "--job"),
        (part, True, "again"),
        (part, False, "square-2-of-3.job"),
    ):
        print_part(arguments, "square", stopped)
        printed = capsys.readouterr().err
        assert said in printed and bool(printed) == bool(said)

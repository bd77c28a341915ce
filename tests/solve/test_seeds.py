"""Solving the open task from many seeds in other processes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.drive.session import TASKS, FakeWorkerSession, fake_worker_session
from tests.drive.waiting import until
from workbench.checks.commands import ChooseSeeds, SolveSeeds, StopSolving
from workbench.page.command import Refused
from workbench.planning.options import PlanOptions
from workbench.solve.seeds import RUNNING, SeedsView
from workbench.task.description import TaskOptions
from workbench.task.reference import RecordedTask

FEW = PlanOptions(rollouts=16, horizon=0.3, noise=0.8)
MADE = TaskOptions(
    num_envs=3, seed=7, env_kwargs={"render_backend": "none", "control_mode": "pd_ee_delta_pose"}
)


@contextmanager
def solving(task: object, recordings: Path) -> Iterator[FakeWorkerSession]:
    with fake_worker_session(recordings, task) as fake:
        fake.session.change(plan=FEW)
        fake.load(options=MADE)
        yield fake


def solve(fake: FakeWorkerSession, seeds: int) -> SeedsView:
    fake.session.do(ChooseSeeds(seeds=seeds))
    fake.session.do(SolveSeeds())
    return fake.view.of(SeedsView)


@pytest.mark.slow
def test_each_seed_is_solved_recorded_and_reported_until_a_stop(child_process: None, tmp_path: Path) -> None:
    with solving(str(TASKS / "push_cube.py"), tmp_path / "recordings") as told:
        view = solve(told, 200)
        assert view.state == "starting" and view.total == 200
        until(
            lambda: told.view.of(SeedsView).report is not None,
            "the first seed",
            120.0,
            seen=lambda: told.view.of(SeedsView),
        )
        told.session.do(StopSolving())
        view = told.view.of(SeedsView)
        assert view.state == "stopped" and view.report is not None
        first = view.report.seeds[0]
        assert first.seed == 0 and bool(first.solved_at) != bool(first.in_the_way)
        assert first.path.is_file() and first.path.parent == tmp_path / "recordings"


@pytest.mark.slow
def test_a_task_that_fails_is_reported_with_its_line(child_process: None, tmp_path: Path) -> None:
    file = tmp_path / "broken.py"
    file.write_text("raise KeyError('goal')\n")
    with solving(str(file), tmp_path / "recordings") as told:
        solve(told, 2)
        until(
            lambda: told.view.of(SeedsView).state not in RUNNING,
            "the end",
            120.0,
            seen=lambda: told.view.of(SeedsView),
        )
        view = told.view.of(SeedsView)
    assert view.state == "failed" and view.problem is not None and view.problem.line == 1
    assert "KeyError" in view.problem.message and view.report is None


def test_a_task_named_by_a_recording_is_not_run_from_disk(tmp_path: Path) -> None:
    with solving(RecordedTask("PushCube-v1"), tmp_path / "recordings") as told:
        view = solve(told, 2)
    assert view.state == "failed" and "open the task's file" in view.why


def test_solving_seeds_is_refused_without_a_task(fake: FakeWorkerSession) -> None:
    with pytest.raises(Refused):
        solve(fake, 2)
    assert (fake.view.of(SeedsView).state, fake.view.of(SeedsView).chosen) == ("none", 2)

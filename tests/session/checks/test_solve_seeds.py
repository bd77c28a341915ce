"""The open task solved from many seeds in processes beside."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drive.session import TASKS
from tests.drive.waiting import until
from workbench.authoring.loading.reference import RecordedTask
from workbench.jobs.task import TaskOptions
from workbench.planning.options import PlanOptions
from workbench.session.checks.solve_seeds import RUNNING, SeedsSolver
from workbench.session.protocol.messages import Load

FEW = PlanOptions(rollouts=16, horizon=0.3, noise=0.8)
MADE = TaskOptions(
    num_envs=3, seed=7, env_kwargs={"render_backend": "none", "control_mode": "pd_ee_delta_pose"}
)


@pytest.fixture
def solver(child_process: None, tmp_path: Path) -> Iterator[SeedsSolver]:
    solver = SeedsSolver(lambda: None, tmp_path / "recordings")
    yield solver
    solver.close()


def ended(solver: SeedsSolver) -> None:
    until(lambda: solver.view.state not in RUNNING, "the end", 120.0, seen=lambda: solver.view)


@pytest.mark.slow
def test_each_seed_is_solved_recorded_and_told_and_what_is_done_stays_when_it_is_stopped(
    solver: SeedsSolver, tmp_path: Path
) -> None:
    solver.solve(Load(str(TASKS / "push_cube.py"), MADE), 200, FEW)
    assert solver.view.state == "starting" and solver.view.total == 200
    until(lambda: solver.view.report is not None, "the first seed", 120.0, seen=lambda: solver.view)
    solver.stop()
    view = solver.view
    assert view.state == "stopped" and view.report is not None
    first = view.report.seeds[0]
    assert first.seed == 0 and bool(first.solved_at) != bool(first.in_the_way)
    assert first.path.is_file() and first.path.parent == tmp_path / "recordings"
    solver.loaded()
    assert solver.view.stale and solver.view.report is view.report


@pytest.mark.slow
def test_a_task_that_fails_says_where(solver: SeedsSolver, tmp_path: Path) -> None:
    file = tmp_path / "broken.py"
    file.write_text("raise KeyError('goal')\n")
    solver.solve(Load(str(file), MADE), 2, FEW)
    ended(solver)
    view = solver.view
    assert view.state == "failed" and view.problem is not None and view.problem.line == 1
    assert "KeyError" in view.problem.message and view.report is None


def test_a_task_that_a_recording_names_is_not_run_from_the_disk(solver: SeedsSolver) -> None:
    solver.solve(Load(RecordedTask("PushCube-v1"), MADE), 2, FEW)
    assert solver.view.state == "failed" and "open its file" in solver.view.why

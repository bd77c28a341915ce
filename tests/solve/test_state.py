"""The action source *solve* in a real session: plans of another process are followed until the task is solved."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.drive.session import (
    FakeWorkerSession,
    after_worker_reply,
    live_session,
    start_over,
    step,
    wait_until,
)
from workbench.app.session import Session
from workbench.live.commands import Interrupt, PauseRun, PlayRun, Step
from workbench.live.messages import PlanDropped, PlanWanted, Play
from workbench.planning.options import PlanOptions
from workbench.record.saving_state import SaveWanted
from workbench.record.state import RecordingStatus
from workbench.solve.state import SolveView

FEW = PlanOptions(rollouts=16, horizon=0.3, noise=0.8)
"""Enough to push a cube."""


@pytest.fixture(scope="module")
def session(child_process: None, task_file: Path) -> Iterator[Session]:
    recordings = task_file.parent / "recordings"
    with live_session(task_file, recordings, num_envs=2, control_mode="pd_ee_delta_pose") as session:
        session.change(action_source="solve", plan=FEW, speed=float("inf"))
        yield session


def test_an_episodes_result_is_kept_until_the_next_episode(played: FakeWorkerSession) -> None:
    change = played.session.change
    change(action_source="solve")
    played.reset()
    played.step()
    played.step(2, success=(0,))
    solve = played.view.of(SolveView)
    assert (solve.solved_at, solve.solved, solve.achieved.tolist()) == (2, ((0, 2),), [1, 2, 3])
    change(selected_env=1)
    assert played.view.of(SolveView).solved_at == 0 and played.view.of(SolveView).solved == ((0, 2),)
    change(selected_env=0)
    played.reset((0,))
    assert played.view.of(SolveView).solved == () and len(played.view.of(SolveView).achieved) == 0
    played.step(success=(0,))
    assert played.view.of(SolveView).solved == ((0, 1),), "the next episode's success is shown, too"
    played.session.do(PlayRun())
    played.asked(object)
    played.tell(PlanWanted(5, (0,), why_not="it cannot be copied"))
    solve = played.view.of(SolveView)
    assert solve.state == "failed" and "cannot be copied" in solve.why
    assert [play.playing for play in played.asked(Play)] == [False] and not played.view.playing
    played.tell(PlanDropped())
    assert played.view.of(SolveView).state == "failed", "the failure is shown until something is planned"
    change(action_source="random")
    played.step()
    assert played.view.of(SolveView).solved == () and len(played.view.of(SolveView).achieved) == 0


@pytest.mark.slow
def test_playing_stops_when_the_selected_env_is_solved_and_other_envs_hold_still(session: Session) -> None:
    start_over(session, 3)
    before = session.view().step
    session.do(PlayRun())
    view = wait_until(
        session, lambda view: bool(view.of(SolveView).solved_at) and not view.playing, "a success"
    )
    step = view.step
    assert step is not None and before is not None
    assert view.of(SolveView).solved == ((0, view.of(SolveView).solved_at),)
    assert step.evaluate["success"].tolist() == [True, False]
    assert step.elapsed_steps[0] == view.of(SolveView).solved_at == len(view.of(SolveView).achieved)
    # The other env's cube has not moved.
    assert view.task is not None
    cube = view.task.geometry.body_names.index("cube")
    assert np.abs(step.poses[1, cube] - before.poses[1, cube]).max() < 1e-3
    plan = view.of(SolveView).plan
    assert plan is not None and plan.horizon == 6 and plan.actions.shape == (1, 7)
    assert len(plan.returns) == 16 and (np.diff(plan.returns) <= 0).all()
    assert plan.paths.shape == (16, 7, 3) and plan.traced == "panda/panda_hand_tcp"
    # Predicted and achieved rewards have the same scale: the best rollout of the last plan succeeds.
    assert np.isfinite(view.of(SolveView).predicted).all() and view.of(SolveView).predicted[
        -1
    ] == pytest.approx(1, abs=0.6)
    session.dispatch(SaveWanted((0,)))
    view = wait_until(session, lambda view: bool(view.of(RecordingStatus).saving.message), "the recording")
    assert view.of(RecordingStatus).episodes_written == 1 and not view.of(RecordingStatus).saving.failed, (
        "the recording must be stored like any other"
    )


def test_a_pressed_step_takes_one_planned_step_and_a_pause_ends_the_planning(session: Session) -> None:
    start_over(session, 4)
    view = step(session)
    assert view.step is not None and view.step.elapsed_steps.tolist() == [1, 1] and not view.playing
    session.do(PlayRun())
    wait_until(session, lambda view: view.step is not None and view.step.elapsed_steps[0] >= 2, "two steps")
    session.do(PauseRun())
    view = wait_until(
        session, lambda view: not view.playing and view.of(SolveView).state == "none", "the pause"
    )
    serial = session.view().step_serial
    view = after_worker_reply(session)
    assert view.step_serial - serial <= 1 and view.of(SolveView).state == "none"


def test_a_pressed_step_is_taken_even_if_another_env_is_selected_meanwhile(session: Session) -> None:
    start_over(session, 4)
    last = session.view().timeline.last
    session.do(Step())
    wait_until(session, lambda view: view.of(SolveView).state in ("starting", "planning"), "the planning")
    session.change(selected_env=1)
    wait_until(session, lambda view: view.timeline.last > last, "the step")
    session.change(selected_env=0)


@pytest.mark.slow
def test_a_planned_step_that_hangs_is_detected_and_can_be_interrupted(
    session: Session, task_file: Path, tmp_path: Path
) -> None:
    text = task_file.read_text()
    hangs = tmp_path / "hangs"
    # Only the task hangs: rollouts have more than two envs.
    loop = f"        while self.num_envs == 2 and __import__('os').path.exists({str(hangs)!r}):\n            pass\n"
    serial = session.view().task_serial
    task_file.write_text(text.replace("        return reward\n", f"{loop}        return reward\n"))
    wait_until(session, lambda view: view.task_serial > serial, "the version that can hang")
    start_over(session, 4)
    hangs.touch()
    session.do(Step())
    view = wait_until(session, lambda view: view.busy is not None, "the hang to be detected")
    assert view.busy is not None and view.busy.file == str(task_file)
    session.do(Interrupt())
    view = wait_until(session, lambda view: view.problem is not None and view.busy is None, "the interrupt")
    assert view.problem is not None and view.problem.interrupted
    hangs.unlink()
    step(session)
    task_file.write_text(text)
    wait_until(session, lambda view: view.task_serial > serial + 1, "the original version")


def test_another_body_can_be_traced_and_all_envs_planned_in_turn(session: Session) -> None:
    start_over(session, 5)
    session.change(solve_all=True, traced="cube", plan=replace(FEW, every=2))
    session.do(PlayRun())
    session.change(selected_env=1)
    view = wait_until(session, lambda view: view.of(SolveView).plan is not None, "a plan of the other env")
    plan = view.of(SolveView).plan
    assert plan is not None and plan.env == 1 and plan.traced == "cube" and plan.actions.shape == (2, 7)
    session.do(PauseRun())
    session.change(solve_all=False, traced="", plan=FEW, selected_env=0)


def test_a_saved_version_is_used_for_planning_and_its_errors_are_reported_at_their_line(
    session: Session, task_file: Path
) -> None:
    text = task_file.read_text()
    start_over(session, 6)
    # It fails later than a load's trial steps.
    broken = "        if (self.elapsed_steps > 4).any():\n            raise ValueError('too far')\n        return reward\n"
    assert text.count("        return reward\n") == 1
    serial = session.view().task_serial
    task_file.write_text(text.replace("        return reward\n", broken))
    wait_until(session, lambda view: view.task_serial > serial, "the version")
    session.do(PlayRun())
    view = wait_until(session, lambda view: view.of(SolveView).state == "failed", "the failure")
    wait_until(session, lambda view: not view.playing, "the pause")
    problem = view.of(SolveView).problem
    assert problem is not None and problem.message == "ValueError: too far" and problem.file == str(task_file)
    task_file.write_text(text)
    wait_until(session, lambda view: view.task_serial > serial + 1, "the fixed version")
    step(session)
    assert session.view().of(SolveView).state == "planning"

"""Entering a recording's state in the live session with a real worker."""

# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.drive.session import TASKS, live_session, step, wait_until
from tests.live.recorded_runs import opened, reaching, record
from workbench.app.session import Session
from workbench.envs.recorded_run import RecordedRun
from workbench.live.events import SlidersMoved
from workbench.live.timeline_commands import UndoReset
from workbench.live.view import SessionView

N, STEPS, ENV = 3, 40, 1


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    task = opened(str(TASKS / "push_cube.py"), 2)
    recorded = record(task, STEPS, [11, 12], reaching(STEPS, 2))
    poses.extend(step.poses[ENV] for step in recorded.steps)
    task.env.close()
    return recorded.run(ENV, "an episode")


poses: list[np.ndarray] = []


@pytest.fixture(scope="module")
def live(child_process: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    folder = tmp_path_factory.mktemp("author")
    file = folder / "push_cube.py"
    file.write_text((TASKS / "push_cube.py").read_text())
    with live_session(file, folder / "recordings", num_envs=N) as session:
        session.change(selected_env=ENV)
        session.change(action_source="sliders")
        yield session


def into(session: Session, run: RecordedRun, everywhere: bool = False) -> SessionView:
    number = session.enter_recording(run, everywhere)
    return wait_until(session, lambda v: v.timeline.entered == number, "the recorded state")


def step_with(session: Session, action: np.ndarray) -> SessionView:
    session.dispatch(SlidersMoved(tuple(range(len(action))), tuple(float(x) for x in action)))
    return step(session)


@pytest.mark.slow
@pytest.mark.parametrize("state", [0, 23])
def test_the_live_env_enters_the_recorded_state_and_continues_as_recorded(
    live: Session, run: RecordedRun, state: int
) -> None:
    before = live.view().step
    view = into(live, run.until(state))
    assert np.array_equal(view.step.poses[ENV], poses[state], equal_nan=True)
    assert view.step.elapsed_steps[ENV] == state
    others = [i for i in range(N) if i != ENV]
    assert np.array_equal(view.step.poses[others], before.poses[others], equal_nan=True)
    assert "to the last bit" in view.timeline.arrived and view.timeline.not_carried == ()
    for t in range(state, state + 6):
        view = step_with(live, run.action[t])
        assert np.array_equal(view.step.poses[ENV], poses[t + 1], equal_nan=True)
        assert view.step.reward[ENV] == run.reward[t]


def test_entering_a_state_can_be_undone(live: Session, run: RecordedRun) -> None:
    stood = live.view().step.poses[ENV].copy()
    view = into(live, run.until(10))
    assert view.timeline.undo == "going live of env 1"
    last = view.timeline.last
    live.do(UndoReset())
    view = wait_until(live, lambda v: v.timeline.last > last, "the way back")
    assert np.allclose(view.step.poses[ENV], stood, atol=1e-6, equal_nan=True)
    assert view.timeline.arrived == ""
    # Entering the same recorded moment again counts as a new jump.
    before = view.timeline.entered
    assert into(live, run.until(10)).timeline.entered == before + 1


def test_all_envs_can_enter_one_recorded_state(live: Session, run: RecordedRun) -> None:
    view = into(live, run.until(15), everywhere=True)
    for env in range(N):
        assert np.array_equal(view.step.poses[env], poses[15], equal_nan=True)
    rows = live.env_rows()
    assert rows is not None and rows.steps.tolist() == [15] * N and np.isnan(rows.total).all()


def test_code_that_raises_while_entering_leaves_the_envs_unchanged(live: Session, run: RecordedRun) -> None:
    view = into(live, run.until(5))
    file = Path(view.task.file or "")
    text = file.read_text()
    line = "    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:\n"
    assert line in text
    file.write_text(text.replace(line, f"{line}        assert (self.elapsed_steps != 9).all()\n"))
    view = wait_until(live, lambda v: "!= 9" in v.task.source[str(file)], "the edit")
    stood, last = view.step.poses.copy(), view.timeline.last
    live.enter_recording(run.until(20))
    view = wait_until(live, lambda v: v.problem is not None, "the problem")
    assert view.problem.file == str(file) and "assert" in (view.problem.code or "")
    assert view.timeline.last == last
    file.write_text(text)
    wait_until(live, lambda v: v.task.source[str(file)] == text, "the restored text")
    moved = step_with(live, np.zeros(8)).step.poses
    assert np.nanmax(np.abs(moved - stood)[..., :3]) < 0.02


def test_a_renamed_actor_is_reported_and_the_robot_is_restored(live: Session, run: RecordedRun) -> None:
    view = live.view()
    file = Path(view.task.file or "")
    text = file.read_text()
    assert 'name="cube"' in text
    file.write_text(text.replace('name="cube"', 'name="box"'))
    view = wait_until(live, lambda v: "box" in v.task.geometry.body_names, "the new scene")
    view = into(live, run.until(12))
    not_carried = "; ".join(view.timeline.not_carried)
    assert "actors/cube: " in not_carried and "actors/box: " in not_carried
    hand = view.task.geometry.body_names.index("panda/panda_hand")
    assert np.allclose(view.step.poses[ENV][hand][:3], poses[12][hand][:3], atol=2e-4)
    file.write_text(text)
    wait_until(live, lambda v: "cube" in v.task.geometry.body_names, "the old scene")

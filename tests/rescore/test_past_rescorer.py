"""Rescoring the past with real processes on the example task: one plays and one rescores."""

# pyright: reportOptionalMemberAccess=false, reportArgumentType=false, reportOptionalOperand=false

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.drive.session import TASKS, background_pid, live_session, moments_of, wait_until
from tests.drive.waiting import until
from workbench.app.session import Session
from workbench.live.commands import PauseRun, PlayRun, RebuildScene
from workbench.live.events import EnvsReset
from workbench.live.history.moments import Moment
from workbench.live.process.background_jobs import StoppedBy
from workbench.live.timeline_commands import StopRescoring
from workbench.live.view import SessionView
from workbench.page.command import Refused
from workbench.rescore.state import RescoreView

N = 3
ORIGINAL = (
    (TASKS / "push_cube.py")
    .read_text()
    .replace("from typing import Any", "import os\nimport time\nfrom typing import Any", 1)
)
REWARD = "return self.compute_dense_reward(obs, action, info) / 3"
IN_RESCORER = "os.getpriority(os.PRIO_PROCESS, 0) == 10"
"""An expression that is true in the rescoring process, which has a lower priority."""


@dataclass
class Desk:
    session: Session
    file: Path

    def edit(self, old: str, new: str) -> None:
        """Write the original file with this replacement."""
        assert old in ORIGINAL
        self.file.write_text(ORIGINAL.replace(old, new))

    def record(self, steps: int) -> list[Moment]:
        """Restart with the original, play, and pause at the first moment of new episodes; returns the whole record."""
        session = self.session
        session.do(PauseRun())
        self.file.write_text(ORIGINAL)
        wait_until(session, lambda v: v.task.source[str(self.file)] == ORIGINAL, "the original")
        session.do(RebuildScene())
        first = session.view().timeline.last
        wait_until(session, lambda v: v.timeline.first > first and v.timeline.moments == 1, "a new history")
        with suppress(Refused):  # no rescoring may be running
            session.do(StopRescoring())
        session.change(speed=math.inf)
        session.do(PlayRun())
        wait_until(session, lambda v: v.timeline.moments >= steps, "the steps")
        session.do(PauseRun())
        wait_until(session, lambda v: not v.playing, "the pause")
        last = session.view().timeline.last
        session.dispatch(EnvsReset())
        wait_until(session, lambda v: v.timeline.last > last and v.step.elapsed_steps.max() == 0, "the reset")
        return moments_of(session)

    def rescored(self, *states: str) -> RescoreView:
        before = self.serial

        def reached(view: SessionView) -> bool:
            return view.of(RescoreView).serial > before and view.of(RescoreView).state in (
                states or ("done",)
            )

        return wait_until(self.session, reached, f"a rescoring in state {states or 'done'}").of(RescoreView)

    serial = 0

    def note(self) -> None:
        """Make `rescored` wait for a result newer than now."""
        self.serial = self.session.view().of(RescoreView).serial


@pytest.fixture(scope="module")
def desk(child_process: None, task_file: Path) -> Iterator[Desk]:
    recordings = task_file.parent / "recordings"
    with live_session(task_file, recordings, num_envs=N) as session:
        yield Desk(session, task_file)


@pytest.fixture
def record(desk: Desk) -> list[Moment]:
    moments = desk.record(130)
    desk.note()
    return moments


def steps_of(record: list[Moment]) -> list[Moment]:
    return [moment for moment in record if not moment.jumped.any()]


def episodes_of(record: list[Moment]) -> int:
    """Count the episodes of all envs with at least one step; a fast machine plays more of them before the pause."""
    begins = np.array([moment.jumped for moment in record])
    return int((begins[:-1] & ~begins[1:]).sum())


def test_a_doubled_reward_is_rescored_as_double_bit_for_bit(desk: Desk, record) -> None:
    desk.edit(REWARD, f"{REWARD} * 2")
    view = desk.rescored()
    rewards = np.array([moment.step.reward for moment in steps_of(record)])
    assert (view.done, view.total) == (len(rewards), len(rewards))
    for env in range(N):
        curve = desk.session.rescored_curve("reward", env)
        np.testing.assert_array_equal(curve.old, rewards[:, env])
        np.testing.assert_array_equal(curve.new, 2 * rewards[:, env])
    assert all(verdict.metres == verdict.radians == 0 for verdict in view.verdicts)
    assert len(view.verdicts) == episodes_of(record) >= 3 * N
    for verdict in view.verdicts:
        assert verdict.differing == ("reward",) and verdict.of.env in range(N)
        assert verdict.returns[1] == pytest.approx(2 * verdict.returns[0])
    assert view.differing_names == {"reward"}
    assert not view.warnings


@pytest.mark.slow
def test_code_that_raises_is_reported_with_its_line_and_the_record_stays(desk: Desk, record) -> None:
    late = "if bool((self.elapsed_steps > 20).any()): raise KeyError('late')"
    # The rescoring process is now at the end of an episode, where the new code raises at once.
    desk.edit(REWARD, f"{REWARD} * 2")
    desk.rescored()
    desk.note()
    desk.edit(REWARD, f"{late}\n        {REWARD}")
    view = desk.rescored("failed")
    assert "KeyError: 'late'" in view.problem.message
    assert Path(view.problem.file) == desk.file
    assert desk.file.read_text().splitlines()[view.problem.line - 1].strip() == late
    curve = desk.session.rescored_curve("reward", 1)
    rewards = np.array([moment.step.reward[1] for moment in steps_of(record)])
    np.testing.assert_array_equal(curve.old, rewards)
    assert np.isfinite(curve.new).sum() == view.done
    assert 0 < view.done < view.total


@pytest.mark.slow
def test_the_next_save_replaces_a_running_rescoring_while_the_worker_plays(desk: Desk, record) -> None:
    calls = desk.file.with_name("calls")
    slow = f"if {IN_RESCORER}: time.sleep(0.1) or open({str(calls)!r}, 'a').write('.')"
    desk.edit(REWARD, f"{slow}\n        {REWARD} * 2")
    desk.rescored("rescoring")
    session = desk.session
    session.change(speed=1.0)
    session.do(PlayRun())
    last = session.view().timeline.last
    view = wait_until(session, lambda v: v.timeline.last > last + 10, "the worker that plays")
    assert view.of(RescoreView).state == "rescoring"
    session.do(PauseRun())
    desk.note()
    desk.edit(REWARD, f"{REWARD} * 4")
    # The state "stopped" of the first rescoring lasts only until the process is free, which may be too short to see.
    view = desk.rescored("done")
    assert len(calls.read_text()) < view.done
    for env in range(N):
        curve = session.rescored_curve("reward", env)
        # Steps played after the first of the two saves were recorded with the doubled reward.
        factor = np.where(curve.serial <= record[-1].serial, 4, 2)
        np.testing.assert_array_equal(curve.new, factor * curve.old)


@pytest.mark.slow
def test_a_rescoring_in_an_endless_loop_can_be_stopped_and_the_next_one_runs(desk: Desk, record) -> None:
    loops = desk.file.with_name("loops")
    loop = f"while {IN_RESCORER} and int(self.elapsed_steps.max()) > 20: open({str(loops)!r}, 'w').close()"
    desk.edit(REWARD, f"{loop}\n        {REWARD}")
    desk.rescored("rescoring")
    until(loops.exists, "the loop")
    desk.note()
    process = background_pid(desk.session)
    desk.session.do(StopRescoring())
    view = desk.rescored("stopped")
    assert view.done < view.total and view.stopped_by is StoppedBy.USER
    wait_until(
        desk.session, lambda v: background_pid(desk.session) is None, "the end of the process that hangs"
    )
    assert not Path(f"/proc/{process}").exists()
    desk.note()
    desk.edit(REWARD, f"{REWARD} * 2")
    assert any(verdict.differs for verdict in desk.rescored("done").verdicts)

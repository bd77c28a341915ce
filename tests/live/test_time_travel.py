"""Showing the past and continuing from it, with a real worker on the example task."""

# pyright: reportOptionalMemberAccess=false, reportArgumentType=false, reportOptionalSubscript=false
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tests.drive.session import draw_past, jump, live_session, moment_at, start_over, step, wait_until
from workbench.app.session import Session
from workbench.live.commands import PauseRun, RestartWorker
from workbench.live.events import EnvsReset, MomentShown, PagesCounted, SlidersMoved
from workbench.live.messages import CameraRequest
from workbench.live.timeline_commands import ContinueFromHere, UndoReset
from workbench.record.commands import StopRecording
from workbench.record.state import RecordingStatus, RecordingWanted

N = 3


@pytest.fixture(scope="module")
def session(child_process: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with live_session("PickCube-v1", tmp_path_factory.mktemp("recordings"), num_envs=N, draw=True) as session:
        yield session


def fresh(session: Session) -> int:
    """Pause at the first moment of seed 0's episodes, live; return the moment's serial."""
    session.do(PauseRun())
    session.change(episode_end="reset")
    session.change(action_source="sliders")
    session.dispatch(SlidersMoved(tuple(range(8)), (0.3, -0.4, 0.2, 0.6, -0.1, 0.5, 0.2, -1.0)))
    return start_over(session, 0).timeline.last


def poses(session: Session, serial: int) -> np.ndarray:
    found = moment_at(session, serial)
    assert found is not None
    return found.step.poses


def is_close(poses: np.ndarray, others: np.ndarray) -> bool:
    """Equal except for the last bits: PhysX recomputes the links from root and joints."""
    return np.allclose(poses, others, rtol=0, atol=1e-6, equal_nan=True)


def test_a_branch_repeats_the_past_to_the_last_bit(session: Session) -> None:
    start = fresh(session)
    step(session, 8)
    branches = []
    for _ in range(2):
        session.dispatch(MomentShown(start + 3))
        view = jump(session, lambda: session.do(ContinueFromHere(scope="all")))
        assert view.step.elapsed_steps.tolist() == [3] * N
        assert is_close(view.step.poses, poses(session, start + 3))
        step(session, 5)
        last = session.view().timeline.last
        branches.append(np.stack([poses(session, serial) for serial in range(last - 4, last + 1)]))
    assert np.array_equal(branches[0], branches[1], equal_nan=True)
    first_run = np.stack([poses(session, serial) for serial in range(start + 4, start + 9)])
    # PhysX does not expose its contacts, so the steps up to the moment are replayed.
    assert np.array_equal(branches[0], first_run, equal_nan=True)


def test_the_abandoned_future_can_be_returned_to(session: Session) -> None:
    start = fresh(session)
    step(session, 6)
    left = session.view().step
    session.dispatch(MomentShown(start + 2))
    jump(session, lambda: session.do(ContinueFromHere(scope="all")))
    step(session, 2)
    assert session.view().timeline.undo == "jump of all"
    view = jump(session, lambda: session.do(UndoReset()))
    assert is_close(view.step.poses, left.poses)
    assert view.step.elapsed_steps.tolist() == [6] * N


def test_resets_can_be_undone_one_after_another(session: Session) -> None:
    fresh(session)
    step(session, 3)
    first = session.view().step
    jump(session, lambda: session.dispatch(EnvsReset((0, 1))))
    step(session, 2)
    second = session.view().step
    jump(session, lambda: session.dispatch(EnvsReset(None)))
    view = jump(session, lambda: session.do(UndoReset()))
    assert is_close(view.step.poses, second.poses)
    view = jump(session, lambda: session.do(UndoReset()))
    assert is_close(view.step.poses[:2], first.poses[:2])
    assert view.step.elapsed_steps.tolist() == [3, 3, 5]


def test_a_moment_without_an_action_has_its_recorded_reward_or_none(session: Session) -> None:
    start = fresh(session)
    begin = session.view().timeline.last_tick
    assert np.isnan(session.view().step.reward).all()
    rewards = [step(session, 1).step.reward for _ in range(4)]
    view = jump(session, lambda: session.dispatch(EnvsReset((1,))))
    assert np.isnan(view.step.reward[1]) and np.array_equal(view.step.reward[[0, 2]], rewards[3][[0, 2]])
    session.dispatch(MomentShown(start + 2))
    view = jump(session, lambda: session.do(ContinueFromHere(scope="all")))
    assert np.array_equal(view.step.reward, rewards[1])
    assert not view.timeline.not_carried
    strip = session.look(lambda run: run.strip(begin, view.timeline.last_tick))
    # A strip contains control steps, not the reset and the jump back after them.
    assert np.array_equal(strip.values[1:], [reward[0] for reward in rewards])
    session.dispatch(MomentShown(start + 2))
    assert not jump(session, lambda: session.do(ContinueFromHere(scope="into all"))).timeline.not_carried


@pytest.mark.slow
def test_going_back_ends_a_recording(session: Session) -> None:
    start = fresh(session)
    written = session.view().of(RecordingStatus).episodes_written
    step(session, 1)
    last = session.view().timeline.last
    session.dispatch(RecordingWanted((0,)))
    wait_until(session, lambda v: v.timeline.last > last, "the fresh episode")
    step(session, 3)
    session.dispatch(MomentShown(start + 1))
    jump(session, lambda: session.do(ContinueFromHere(scope="this")))
    view = wait_until(session, lambda v: v.of(RecordingStatus).episodes_written == written + 1, "the file")
    assert view.of(RecordingStatus).active and view.of(RecordingStatus).problem is None
    step(session, 1)
    assert session.view().of(RecordingStatus).steps == 0, (
        "an episode that did not start with a reset is not recorded"
    )
    session.do(StopRecording())


@pytest.mark.slow
def test_a_moment_without_a_picture_is_drawn_in_its_past_state(session: Session) -> None:
    start = fresh(session)
    view = step(session, 12)
    human = next(c for c in view.task.cameras if c.kind == "human")
    wanted = CameraRequest(human.name, "human", ("rgb",))
    # Otherwise the first picture after a jump is a fast one.
    session.change(cameras=(wanted,), pictures="exact")
    session.dispatch(PagesCounted(1))
    key = ("human", human.name)
    now = wait_until(session, lambda v: key in v.pictures, "the live picture").pictures[key]
    session.dispatch(MomentShown(start))
    assert session.view().pictures == {} and session.view().timeline.wants_pictures
    draw_past(session)
    then = wait_until(session, lambda v: key in v.pictures, "the picture of the past").pictures[key]
    assert not session.view().timeline.wants_pictures
    live = session.view().timeline.last
    assert live == start + 12, "drawing makes no step"
    assert np.abs(then.rgb.astype(int) - now.rgb).mean() > 0.5, "the arm was in another pose"
    # After going back, the moment looks the same.
    last = session.view().timeline.last
    session.do(ContinueFromHere(scope="all"))
    wait_until(session, lambda v: v.timeline.last > last and v.timeline.shown is None, "the jump")
    serial = session.view().pictures_serial
    again = wait_until(session, lambda v: v.pictures_serial > serial and key in v.pictures, "its picture")
    assert np.abs(then.rgb.astype(int) - again.pictures[key].rgb).max() <= 2
    session.change(cameras=(), pictures="auto")
    session.dispatch(PagesCounted(0))


@pytest.mark.slow
def test_episodes_continue_unchanged_with_a_replacement_worker(session: Session) -> None:
    fresh(session)
    step(session, 4)
    before, rows = session.view(), session.env_rows()
    view = jump(session, lambda: session.do(RestartWorker()))
    now = session.env_rows()
    assert view.reload.level == "restarted" and view.timeline.first == before.timeline.first
    assert np.array_equal(view.step.reward, before.step.reward)
    assert now.followed.all() and now.steps.tolist() == [4] * N
    assert now.total.tolist() == rows.total.tolist()
    assert np.array_equal(now.rewards, rows.rewards, equal_nan=True)

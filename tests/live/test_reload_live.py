"""Saves of every kind under a running session: what is loaded, at which level, and what stays."""

# The fixture hands over a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.drive.session import after_worker_reply, runs, save, wait_until
from workbench.app.session import Session
from workbench.live.commands import ChooseClass, PauseRun, PlayRun, RebuildScene, ReloadFile, Step
from workbench.live.events import EnvsReset
from workbench.live.view import SessionView
from workbench.record.commands import StopRecording
from workbench.record.state import RecordingStatus, RecordingWanted

DRAWS = True

SECOND_TASK = '''

@register_env("PushTheOther-v1", max_episode_steps=30)
class PushTheOtherEnv(PushCubeEnv):
    """The same with a shorter time."""
'''


@pytest.fixture(scope="module")
def good(task_file: Path, session: Session) -> str:
    return task_file.read_text()


@pytest.fixture(autouse=True)
def good_again(session: Session, task_file: Path, good: str) -> Iterator[None]:
    yield
    session.do(PauseRun())
    save(session, task_file, good)


def reward_plus(good: str, number: float) -> str:
    assert good.count("return reward\n") == 1
    return good.replace("return reward\n", f"return reward + {number}\n")


def played(session: Session, steps: int) -> SessionView:
    """The view, paused, after playing some steps."""
    session.change(speed=8.0)
    session.do(PlayRun())
    count = session.view().timeline.last_tick
    wait_until(session, lambda v: v.timeline.last_tick >= count + steps, "some steps")
    session.do(PauseRun())
    wait_until(session, lambda v: not v.playing and v.state == "paused", "the pause")
    # Events that the worker sends after pausing arrive before its answer.
    return after_worker_reply(session)


def test_a_patch_keeps_moment_past_and_selection_and_updates_the_numbers_while_paused(
    session: Session, task_file: Path, good: str
) -> None:
    session.change(selected_env=1)
    before = played(session, 5)
    view = save(session, task_file, reward_plus(good, 3))
    assert (view.reload.level, view.reload.reason) == ("patched", "only compute_dense_reward changed")
    assert (view.scene_serial, view.cameras_serial) == (before.scene_serial, before.cameras_serial)
    assert view.task.geometry is before.task.geometry
    np.testing.assert_array_equal(view.step.poses, before.step.poses)
    if view.step.action is not None:
        np.testing.assert_allclose(view.step.reward, before.step.reward + 1, rtol=1e-5)
    assert view.timeline.last_tick == before.timeline.last_tick
    assert view.selected_env == 1 and not view.playing
    session.do(Step())
    after = wait_until(session, lambda v: v.timeline.last_tick > view.timeline.last_tick, "the next step")
    assert after.timeline.last_tick == view.timeline.last_tick + 1


def test_playing_goes_on_through_a_patch(session: Session, task_file: Path, good: str) -> None:
    session.do(PlayRun())
    wait_until(session, lambda v: v.state == "running", "play")
    view = save(session, task_file, reward_plus(good, 4))
    assert view.reload.level == "patched"
    wait_until(session, lambda v: v.step_serial > view.step_serial + 3 and v.state == "running", "more steps")


def test_a_level_can_be_requested_without_a_change_and_a_new_scene_is_at_the_same_moment(
    session: Session, good: str
) -> None:
    before = played(session, 4)
    session.do(RebuildScene())
    view = wait_until(session, lambda v: v.task_serial > before.task_serial, "the load")
    assert view.reload.level == "rebuilt" and view.scene_serial == before.scene_serial + 1
    np.testing.assert_allclose(view.step.poses, before.step.poses, atol=1e-4)
    np.testing.assert_array_equal(view.step.elapsed_steps, before.step.elapsed_steps)
    session.do(ReloadFile())
    view = wait_until(session, lambda v: v.task_serial > view.task_serial, "the load")
    assert (view.reload.level, view.reload.reason) == ("same", "nothing changed")


# --- editors -------------------------------------------------------------------------------------------


def test_the_last_of_several_saves_in_50_ms_wins(session: Session, task_file: Path, good: str) -> None:
    loads = session.view().task_serial
    for number in range(10, 20):
        task_file.write_text(reward_plus(good, number))
        time.sleep(0.005)
    view = runs(session, reward_plus(good, 19))
    assert view.task_serial - loads <= 3


def test_a_save_while_a_reload_runs_wins(session: Session, task_file: Path, good: str) -> None:
    red = good.replace("base_color=[0.05,", "base_color=[0.7,")
    task_file.write_text(red)
    # Or the reload is over already.
    wait_until(
        session,
        lambda v: v.activity.startswith("building") or red in v.task.source.values(),
        "the slow reload",
    )
    last = reward_plus(good, 21)
    task_file.write_text(last)
    view = runs(session, last)
    session.do(ReloadFile())
    view = wait_until(session, lambda v: v.task_serial > view.task_serial, "another load")
    assert view.task.source[str(task_file)] == last, "the older save overwrote it"


def test_other_line_endings_are_not_a_change_but_an_edit_among_them_is(
    session: Session, task_file: Path, good: str
) -> None:
    before = session.view().task_serial
    task_file.write_bytes(good.replace("\n", "\r\n").encode())
    edited = reward_plus(good, 25)
    task_file.write_bytes(edited.replace("\n", "\r\n").encode())
    view = runs(session, edited)
    assert view.reload.level == "patched" and view.task_serial == before + 1


# --- several tasks ---------------------------------------------------------------------------------------


def test_one_of_two_tasks_in_a_file_can_be_chosen_and_stays_chosen(
    session: Session, task_file: Path, good: str
) -> None:
    view = save(session, task_file, good + SECOND_TASK)
    assert (view.task.class_name, view.task.others) == ("PushTheOtherEnv", ("PushCubeEnv",))
    assert view.reload.level == "rebuilt" and "a different task" in view.reload.reason
    session.do(ChooseClass(name="PushCubeEnv"))
    view = wait_until(session, lambda v: v.task.class_name == "PushCubeEnv", "the other task")
    assert view.task.others == ("PushTheOtherEnv",) and view.task.max_episode_steps == 50
    edited = reward_plus(good, 31) + SECOND_TASK
    view = save(session, task_file, edited)
    assert view.task.class_name == "PushCubeEnv" and view.reload.level == "patched"


# --- recording ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_recording_goes_on_with_the_next_episode_and_the_moment_stays(
    session: Session, task_file: Path, good: str
) -> None:
    session.dispatch(RecordingWanted((0,)))
    before = played(session, 5)
    assert before.of(RecordingStatus).steps > 0
    view = save(session, task_file, reward_plus(good, 41))
    np.testing.assert_array_equal(view.step.poses, before.step.poses)
    view = wait_until(
        session, lambda v: v.of(RecordingStatus).episodes_written == 1, "the episode of the old version"
    )
    assert view.of(RecordingStatus).active and view.of(RecordingStatus).steps == 0
    session.dispatch(EnvsReset((0,)))
    played(session, 3)
    assert session.view().of(RecordingStatus).steps >= 3
    session.do(StopRecording())

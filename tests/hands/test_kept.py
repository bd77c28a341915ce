"""Episodes that a person drives are recorded, exported, and replayed to success by ManiSkill's own tool."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.drive.session import (
    after_worker_reply,
    jump,
    live_session,
    moment_at,
    start_over,
    step,
    wait_until,
)
from workbench.app.session import Session
from workbench.cli.main import main
from workbench.episodes.reader.read_episode import read_episode
from workbench.hands.commands import BeginAgain, DiscardEpisode, KeepEpisode, ToggleDriving
from workbench.hands.drive_keys import GRIPPER_KEY, PAIRS
from workbench.hands.state import BodyMoved, Driven, Hands
from workbench.live.commands import PauseRun, ResetSelected
from workbench.live.timeline_commands import UndoReset
from workbench.page.command import Refused
from workbench.record.commands import StopRecording, ToggleSavePast
from workbench.record.saving_state import KeptEpisodes
from workbench.record.state import RecordingStatus, RecordingWanted

ENV = 1
MOST_STEPS = 120
TCP = "panda/panda_hand_tcp"


@pytest.fixture(scope="module", params=["pd_ee_delta_pose"])
def session(
    request: pytest.FixtureRequest, child_process: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Session]:
    where = tmp_path_factory.mktemp("recordings")
    with live_session("PushCube-v1", where, num_envs=2, control_mode=request.param) as session:
        session.change(selected_env=ENV)
        yield session


@pytest.fixture
def driven(session: Session) -> Iterator[Session]:
    """The session with a driven env that stands at the beginning of an episode."""
    start_over(session, 0)
    session.do(ToggleDriving())
    session.do(PauseRun())
    after_worker_reply(session)
    jump(session, lambda: session.do(BeginAgain()))
    yield session
    session.do(ToggleDriving())
    session.do(PauseRun())


def kept(session: Session) -> KeptEpisodes:
    return session.view().of(RecordingStatus).kept


def drive(session: Session, steps: int) -> None:
    for _ in range(steps):
        session.dispatch(Driven(("w",), 0.0))
        step(session)


def seed(session: Session) -> int:
    """Seed of the driven env's last reset."""
    newest = moment_at(session, session.view().timeline.last)
    assert newest is not None and newest.seeds is not None
    return int(newest.seeds[ENV])


def position(session: Session, body: str) -> np.ndarray:
    view = session.view()
    return view.step.poses[ENV, view.task.geometry.body_names.index(body), :3]


def keys_towards(session: Session, pushes: bool) -> tuple[str, ...]:
    """Keys that move the hand behind the cube and then down; if `pushes`, keys that move it ahead."""
    tcp, cube = position(session, TCP), position(session, "cube")
    behind = np.array([cube[0] - 0.08, cube[1], 0.02])
    aim = np.array([tcp[0] + 1, cube[1], 0.02]) if pushes else behind
    if not pushes and np.hypot(*(tcp - behind)[:2]) > 0.03:
        aim[2] = 0.15
    pairs = zip(PAIRS, aim - tcp, strict=False)
    return tuple(pair[int(away < 0)] for pair, away in pairs if abs(away) > 0.012)


def drive_to_success(session: Session) -> int:
    """Close the gripper, and drive until the task succeeds; returns the number of steps."""
    pushes = False
    session.dispatch(Driven((GRIPPER_KEY,), 0.0))
    for count in range(MOST_STEPS):
        pushes = pushes or position(session, TCP)[2] < 0.04
        session.dispatch(Driven(keys_towards(session, pushes), 0.0))
        if step(session).step.evaluate["success"][ENV]:
            return count + 1
    raise AssertionError("the cube did not reach the goal")


def replayed(recording: Path, tmp_path: Path) -> str:
    """What ManiSkill's ``replay_trajectory`` prints after it has replayed the actions of an exported recording."""
    file = tmp_path / "demos.h5"
    with pytest.raises(SystemExit) as ended:
        main(["export", str(recording), "--maniskill", str(file), "--only-successes"])
    assert not ended.value.code
    command = [sys.executable, "-m", "mani_skill.trajectory.replay_trajectory", "--traj-path", str(file)]
    done = subprocess.run([*command, "--save-traj"], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("session", ["pd_ee_delta_pos"], indirect=True)
def test_a_driven_episode_is_recorded_and_maniskill_replays_it_to_success(
    session: Session, tmp_path: Path
) -> None:
    session.do(ToggleDriving())
    session.do(PauseRun())
    after_worker_reply(session)
    jump(session, lambda: session.dispatch(RecordingWanted((ENV,))))
    drive_to_success(session)
    view = wait_until(session, lambda v: v.of(RecordingStatus).episodes_written, "the files")
    with pytest.raises(Refused, match="Shift\\+C"):
        session.do(KeepEpisode())
    session.do(StopRecording())
    assert view.of(RecordingStatus).problem is None
    recording = Path(view.of(RecordingStatus).last_file or "")
    episode = read_episode(recording)
    assert {by for _, by in episode.info.acted_by} == {"sliders"} and episode.flags["success"][-1]
    assert "1/1=100.00% demos saved" in replayed(recording, tmp_path)


@pytest.mark.slow
def test_maniskill_replays_a_kept_episode_to_success(driven: Session, tmp_path: Path) -> None:
    before = kept(driven)
    drive_to_success(driven)
    drive(driven, 2)
    driven.do(KeepEpisode())
    view = wait_until(driven, lambda v: v.of(RecordingStatus).kept.saved > before.saved, "the files")
    assert view.of(RecordingStatus).kept.successes == before.successes + 1
    assert "1/1=100.00% demos saved" in replayed(Path(view.of(RecordingStatus).last_file or ""), tmp_path)


def test_a_kept_episode_goes_on_after_the_time_limit_and_the_next_seed_begins(driven: Session) -> None:
    before, first = kept(driven), seed(driven)
    drive(driven, 51)
    assert driven.view().step.truncated[ENV]
    jump(driven, lambda: driven.do(KeepEpisode()))
    note = driven.view().of(Hands).note
    assert seed(driven) == first + 1 and f"seed {first} (51 steps)" in note
    assert kept(driven).saved > before.saved or "is kept" not in note, "it is not saved yet"
    with pytest.raises(Refused, match="kept already"):
        driven.do(KeepEpisode())
    view = wait_until(driven, lambda v: v.of(RecordingStatus).kept.saved > before.saved, "the files")
    assert f"seed {first} (51 steps) is kept" in view.of(Hands).note
    assert view.of(RecordingStatus).kept.successes == before.successes
    episode = read_episode(Path(view.of(RecordingStatus).last_file or ""))
    assert (episode.info.seed, episode.info.env_index, episode.length) == (first, ENV, 51)


def test_nothing_is_saved_of_a_discarded_episode_and_undo_brings_it_back(driven: Session) -> None:
    before, first = driven.view().of(RecordingStatus), seed(driven)
    with pytest.raises(Refused, match="no step yet"):
        driven.do(DiscardEpisode())
    drive(driven, 3)
    stood = driven.view().step.poses[ENV].copy()
    jump(driven, lambda: driven.do(DiscardEpisode()))
    assert seed(driven) == first and driven.view().step.elapsed_steps[ENV] == 0
    assert "discarded" in driven.view().of(Hands).note
    jump(driven, lambda: driven.do(UndoReset()))
    np.testing.assert_array_equal(driven.view().step.poses[ENV], stood)
    assert not driven.view().of(Hands).note, "it is back"
    jump(driven, lambda: driven.do(BeginAgain()))
    assert seed(driven) == first + 1 and "was not kept" in driven.view().of(Hands).note
    jump(driven, lambda: driven.do(BeginAgain()))
    assert seed(driven) == first + 2 and not driven.view().of(Hands).note
    assert driven.view().of(RecordingStatus) == before


def test_a_note_on_an_episode_that_was_left_ends_with_the_next_reset_or_with_driving(driven: Session) -> None:
    drive(driven, 1)
    jump(driven, lambda: driven.do(DiscardEpisode()))
    jump(driven, lambda: driven.do(ResetSelected()))
    assert not driven.view().of(Hands).note
    drive(driven, 1)
    jump(driven, lambda: driven.do(DiscardEpisode()))
    assert driven.view().of(Hands).note
    driven.do(ToggleDriving())
    assert not driven.view().of(Hands).note
    driven.do(ToggleDriving())


def test_a_kept_episode_that_was_not_saved_can_be_kept_again(driven: Session) -> None:
    before = kept(driven)
    drive(driven, 2)
    driven.do(KeepEpisode())
    driven.do(ToggleSavePast())
    view = driven.view()
    assert view.of(RecordingStatus).kept.failed == before.failed + 1 and "not saved" in view.of(Hands).note
    driven.do(KeepEpisode())
    wait_until(driven, lambda v: v.of(RecordingStatus).kept.saved > before.saved, "the files")


def test_a_session_that_is_closed_first_saves_the_kept_episode(child_process: None, tmp_path: Path) -> None:
    with live_session("PushCube-v1", tmp_path, num_envs=1, control_mode="pd_ee_delta_pose") as session:
        session.do(ToggleDriving())
        session.do(PauseRun())
        after_worker_reply(session)
        for _ in range(30):
            step(session)
        steps = session.view().step.elapsed_steps[0]
        session.do(KeepEpisode())
        session.close(finish_saving=True)
        assert session.saving().kept == KeptEpisodes(saved=1)
    (recording,) = tmp_path.glob("*.rrd")
    assert read_episode(recording).length == steps


def test_the_episode_that_was_just_left_can_be_kept(driven: Session) -> None:
    before, first = kept(driven), seed(driven)
    drive(driven, 2)
    jump(driven, lambda: driven.do(BeginAgain()))
    driven.do(KeepEpisode())
    assert seed(driven) == first + 1, "the episode that has begun goes on"
    wait_until(driven, lambda v: v.of(RecordingStatus).kept.saved > before.saved, "the files")


def test_a_kept_episode_that_is_taken_up_again_is_kept_anew(driven: Session) -> None:
    before = kept(driven)
    drive(driven, 2)
    jump(driven, lambda: driven.do(KeepEpisode()))
    jump(driven, lambda: driven.do(UndoReset()))
    drive(driven, 2)
    jump(driven, lambda: driven.do(KeepEpisode()))
    view = wait_until(driven, lambda v: v.of(RecordingStatus).kept.saved == before.saved + 2, "the files")
    assert read_episode(Path(view.of(RecordingStatus).last_file or "")).length == 4


def test_what_a_hand_moved_is_told_when_the_episode_is_kept(driven: Session) -> None:
    before = kept(driven)
    drive(driven, 1)
    jump(driven, lambda: driven.dispatch(BodyMoved("cube", (ENV,), (0.0, 0.2, 0.02, 1.0, 0.0, 0.0, 0.0))))
    drive(driven, 1)
    driven.do(KeepEpisode())
    assert "by hand" in driven.view().of(Hands).note
    wait_until(driven, lambda v: v.of(RecordingStatus).kept.saved > before.saved, "the files")

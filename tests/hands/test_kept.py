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

from tests.drive.session import jump, live_session, step, wait_until
from workbench.app.session import Session
from workbench.cli.main import main
from workbench.episodes.reader.read_episode import read_episode
from workbench.hands.commands import ToggleDriving
from workbench.hands.drive_keys import GRIPPER_KEY, PAIRS
from workbench.hands.state import Driven
from workbench.record.commands import StopRecording
from workbench.record.state import RecordingStatus, RecordingWanted

ENV = 1
MOST_STEPS = 120
TCP = "panda/panda_hand_tcp"


@pytest.fixture(scope="module", params=["pd_ee_delta_pos", "pd_ee_delta_pose"])
def session(
    request: pytest.FixtureRequest, child_process: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Session]:
    where = tmp_path_factory.mktemp("recordings")
    with live_session("PushCube-v1", where, num_envs=2, control_mode=request.param) as session:
        session.change(selected_env=ENV)
        yield session


def position(session: Session, body: str) -> np.ndarray:
    view = session.view()
    return view.step.poses[ENV, view.task.geometry.body_names.index(body), :3]


def keys_towards(session: Session, pushes: bool) -> tuple[str, ...]:
    """Keys that move the hand over a point behind the cube and down, or, when it `pushes`, ahead."""
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
    session.happen(Driven((GRIPPER_KEY,), 0.0))
    for count in range(MOST_STEPS):
        pushes = pushes or position(session, TCP)[2] < 0.04
        session.happen(Driven(keys_towards(session, pushes), 0.0))
        if step(session).step.evaluate["success"][ENV]:
            return count + 1
    raise AssertionError("the cube did not reach the goal")


def replayed_success(recording: Path, tmp_path: Path) -> str:
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
def test_a_driven_episode_is_recorded_and_maniskill_replays_it_to_success(session: Session, tmp_path: Path) -> None:
    session.do(ToggleDriving())
    jump(session, lambda: session.happen(RecordingWanted((ENV,))))
    print(drive_to_success(session))
    view = wait_until(session, lambda v: v.of(RecordingStatus).episodes_written >= 1, "the files")
    session.do(StopRecording())
    recording = view.of(RecordingStatus)
    assert recording.problem is None
    episode = read_episode(Path(recording.last_file))
    assert {by for _, by in episode.info.acted_by} == {"sliders"}
    assert episode.flags["success"][-1]
    assert "1/1=100.00% demos saved" in replayed_success(Path(recording.last_file), tmp_path)

"""Recorded episodes rescored with today's code, compared with a direct computation."""

# pyright: reportOptionalSubscript=false, reportArgumentType=false

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.live.recorded_runs import Recorded, opened, reaching, record
from workbench.envs.recorded_run import RecordedRun
from workbench.episodes.episode import Episode, EpisodeInfo
from workbench.episodes.recorded_state import read_states
from workbench.rescore.replay_recordings import rescore
from workbench.rescore.verdict import Verdict
from workbench.task.open import OpenedTask

pytestmark = pytest.mark.thorough

TASKS = Path(__file__).parents[2] / "tasks"
TEXT = (TASKS / "push_cube.py").read_text()
STEPS = 30
SUCCESS = '"success": (distance < GOAL_RADIUS) & (height.abs() < 0.005),'


TCP: list[int] = []
"""Index of the gripper's point among the bodies."""


@dataclass(frozen=True)
class InMemorySource:
    """An in-memory episode in place of a file."""

    run: RecordedRun
    name: str = "held"
    id: str = "held"

    def read(self) -> Episode:
        run = self.run
        info = EpisodeInfo("WorkbenchPushCube-v1", 0, run.seed, None, "", {}, 0.05, None, "cpu")
        ended = np.zeros(run.length, bool)
        return Episode(
            info, None, {}, None, run.action, (), run.reward, ended, ended, run.evaluate, [], run.env_states
        )


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    task = opened(str(TASKS / "push_cube.py"), 5)
    recorded = record(task, STEPS, [3, 4, 5, 6, 7], reaching(STEPS, 5))
    TCP[:] = [task.description.geometry.body_names.index("panda/panda_hand_tcp")]
    task.env.close()
    return recorded


def verdicts_of(task: OpenedTask, files: list[InMemorySource], use_env_states: bool) -> list[Verdict]:
    parts = rescore(task, files, use_env_states=use_env_states, read=InMemorySource.read)
    return [verdict for part in parts for verdict in part.verdicts]


def rescored(
    tmp_path: Path, recorded: Recorded, text: str = TEXT, use_env_states: bool = False
) -> list[Verdict]:
    """Verdicts on the five episodes of different lengths, in their order."""
    file = tmp_path / "push_cube.py"
    file.write_text(text)
    task = opened(str(file), 2)
    files = [InMemorySource(recorded.run(k).until(STEPS - 3 * k), name=str(k), id=str(k)) for k in range(5)]
    verdicts = verdicts_of(task, files, use_env_states)
    task.env.close()
    return sorted(verdicts, key=lambda verdict: verdict.of.name)


@pytest.mark.parametrize("use_env_states", [False, True], ids=["actions", "states"])
def test_unchanged_code_gives_the_recorded_values_bit_for_bit(
    tmp_path: Path, recorded: Recorded, use_env_states: bool
) -> None:
    for k, verdict in enumerate(rescored(tmp_path, recorded, use_env_states=use_env_states)):
        assert verdict.why_not == "" and verdict.length == STEPS - 3 * k and verdict.seed == 3 + k
        assert not verdict.differs and verdict.differing == () and verdict.missed == {}
        assert verdict.metres == 0 and not verdict.start_differs
        np.testing.assert_array_equal(verdict.new_reward, verdict.old_reward)


def test_a_changed_success_is_found_at_the_same_state_as_by_direct_computation(
    tmp_path: Path, recorded: Recorded
) -> None:
    heights = [np.array([step.poses[k, TCP[0], 2] for step in recorded.steps]) for k in range(5)]
    limit = float(np.float32(0.5 * (heights[0][0] + heights[0].min())))
    changed = TEXT.replace(SUCCESS, f'"success": self.agent.tcp.pose.p[:, 2] < {limit!r},')
    verdicts = rescored(tmp_path, recorded, changed)
    firsts = []
    for k, (verdict, height) in enumerate(zip(verdicts, heights, strict=True)):
        states = np.flatnonzero(height[: STEPS - 3 * k + 1] < np.float32(limit))
        firsts.append(int(states[0]) if len(states) else None)
        assert verdict.success == (None, firsts[-1]) and verdict.has_success
        assert verdict.first_difference is not None or firsts[-1] is None
    assert firsts[0] is not None and firsts[0] > 1


def test_unusable_recordings_are_reported_with_a_reason_and_the_others_are_rescored(
    recorded: Recorded,
) -> None:
    task = opened(str(TASKS / "push_cube.py"), 2)
    run = recorded.run(0)
    files = [
        InMemorySource(replace(run, action=run.action[:, :3]), name="narrow"),
        InMemorySource(run.until(0), name="empty"),
        InMemorySource(run.until(4), name="fine"),
        InMemorySource(replace(run, env_states={}), name="no states"),
    ]
    by_name = {verdict.of.name: verdict for verdict in verdicts_of(task, files, True)}
    task.env.close()
    assert "3 dimensions" in by_name["narrow"].why_not and by_name["empty"].why_not == "it has no step"
    assert "env states" in by_name["no states"].why_not
    assert by_name["fine"].why_not == "" and not by_name["fine"].differs


BALL = """
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.building.actors import build_sphere
from mani_skill.utils.structs.pose import Pose


class FallingBallEnv(BaseEnv):
    SUPPORTED_ROBOTS = ["none"]
    SUPPORTED_REWARD_MODES = ["dense"]

    def __init__(self, *args, **kwargs):
        super().__init__(*args, robot_uids="none", **kwargs)

    def _load_scene(self, options):
        self.ball = build_sphere(self.scene, 0.1, [1, 0, 0, 1], "ball", initial_pose=Pose.create_from_pq([0, 0, 5]))

    def _initialize_episode(self, env_idx, options):
        self.ball.set_pose(Pose.create_from_pq(torch.tensor([[0.0, 0.0, 5.0]]).repeat(len(env_idx), 1)))

    def _get_obs_agent(self):
        return {}

    def get_state_dict(self):
        return self.scene.get_sim_state()  # BaseEnv's version needs a robot

    def _get_obs_extra(self, info):
        return {"ball": self.ball.pose.p}

    def evaluate(self):
        return {"low": self.ball.pose.p[:, 2] < 4.9}

    def compute_dense_reward(self, obs, action, info):
        return self.ball.pose.p[:, 2]
"""


@pytest.mark.parametrize("use_env_states", [False, True], ids=["actions", "states"])
def test_a_task_without_a_robot_is_rescored(tmp_path: Path, use_env_states: bool) -> None:
    (tmp_path / "ball.py").write_text(BALL)
    task = opened(str(tmp_path / "ball.py"), 2)
    steps = [task.env.reset(0)]
    states = [read_states(task.env.env)]
    for _ in range(10):
        steps.append(task.env.step(None))
        states.append(read_states(task.env.env))
    reward = np.array([step.reward[0] for step in steps[1:]], np.float32)
    low = np.array([step.evaluate["low"][0] for step in steps])
    rows = {name: np.stack([state[name][0] for state in states]) for name in states[0]}
    run = RecordedRun("fallen", 0, {}, np.zeros((10, 0), np.float32), rows, {"low": low}, reward)
    (verdict,) = verdicts_of(task, [InMemorySource(run)], use_env_states)
    task.env.close()
    assert verdict.why_not == "" and reward[0] > reward[-1] and low[-1]
    np.testing.assert_array_equal(verdict.new_reward, reward)
    assert verdict.differing == ()

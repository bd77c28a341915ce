"""Replay of past moments with a worker's current code, bit for bit."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false

from __future__ import annotations

import pickle
from collections.abc import Iterator

import numpy as np
import pytest

from tests.drive.session import TASKS
from workbench.envs import action_vector as actions
from workbench.envs.step_result import StepResult
from workbench.rescore.replay_past import rescore_moments
from workbench.rescore.verdict import MomentToRescore, RescoredMoments, RescoreMoments
from workbench.task.description import TaskOptions
from workbench.task.load import load_task
from workbench.task.open import OpenedTask, Opening, build_task

N = 3
SUCCESS = '"success": (distance < GOAL_RADIUS) & (height.abs() < 0.005),'
DRAWS = f'{SUCCESS} "noise": torch.rand(self.num_envs) + torch.randn(()),'
"""Draws from torch's global generator, which all envs share."""


@pytest.fixture(scope="module")
def draws(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OpenedTask]:
    file = tmp_path_factory.mktemp("draws") / "push_cube.py"
    text = (TASKS / "push_cube.py").read_text()
    assert SUCCESS in text
    file.write_text(text.replace(SUCCESS, DRAWS))
    options = TaskOptions(N, "cpu", 0, {"render_backend": "none"})
    opening = Opening(on_finding=lambda finding: None, begins_anew=True)
    opened = build_task(load_task(str(file)), options, opening)
    yield opened
    opened.env.close()


class Record:
    """A session's record: a reset of all envs, then steps, with partial resets in between."""

    def __init__(self, opened: OpenedTask) -> None:
        task, rng = opened.env, np.random.default_rng(0)
        self.moments: list[MomentToRescore] = []
        self.steps: list[StepResult] = []

        def jump(step: StepResult, envs: tuple[int, ...]) -> None:
            self.moments.append(MomentToRescore(None, pickle.dumps(task.snapshot()), envs))
            self.steps.append(step)

        jump(task.reset(5), tuple(range(N)))
        for envs in ((1,), (0, 2), (1,), ()):
            for _ in range(4):
                action = actions.random_action(task.parts, N, rng)
                self.steps.append(task.step(action))
                self.moments.append(MomentToRescore(action))
            if envs:
                jump(task.reset([90 + i for i in envs], envs), envs)


def test_a_task_that_draws_from_torchs_global_generator_is_replayed_bit_for_bit(
    draws: OpenedTask,
) -> None:
    """This holds too after a partial reset, which restores only the generators of its own envs."""
    record = Record(draws)
    made = [step for moment, step in zip(record.moments, record.steps, strict=True) if not moment.snapshot]
    assert len({step.evaluate["noise"].tobytes() for step in made}) == len(made) == 16
    for _ in range(2):
        draws.env.step(np.zeros((N, 8), np.float32))  # the generator advances meanwhile
        rescored = rescore_moments(draws, RescoreMoments(tuple(record.moments)))
        assert rescored.problem is None and rescored.not_carried == {}
        for moment, was, now in zip(record.moments, record.steps, rescored.steps, strict=True):
            np.testing.assert_array_equal(now.poses, was.poses)
            if moment.snapshot is None:
                np.testing.assert_array_equal(now.evaluate["noise"], was.evaluate["noise"])
                np.testing.assert_array_equal(now.reward, was.reward)


def test_a_replay_in_pieces_equals_one_at_once(draws: OpenedTask) -> None:
    record = Record(draws)
    whole = rescore_moments(draws, RescoreMoments(tuple(record.moments)))
    pieces: list[RescoredMoments] = [
        rescore_moments(draws, RescoreMoments(tuple(record.moments[at : at + 3])))
        for at in range(0, len(record.moments), 3)
    ]
    parts = [step for piece in pieces for step in piece.steps]
    for one, other in zip(whole.steps, parts, strict=True):
        for name in one.evaluate:
            np.testing.assert_array_equal(one.evaluate[name], other.evaluate[name])
        np.testing.assert_array_equal(one.reward, other.reward)

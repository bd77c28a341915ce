"""Episodes that checks roll out: each is that of its own seed, whatever envs it shares its batch with."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.checks.checked import EXAMPLE
from workbench.checks.evidence.collect import Checkup, read_obs
from workbench.checks.evidence.rolled_episodes import Episodes
from workbench.envs.action_vector import hold_action
from workbench.envs.outliers import OutlierKind
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv
from workbench.task.load import LoadedTask, load_task, undo_load

pytestmark = pytest.mark.thorough

END = '"fail": height < -0.1,', '"fail": self.elapsed_steps > self._episode_seed_of() % 7,'
"""Seed s ends after s % 7 + 1 steps."""
SEED = (
    "    def evaluate(self)",
    "    def _episode_seed_of(self):\n        return torch.from_numpy(self._episode_seed)\n\n    def evaluate(self)",
)
NAN = (
    "reward = reach + push\n",
    "reward = torch.where(self.elapsed_steps % 3 == self._episode_seed_of() % 3, torch.nan, reach + push)\n",
)
DRAWN = (
    "(2 * torch.rand((b, 2)) - 1)",
    "torch.tensor(np.array([np.random.RandomState(s).uniform(-1, 1, 2) for s in self._episode_seed[env_idx.cpu().numpy()]])).float()",
)
"""Drawn for each env alone, so that it does not depend on the other envs of the batch."""
SHORT = "max_episode_steps=50", "max_episode_steps=9"
SEEDS = [100, 101, 102, 103, 104]
ENDS = [seed % 7 + 1 for seed in SEEDS]


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LoadedTask]:
    text = EXAMPLE.read_text()
    for old, new in (END, SEED, NAN, DRAWN, SHORT):
        assert old in text
        text = text.replace(old, new)
    file: Path = tmp_path_factory.mktemp("episodes") / "ends.py"
    file.write_text(text)
    made = load_task(str(file))
    yield made
    undo_load(made)


class Turns:
    """Turns joint k at full speed in episode k, each for its own number of steps."""

    kind, seeds, lengths = "given", SEEDS, (2, 4, 1, 3, 5)

    def __init__(self, checkup: Checkup) -> None:
        self.checkup = checkup
        self.begun: Sequence[int] = ()

    def begin(self, task: TaskEnv, episodes: Sequence[int]) -> StepResult:
        self.begun = episodes
        return self.checkup.reset(task, [SEEDS[k] for k in episodes])

    def next_action(self, task: TaskEnv, step: int) -> NDArray[np.float32]:
        return np.stack([self.action(k, step) for k in self.begun])

    @staticmethod
    def action(k: int, step: int) -> NDArray[np.float32]:
        made = np.zeros(8, np.float32)
        made[k] = 1 if step % 2 == 0 else -0.5
        return made


@pytest.fixture(scope="module")
def checkup(loaded: LoadedTask) -> Iterator[Checkup]:
    """Two envs for five seeds, so that the last batch has an env without an episode."""
    made = Checkup(
        loaded,
        {"render_backend": "none", "robot_init_qpos_noise": 0},
        num_envs=2,
        seeds=len(SEEDS),
        first_seed=SEEDS[0],
    )
    made.actors = (Turns(made),)
    yield made
    made.close()


def same(episodes: Episodes, k: int, step: int, result: StepResult, task: TaskEnv) -> None:
    np.testing.assert_array_equal(episodes.poses[step, k], result.poses[0])
    assert episodes.qpos is not None and result.qpos is not None
    np.testing.assert_array_equal(episodes.qpos[step, k], result.qpos[0])
    for name in ("success", "fail", "cube_to_goal"):
        assert episodes.evaluate[name][step, k] == result.evaluate[name][0]
    for name, rows in read_obs(task).items():
        np.testing.assert_array_equal(episodes.obs[name][step, k], rows[0])


def test_each_episode_is_that_of_one_env_with_its_seed_and_its_actions(checkup: Checkup) -> None:
    (acted,) = checkup.acted
    starts, still = checkup.starts, checkup.still
    assert acted.seeds == starts.seeds == still.seeds == checkup.random.seeds == SEEDS
    assert acted.reward.shape == (5, 5) and len(starts.poses) == 1
    assert acted.length.tolist() == [
        min(end, length) for end, length in zip(ENDS, Turns.lengths, strict=True)
    ]
    with checkup.env(1) as task:
        for k, seed in enumerate(SEEDS):
            result = task.reset(seed)
            for episodes in (acted, starts, still):
                same(episodes, k, 0, result, task)
            for step in range(Turns.lengths[k]):
                result = task.step(Turns.action(k, step)[None])
                same(acted, k, step + 1, result, task)
                assert np.array_equal(acted.reward[step, k], result.reward[0], equal_nan=True)
            # From the end of the actions on, the last state is repeated.
            same(acted, k, 5, result, task)
            assert np.array_equal(acted.reward[4, k], result.reward[0], equal_nan=True)
            task.reset(seed)
            action = hold_action(task.parts, 1)
            for _ in range(len(still.poses) - 1):
                result = task.step(action)
            same(still, k, len(still.poses) - 1, result, task)
    assert len(still.poses) - 1 == 20, "a second of steps of 50 ms"


def test_an_outlier_counts_once_until_its_episode_ends(checkup: Checkup) -> None:
    random = checkup.random
    assert random.length.tolist() == ENDS and len(random.reward) == 9
    nan = [one for one in random.outliers if one.kind is OutlierKind.REWARD_NOT_FINITE]
    first = {seed: seed % 3 or 3 for seed in SEEDS}
    # At the step that ends it an episode still counts as running before, not after.
    expected = {seed: step for seed, step in first.items() if step < seed % 7 + 1}
    assert {one.seed: one.step for one in nan} == expected and len(nan) == len(expected)


def test_overlaps_and_poses_are_those_of_the_seeds(checkup: Checkup) -> None:
    assert list(checkup.overlaps) == SEEDS, "a seed that only fills the batch is left out"
    rows = [each for each in checkup.placed if each.name == "cube"]
    assert [len(each.quaternions) for each in rows] == [2]
    assert rows[0].place is not None and rows[0].place[2] == "_initialize_episode"

"""``workbench record --actions solve``: planned episodes are the same on any number of envs and processes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from workbench.episodes.reader.read_episode import read_episode
from workbench.planning.options import PlanOptions
from workbench.record.job import Recorded, record
from workbench.record.job_worker import RecordOptions
from workbench.task.description import TaskOptions
from workbench.task.problem import TaskError

pytestmark = pytest.mark.usefixtures("child_process")


PLANNED = RecordOptions(
    "PushCube-v1",
    episodes=3,
    actions="solve",
    pictures=False,
    max_steps=3,
    plan=PlanOptions(rollouts=8, horizon=0.2),
    options=TaskOptions(
        num_envs=2, seed=10, env_kwargs={"render_backend": "none", "control_mode": "pd_ee_delta_pose"}
    ),
)


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record(replace(PLANNED, out=tmp_path_factory.mktemp("planned")))


def test_an_episode_records_its_planner_and_its_rollouts_returns(planned: Recorded) -> None:
    for written in planned.written:
        episode, of_plans = read_episode(written.path), written.planned
        assert episode.info.acted_by == ((0, "solve (mppi, 8 rollouts of 4 steps)"),)
        assert of_plans is not None and (of_plans.seed, of_plans.steps, of_plans.horizon) == (
            written.seed,
            3,
            4,
        )
        np.testing.assert_allclose(of_plans.reward, episode.reward, rtol=1e-6)
        assert (of_plans.best >= of_plans.hold).all() and (of_plans.hold >= of_plans.worst).all()
        assert of_plans.evaluate == {"success": 0.0}
    assert not np.array_equal(
        read_episode(planned.written[0].path).action, read_episode(planned.written[1].path).action
    )


@pytest.mark.parametrize(("num_envs", "workers"), [(1, 1), pytest.param(3, 2, marks=pytest.mark.slow)])
def test_planned_episodes_are_the_same_on_any_number_of_envs_and_processes(
    planned: Recorded, num_envs: int, workers: int, tmp_path: Path
) -> None:
    options = replace(PLANNED.options, num_envs=num_envs)
    again = record(replace(PLANNED, out=tmp_path, workers=workers, options=options))
    for one, other in zip(planned.written, again.written, strict=True):
        assert one.path.with_suffix(".h5").read_bytes() == other.path.with_suffix(".h5").read_bytes()
        assert one.planned is not None and other.planned is not None
        np.testing.assert_array_equal(one.planned.best, other.planned.best)


@pytest.mark.slow
def test_after_success_sets_how_long_an_episode_continues(tmp_path: Path) -> None:
    easy = tmp_path / "easy.py"
    easy.write_text(
        "from mani_skill.envs.tasks import PushCubeEnv\n"
        "from mani_skill.utils.registration import register_env\n\n\n"
        "@register_env('EasyPlan-v1', max_episode_steps=9)\n"
        "class EasyEnv(PushCubeEnv):\n"
        "    def evaluate(self):\n"
        "        return {'success': self.elapsed_steps >= 2}\n"
    )
    what = replace(PLANNED, task=str(easy), out=tmp_path / "out", max_steps=None, episodes=1)
    steps = [record(replace(what, after_success=count)).written[0].steps for count in (0, 3, 50)]
    assert steps == [2, 5, 9]


def test_an_error_in_a_rollout_is_reported_at_its_line(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.py"
    wrong.write_text(
        "from mani_skill.envs.tasks import PushCubeEnv\n"
        "from mani_skill.utils.registration import register_env\n\n\n"
        "@register_env('WrongPlan-v1', max_episode_steps=9)\n"
        "class WrongEnv(PushCubeEnv):\n"
        "    def compute_normalized_dense_reward(self, obs, action, info):\n"
        "        if self.num_envs == 8:\n"
        "            raise RuntimeError('no reward')\n"
        "        return super().compute_normalized_dense_reward(obs, action, info)\n"
    )
    with pytest.raises(TaskError, match="no reward") as raised:
        record(replace(PLANNED, task=str(wrong), out=tmp_path / "out"))
    assert (raised.value.problem.file, raised.value.problem.line) == (str(wrong), 9)

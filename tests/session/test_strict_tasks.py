"""The GPU's rules in the workbench: told with the author's file and line, and only told of installed tasks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.pose import Pose

from workbench.authoring.problem import Problem, TaskError
from workbench.core.strict import RuleWarning
from workbench.session.messages import TaskOptions
from workbench.session.open_task import open_task

TASK = """
import torch
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.pose import Pose


@register_env("StrictTaskOfATest-v1", max_episode_steps=50, override=True)
class PickCubeOfATest(PickCubeEnv):
{body}
"""
LOST = """
    def _before_control_step(self):
        self.lift()

    def lift(self):
        self.cube.set_pose(Pose.create_from_pq(torch.rand((self.num_envs, 3))))  # the fault
"""
BEHIND = """
    def _initialize_episode(self, env_idx, options):
        super()._initialize_episode(env_idx, options)
        for entity in self.cube._objs:
            entity.set_pose(self.cube.initial_pose.sp)  # the fault
"""
NEIGHBOURS = """
    def _initialize_episode(self, env_idx, options):  # the fault
        super()._initialize_episode(env_idx, options)
        self.target = torch.rand((len(env_idx), 3))
"""
REWARD = """
    def compute_dense_reward(self, obs, action, info):  # the fault
        return super().compute_dense_reward(obs, action, info)[:, None]
"""
OBSERVATION = """
    def _get_obs_extra(self, info):  # the fault
        return {"goal": self.goal_site.pose.p[0]}
"""


def opened(reference: str) -> Iterator[None]:
    options = TaskOptions(
        num_envs=4, backend="cpu", env_kwargs={"obs_mode": "state", "render_backend": "none"}
    )
    task = open_task(reference, options)
    yield
    task.env.close()


def problem_of(body: str, tmp_path: Path) -> tuple[Problem, str]:
    file = tmp_path / "task.py"
    file.write_text(TASK.format(body=body))
    with pytest.raises(TaskError) as caught:
        next(opened(str(file)))
    return caught.value.problem, str(file.resolve())


@pytest.mark.parametrize(
    ("body", "stage", "words"),
    [
        (LOST, "step", "The pose of 'cube' in envs 0, 1, 2, 3 was set and not applied"),
        (BEHIND, "reset", "goes behind the tensors"),
        (NEIGHBOURS, "reset", "left self.target with a row for each of the 1 envs"),
        (REWARD, "returns", "compute_dense_reward() returned a float32 tensor of shape (4, 1)"),
        (OBSERVATION, "returns", "_get_obs_extra() returned 'goal' as a float32 tensor of shape (3,)"),
    ],
)
def test_a_broken_rule_is_told_at_the_authors_line(body: str, stage: str, words: str, tmp_path: Path) -> None:
    problem, file = problem_of(body, tmp_path)
    assert words in problem.message
    assert (problem.stage, problem.file) == (stage, file)
    assert "# the fault" in (problem.code or ""), problem


def test_an_installed_task_that_breaks_a_rule_is_shown_all_the_same() -> None:
    @register_env("InstalledTaskOfATest-v1", override=True)
    class Lost(PickCubeEnv):
        def _before_control_step(self) -> None:
            self.cube.set_pose(Pose.create_from_pq(torch.rand((self.num_envs, 3))))

    with pytest.warns(RuleWarning, match="The pose of 'cube' in envs 0, 1, 2, 3 was set and not applied"):
        for _ in opened("InstalledTaskOfATest-v1"):
            pass

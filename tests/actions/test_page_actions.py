"""The actions that the page chooses: sliders, and a policy that is mended while it acts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.drive.envs import batched
from workbench.actions.choose import ActionChooser
from workbench.envs.action_vector import hold_action
from workbench.envs.task_env import TaskEnv
from workbench.machine.folders import CurrentFolder
from workbench.task.problem import TaskError

N = 2


@pytest.fixture(scope="module")
def task() -> Iterator[TaskEnv]:
    env = batched("PushCube-v1", N, control_mode="pd_joint_pos")
    task = TaskEnv(env, 50)
    task.reset(seed=0)
    yield task
    env.close()


@pytest.fixture
def chooser() -> ActionChooser:
    return ActionChooser(CurrentFolder())


def test_an_env_that_is_told_to_hold_still_or_was_reset_forgets_its_joint_targets(
    task: TaskEnv, chooser: ActionChooser
) -> None:
    chooser.use("sliders", None)
    still = hold_action(task.parts, N)
    for forget in (lambda: chooser.set_sliders(task, [1], [], []), lambda: chooser.begin([1])):
        chooser.set_sliders(task, [0, 1], [0], [0.25])
        assert chooser.next_action(task)[:, 0].tolist() == [0.25, 0.25]
        forget()
        action = chooser.next_action(task)
        assert action[0, 0] == 0.25
        np.testing.assert_array_equal(action[1], still[1])


def test_a_policy_that_raised_is_imported_again_for_the_next_action(
    task: TaskEnv, chooser: ActionChooser, tmp_path: Path, clean_process: None
) -> None:
    file = tmp_path / "own_policy.py"
    file.write_text("def act(obs):\n    raise ValueError('not yet')\n")
    chooser.use("policy", f"{file}:act")
    with pytest.raises(TaskError, match="not yet"):
        chooser.next_action(task)
    file.write_text("import numpy as np\n\n\ndef act(obs):\n    return np.full((2, 8), 0.5)\n")
    np.testing.assert_array_equal(chooser.next_action(task), np.full((N, 8), 0.5))

"""The actions that the page chooses: sliders, and a policy that is fixed while it acts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.drive.envs import batched
from workbench.actions.choose import ActionChooser, RecordActionChooser, plain_chooser
from workbench.envs.action_vector import bounds, hold_action
from workbench.envs.recorded_run import RecordedRun
from workbench.envs.task_env import TaskEnv
from workbench.machine.folders import CurrentFolder
from workbench.task.problem import TaskError

N = 2


def task_with(control_mode: str) -> Iterator[TaskEnv]:
    env = batched("PushCube-v1", N, control_mode=control_mode)
    task = TaskEnv(env, 50)
    task.reset(seed=0)
    yield task
    env.close()


@pytest.fixture(scope="module")
def task() -> Iterator[TaskEnv]:
    yield from task_with("pd_joint_pos")


@pytest.fixture(scope="module")
def deltas() -> Iterator[TaskEnv]:
    """A task whose arm takes deltas, and whose gripper takes targets."""
    yield from task_with("pd_joint_delta_pos")


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


# --- sources ---------------------------------------------------------------------------------------------


def test_each_source_has_its_name_and_its_action(task: TaskEnv, chooser: ActionChooser) -> None:
    low, high = bounds(task.parts)
    chooser.use("zero", None)
    assert chooser.name == "zero" and (high < 0).any(), "zero is out of some joint's limits"
    np.testing.assert_array_equal(chooser.next_action(task), [np.clip(0, low, high)] * N)
    chooser.use("hold", None)
    assert chooser.name == "hold still"
    np.testing.assert_array_equal(chooser.next_action(task), hold_action(task.parts, N))
    chooser.use("random", None)
    drawn = []
    for seed in (1, 2, 1):
        chooser.seed(seed)
        drawn.append((chooser.fresh_seeds(3), chooser.next_action(task).tolist()))
    assert drawn[0] == drawn[2] != drawn[1] and len(set(drawn[0][0])) == 3
    action = np.array(drawn[0][1])
    assert (action[0] != action[1]).any() and (low <= action).all() and (action <= high).all()
    chooser.use("policy", "", None)
    with pytest.raises(TaskError):
        chooser.next_action(task)


def test_a_slider_sets_its_own_dimension_in_its_own_envs_within_the_bounds(
    deltas: TaskEnv, chooser: ActionChooser
) -> None:
    """The arm's value stays until it is set again; the gripper's target is overwritten by each action."""
    low, high = bounds(deltas.parts)
    arm, gripper = 0, len(low) - 1
    chooser.use("sliders", None)
    assert chooser.by_sliders
    still, expected = hold_action(deltas.parts, N), hold_action(deltas.parts, N)

    def assert_acts_as_expected() -> None:
        np.testing.assert_allclose(chooser.next_action(deltas), expected, rtol=1e-6)

    chooser.set_sliders(deltas, [1], [arm, gripper], [0.02, 0.5])
    expected[1, [arm, gripper]] = np.clip([0.02, 0.5], low[[arm, gripper]], high[[arm, gripper]])
    assert_acts_as_expected()
    chooser.set_sliders(deltas, [0], [arm], [9.0])
    expected[0, arm] = high[arm]
    assert_acts_as_expected()
    acted = np.full((N, len(low)), 0.01, np.float32)
    chooser.acted(acted)
    expected[:, gripper] = acted[:, gripper]
    assert_acts_as_expected()
    acted[:] = 9.0  # the chooser must not keep the caller's array
    assert_acts_as_expected()
    chooser.begin([0], {1: np.full(len(low), 0.02, np.float32)})
    expected[0, gripper], expected[1, gripper] = still[0, gripper], 0.02
    assert_acts_as_expected()
    chooser.begin(None)
    expected[:, gripper] = still[:, gripper]
    assert_acts_as_expected()
    chooser.set_sliders(deltas, [1], [], [])
    expected[1] = still[1]
    assert_acts_as_expected()
    for forget in (chooser.new_scene, lambda: chooser.use("sliders", None)):
        chooser.set_sliders(deltas, [0], [arm], [0.02])
        forget()
        assert (chooser.next_action(deltas)[:, arm] == still[:, arm]).all()


@pytest.mark.parametrize(
    ("text", "name", "line"),
    [
        ("import policy_helper\ndef act(obs):\n    return policy_helper.fails()\n", "policy_helper.py", 2),
        ("\ndef act(obs):\n    return obs[:, :3]\n", "own_policy.py", 2),
        ("def act(obs):\n    return (\n", "own_policy.py", 2),
        ("x = 1\nx.nothing\n", "own_policy.py", 2),
    ],
)
def test_a_failure_of_a_policy_is_at_the_authors_line_and_its_next_save_acts(
    task: TaskEnv,
    chooser: ActionChooser,
    tmp_path: Path,
    clean_process: None,
    text: str,
    name: str,
    line: int,
) -> None:
    (tmp_path / "policy_helper.py").write_text("def fails():\n    return 1 / 0\n")
    file = tmp_path / "own_policy.py"
    file.write_text(text)
    with pytest.raises(TaskError) as failed:
        chooser.use("policy", f"{file}:act")
        chooser.next_action(task)
    problem = failed.value.problem
    assert (problem.stage, problem.file, problem.line) == ("policy", str(tmp_path / name), line)
    file.write_text("import numpy as np\n\n\ndef act(obs):\n    return np.full(8, 0.5)\n")
    np.testing.assert_array_equal(chooser.next_action(task), np.full((N, 8), 0.5))
    assert chooser.name == f"policy {file}:act"


# --- recordings of the terminal --------------------------------------------------------------------------


def test_each_recorded_episode_has_the_actions_of_its_own_seed_or_run(task: TaskEnv) -> None:
    chooser, still = RecordActionChooser(None), hold_action(task.parts, N)
    assert (chooser.begin(0, 5, None), chooser.begin(1, 6, None)) == ("random", "random")
    first = chooser.next_action(task, {0: 0, 1: 0})
    assert (first[0] != first[1]).any()
    chooser.begin(1, 5, None)
    np.testing.assert_array_equal(chooser.next_action(task, {1: 0}), [still[0], first[0]])
    run = RecordedRun("the run", 5, {}, np.arange(24, dtype=np.float32).reshape(3, 8), {})
    assert chooser.begin(0, 5, run) == "the run"
    np.testing.assert_array_equal(chooser.next_action(task, {0: 2}), [run.action[2], still[1]])
    narrow = replace(run, action=run.action[:, :7])
    chooser.begin(0, 5, narrow)
    with pytest.raises(ValueError, match="7"):
        chooser.next_action(task, {0: 0})
    chooser.begin(0, 5, None)
    np.testing.assert_array_equal(chooser.next_action(task, {0: 0})[0], first[0])
    chooser.end(0)
    np.testing.assert_array_equal(chooser.next_action(task, {}), still)


def test_a_policy_of_a_recording_acts_only_in_envs_with_an_episode(
    task: TaskEnv, tmp_path: Path, clean_process: None
) -> None:
    file = tmp_path / "own_policy.py"
    file.write_text("import numpy as np\n\n\ndef act(obs):\n    return np.arange(16.0).reshape(2, 8)\n")
    chooser = RecordActionChooser(plain_chooser(f"{file}:act", "PushCube-v1", 0, CurrentFolder()))
    assert chooser.begin(1, 5, None) == f"policy {file}:act"
    still = hold_action(task.parts, N)
    np.testing.assert_array_equal(chooser.next_action(task, {1: 0}), [still[0], np.arange(8, 16)])
    assert plain_chooser("hold", "PushCube-v1", 0, CurrentFolder()).name == "hold still"
    seeds = [plain_chooser("zero", "PushCube-v1", seed, CurrentFolder()).fresh_seeds(2) for seed in (1, 2, 1)]
    assert seeds[0] == seeds[2] != seeds[1]

"""Valid and invalid return values of the hooks of a step, and the messages for the invalid ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from workbench.envs.evaluate_entries import wrong_reward
from workbench.task.load import LoadedTask, load_task
from workbench.task.problem import Problem, check_step_returns

pytestmark = pytest.mark.thorough

Write = Callable[..., Path]
N = 4
YES = torch.ones(N, dtype=torch.bool)


class Mute:
    def __repr__(self) -> str:
        raise ValueError("nothing to be said")


TASK = """
def noted(function):
    return function

class PushEnv(BaseEnv):
    @noted
    def evaluate(self):
        pass

    def compute_dense_reward(self, obs, action, info):
        pass
"""


@pytest.fixture
def task(write: Write) -> LoadedTask:
    return load_task(str(write("push.py", TASK, task=True)))


def check(task: LoadedTask, evaluate: object, reward: object = None, num_envs: int = N) -> Problem | None:
    return check_step_returns(task.cls, num_envs, evaluate, reward, task.source_files)


@pytest.mark.parametrize(
    ("evaluate", "reward"),
    [
        ({}, None),
        ({"success": YES, "fail": ~YES, "distance": torch.rand(N, 3)}, torch.ones(N)),
        ({"success": YES}, YES.clone()),  # ManiSkill's own sparse reward
        # A rule reports this; the task can still be shown.
        ({"success": YES.float(), "fail": YES.int()}, torch.zeros(N)),
        ({"parts": {"arm": torch.zeros(N, 2)}, "instruction": "push"}, None),
        # Only success and fail must have a row per env.
        ({"best": None, "stage": 2, "distance": 0.5, "progress": torch.tensor(0.5)}, None),
        ({"goal": torch.zeros(3, N), "parts": {"arm": torch.zeros(1), 7: object()}, 1: YES}, torch.zeros(N)),
        ({"reward_terms": {"reach": torch.tensor(0.5), "push": None}}, torch.zeros(N)),
    ],
)
def test_values_that_upstream_accepts_are_accepted(evaluate: dict, reward: object, task: LoadedTask) -> None:
    assert check(task, evaluate, reward) is None


@pytest.mark.parametrize(
    ("evaluate", "words"),
    [
        (None, "returned None; it must return a dict"),
        (YES, "bool tensor of shape (4,); it must return a dict"),
        ({"success": True}, "'success' as bool (True)"),
        ({"success": YES[:3]}, "shape (3,); expected a bool tensor of shape (4,)"),
        ({"note": "x", "fail": None}, "'fail' as None"),
        ({"fail": Mute()}, "'fail' as Mute (<Mute, whose repr raises ValueError>)"),
    ],
)
def test_a_wrong_result_of_evaluate_is_reported_at_its_def(
    evaluate: object, words: str, task: LoadedTask
) -> None:
    problem = check(task, evaluate, torch.zeros(N))
    assert problem is not None
    assert problem.message.startswith("evaluate() returned ") and words in problem.message
    assert (problem.stage, problem.file, problem.code) == ("returns", str(task.file), "def evaluate(self):")


@pytest.mark.parametrize(
    ("reward", "words"),
    [
        (0.5, "float (0.5)"),
        (torch.tensor(0.5), "shape ()"),
        (torch.zeros(N, 1), "shape (4, 1)"),
        (torch.zeros(N, N), "shape (4, 4)"),
        (np.zeros(N), "numpy float64 array"),
        (torch.zeros(N, dtype=torch.complex64), "complex64"),
    ],
)
def test_a_wrong_reward_is_reported_at_its_def(reward: object, words: str, task: LoadedTask) -> None:
    problem = check(task, {"success": YES}, reward)
    assert problem is not None
    assert words in problem.message
    assert problem.code == "def compute_dense_reward(self, obs, action, info):"
    assert problem.message.startswith("compute_dense_reward() returned ")


def test_a_subclass_in_front_of_the_tasks_class_hides_no_problem(task: LoadedTask) -> None:
    batched = type("Batched", (task.cls,), {})
    problem = check_step_returns(batched, N, None, None, task.source_files)
    assert problem is not None and problem.code == "def evaluate(self):"


shapes = st.lists(st.integers(0, 5), max_size=3).map(tuple)
dtypes = st.sampled_from([torch.bool, torch.int32, torch.float32, torch.float64])


@pytest.mark.parametrize(
    ("body", "line"),
    [
        ("return (\n    None\n)", "return ("),
        ("if info:\n    def score():\n        return 1\n    return score()", "return score()"),
        ("if info:\n    return 0\nreturn 1", "def compute_dense_reward(self, obs, action, info):"),
    ],
)
def test_the_line_of_a_wrong_value_is_the_only_return(body: str, line: str, write: Write) -> None:
    text = TASK[: TASK.rindex("pass")] + body.replace("\n", "\n        ") + "\n"
    problem = check(load_task(str(write("push.py", text, task=True))), {}, 0.5)
    assert problem is not None and problem.code == line


@given(shape=shapes, dtype=dtypes, num_envs=st.integers(1, 5))
def test_exactly_the_batched_shapes_pass(shape: tuple[int, ...], dtype: torch.dtype, num_envs: int) -> None:
    value = torch.zeros(shape, dtype=dtype)
    # With one env, a single number counts as its row, as in ManiSkill; a rule reports it in another shape.
    a_row_each = shape == (num_envs,) or value.numel() == num_envs == 1
    passes = {
        key: check_step_returns(object, num_envs, {key: value}, None, ()) is None
        for key in ("success", "other")
    }
    assert passes == {"success": a_row_each and not dtype.is_complex, "other": True}
    reward = check_step_returns(object, num_envs, {}, value, ()) is None
    assert reward == a_row_each
    refused = wrong_reward(value, num_envs, {}) is not None
    assert refused == (not a_row_each or not dtype.is_floating_point or len(shape) > 1)

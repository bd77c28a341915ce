"""A partial reset that rewrites other envs' rows in a task's attributes is reported at the assignment's line."""

# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import linecache
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.structs.pose import Pose

from tests.drive.envs import PICK_CUBE, batched
from tests.envs import draws_goals
from workbench.envs.broken_rule import BrokenRule
from workbench.envs.gpu_rules import Finding
from workbench.envs.hot_swap import put_class

pytestmark = pytest.mark.thorough

N = 3
ACTION = np.zeros((N, 8), np.float32)
Reset = Callable[[Any, torch.Tensor], None]


def task_with(initializes: Reset, **members: Any) -> type[BaseEnv]:
    def initialize(self: Any, env_idx: torch.Tensor, options: dict) -> None:
        PICK_CUBE._initialize_episode(self, env_idx, options)
        initializes(self, env_idx)

    return type("Draws", (PICK_CUBE,), {"_initialize_episode": initialize, **members})


def found_in(task: type[BaseEnv], rules: Any = "warn", resets: int = 1) -> list[Finding]:
    """Return the findings of a reset, a step and partial resets of env 1."""
    reported: list[Finding] = []
    env = batched(task, N, rules=rules, on_finding=reported.append, obs_mode="none")
    try:
        env.reset(seed=[0, 1, 2])
        env.step(ACTION)
        for _ in range(resets):
            env.reset(options={"env_idx": torch.tensor([1])})
        rows = list(env.broken_rules.rows)
        assert [row.message for row in rows] == [row.message for row in reported]
        return rows
    finally:
        env.close()


def is_at_fault(finding: Finding) -> bool:
    assert finding.file is not None and finding.line is not None
    return "# the fault" in linecache.getline(finding.file, finding.line)


# --- ways to make the mistake --------------------------------------------------------------------------


def whole_tensor(self: Any, env_idx: torch.Tensor) -> None:
    self.target = torch.rand((self.num_envs, 2))  # the fault


def in_place(self: Any, env_idx: torch.Tensor) -> None:
    if not hasattr(self, "target"):
        self.target = torch.zeros((self.num_envs, 2))
    self.target[:] = torch.rand((self.num_envs, 2))  # the fault


def value_from_a_helper(self: Any, env_idx: torch.Tensor) -> None:
    def draw() -> torch.Tensor:
        drawn = torch.rand((self.num_envs, 2))
        return drawn * 2

    self.target = draw()  # the fault
    self.unrelated = len(env_idx)


def in_another_file(self: Any, env_idx: torch.Tensor) -> None:
    draws_goals.draw(self)


@dataclass
class Memory:
    """An object of the author's that holds tensors."""

    target: torch.Tensor | None = None
    deeper: dict[str, Any] = field(default_factory=dict)


def in_a_dict_of_an_object(self: Any, env_idx: torch.Tensor) -> None:
    if not hasattr(self, "memory"):
        self.memory = Memory()
    self.memory.deeper["goal"] = [torch.rand((self.num_envs, 2))]  # the fault


def one_tensor_an_env(self: Any, env_idx: torch.Tensor) -> None:
    self.targets = [torch.rand(2) for _ in range(self.num_envs)]  # the fault


def numpy_in_place(self: Any, env_idx: torch.Tensor) -> None:
    if not hasattr(self, "target"):
        self.target = np.zeros(self.num_envs, dtype=np.int64)
    self.target += 1  # the fault


def by_a_property(self: Any, env_idx: torch.Tensor) -> None:
    self.goal = torch.rand((self.num_envs, 2))


def _set_goal(self: Any, goal: torch.Tensor) -> None:
    self._kept_goal = goal  # the fault


def in_a_pose(self: Any, env_idx: torch.Tensor) -> None:
    self.target_pose = Pose.create_from_pq(torch.rand((self.num_envs, 3)))  # the fault


def in_a_plain_list(self: Any, env_idx: torch.Tensor) -> None:
    self.stages = [torch.rand(()).item() for _ in range(self.num_envs)]  # the fault


def restored_and_overwritten(self: Any, env_idx: torch.Tensor) -> None:
    if not hasattr(self, "target"):
        self.target = torch.zeros(self.num_envs)
    kept = self.target
    self.target = torch.rand(self.num_envs)
    self.target = kept
    self.target = torch.rand(self.num_envs)  # the fault


MISTAKES = [
    (whole_tensor, "self.target is"),
    (in_place, "self.target is"),
    (value_from_a_helper, "self.target is"),
    (in_another_file, "self.target is"),
    (in_a_dict_of_an_object, "self.memory.deeper['goal'][0] is"),
    (one_tensor_an_env, "self.targets[i] is"),
    (numpy_in_place, "self.target is"),
    (by_a_property, "self._kept_goal is"),
    (in_a_pose, "self.target_pose is"),
    (in_a_plain_list, "self.stages is"),
    (restored_and_overwritten, "self.target is"),
]


@pytest.mark.parametrize(("reset", "named"), MISTAKES, ids=[reset.__name__ for reset, _ in MISTAKES])
def test_changed_rows_of_other_envs_are_reported_at_the_assignment(reset: Reset, named: str) -> None:
    task = task_with(reset, goal=property(lambda self: self._kept_goal, _set_goal))
    (finding,) = found_in(task, rules=None)
    assert finding.rule == "rows-rewritten" and finding.degree == "warn"
    assert finding.message.startswith(f"{named} changed in envs 0, 2, which are not being reset"), finding
    assert is_at_fault(finding), finding


def shrinks(self: Any, env_idx: torch.Tensor) -> None:
    self.target = torch.rand((len(env_idx), 2))  # the fault


def shrinks_in_a_list(self: Any, env_idx: torch.Tensor) -> None:
    self.goals = [0.0 for _ in env_idx]  # the fault


@pytest.mark.parametrize("reset", [shrinks, shrinks_in_a_list])
def test_lost_rows_of_other_envs_stop_at_the_assignment(reset: Reset) -> None:
    with pytest.raises(BrokenRule, match="now has rows for only 1 of") as caught:
        found_in(task_with(reset), rules=None)
    assert caught.value.rule == "rows-lost" and caught.value.place is not None
    assert "# the fault" in linecache.getline(*caught.value.place[:2])
    assert caught.traceback[-1].frame.code.raw.co_filename == __file__
    (finding,) = found_in(task_with(reset), rules="warn")
    assert is_at_fault(finding)


def draws_before(self: Any, seed: Any = None, options: Any = None) -> Any:
    self.target = torch.rand((self.num_envs, 2))  # the fault
    return PICK_CUBE.reset(self, seed=seed, options=options)


def draws_after(self: Any, seed: Any = None, options: Any = None) -> Any:
    result = PICK_CUBE.reset(self, seed=seed, options=options)
    self.target = torch.rand((self.num_envs, 2))  # the fault
    return result


@pytest.mark.parametrize("reset", [draws_before, draws_after])
def test_a_task_that_overrides_reset_is_checked_too(reset: Callable[..., Any]) -> None:
    task = type("Draws", (PICK_CUBE,), {"reset": reset})
    (finding,) = found_in(task)
    assert finding.rule == "rows-rewritten" and is_at_fault(finding), finding


# --- no mistake ------------------------------------------------------------------------------


def writes_its_rows(self: Any, env_idx: torch.Tensor) -> None:
    if not hasattr(self, "target"):
        self.target = torch.zeros((self.num_envs, 2))
        self.stages = ["reach"] * self.num_envs
    self.target[env_idx] = torch.rand((len(env_idx), 2))
    for i in env_idx.tolist():
        self.stages[i] = "reach"


def assigns_equal_values(self: Any, env_idx: torch.Tensor) -> None:
    self.distance = (self.cube.pose.p - self.goal_site.pose.p).norm(dim=1) * 0 + 1
    self.unknown = torch.full((self.num_envs,), torch.nan)
    self.names = np.array(["a"] * self.num_envs)
    self.finished = np.full(self.num_envs, np.datetime64("NaT"))
    self.stages = [float("0.5"), float("nan"), "a"]


def restores_other_rows(self: Any, env_idx: torch.Tensor) -> None:
    kept = getattr(self, "target", torch.zeros(self.num_envs))
    self.target = torch.rand(self.num_envs)
    others = torch.ones(self.num_envs, dtype=torch.bool)
    others[env_idx] = False
    self.target[others] = kept[others]


def counts_for_the_batch(self: Any, env_idx: torch.Tensor) -> None:
    self.resets = getattr(self, "resets", 0) + 1
    self.last_drawn = torch.rand(7)
    # One row per env in the first resets, then a length unrelated to the batch.
    self.queue = torch.rand(self.num_envs if self.resets < 3 else 7)


@pytest.mark.parametrize(
    "reset", [writes_its_rows, assigns_equal_values, restores_other_rows, counts_for_the_batch]
)
def test_unchanged_rows_of_other_envs_are_not_reported(reset: Reset) -> None:
    assert found_in(task_with(reset), resets=2) == []


def test_attributes_that_evaluate_sets_for_all_envs_are_not_reported() -> None:
    def evaluate(self: Any) -> dict:
        self.distance = torch.rand(self.num_envs)
        return PICK_CUBE.evaluate(self)

    def reset(self: Any, seed: Any = None, options: Any = None) -> Any:
        return PICK_CUBE.reset(self, seed=seed, options=options)

    assert found_in(task_with(writes_its_rows, evaluate=evaluate, reset=reset)) == []


# --- lines -------------------------------------------------------------------------------------------


@pytest.fixture
def traced() -> Iterator[None]:
    """Install a trace function, as a debugger does."""
    before = sys.gettrace()
    sys.settrace(lambda frame, event, argument: None)
    yield
    sys.settrace(before)


def test_a_debuggers_trace_stays_and_the_line_comes_from_the_source(traced: None) -> None:
    trace = sys.gettrace()
    (finding,) = found_in(DrawsInMethods)
    assert sys.gettrace() is trace
    assert is_at_fault(finding) and finding.function == "draw_target"


class DrawsInMethods(PICK_CUBE):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.target = torch.zeros(N)
        super().__init__(*args, **kwargs)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        self.draw_target()

    def draw_target(self) -> None:
        self.other, self.target = 0, torch.rand(N)  # the fault


def test_a_row_that_the_first_reset_did_not_change_gets_its_line_later() -> None:
    def reset(self: Any, env_idx: torch.Tensor) -> None:
        self.calls = getattr(self, "calls", 0) + 1
        setattr(self, "targ" + "et", torch.full((self.num_envs,), max(self.calls - 3, 0)))  # the fault

    # The constructor's reset and the first reset all envs; the first partial reset changes nothing.
    (finding,) = found_in(task_with(reset), resets=3)
    assert finding.count == 2 and is_at_fault(finding), finding


def test_the_lines_of_an_edited_task_are_found_again() -> None:
    """A reload puts another class on the env."""
    env = batched(
        task_with(writes_its_rows), N, rules="warn", on_finding=lambda finding: None, obs_mode="none"
    )
    for _ in range(5):
        env.reset(options={"env_idx": torch.tensor([1])})
    put_class(env, task_with(whole_tensor))
    env.reset(options={"env_idx": torch.tensor([1])})
    (finding,) = env.broken_rules.rows
    assert is_at_fault(finding) and finding.function == "whole_tensor", finding
    env.close()


def test_line_tracing_of_long_resets_is_bounded() -> None:
    def reset(self: Any, env_idx: torch.Tensor) -> None:
        total = 0
        for i in range(20_000):
            total += i
        self.target = torch.rand(self.num_envs)

    (finding,) = found_in(task_with(reset, total=0))
    assert finding.line is not None and finding.file == __file__

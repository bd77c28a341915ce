"""The line of a task that assigns an attribute or names an entry, also if several do."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

from __future__ import annotations

import inspect
from typing import Any

import pytest
import torch
from mani_skill.envs.sapien_env import BaseEnv

from workbench.envs.broken_rule import find_assignment, find_entry, place_of_class, place_of_return


class Above(BaseEnv):
    def __init__(self) -> None:
        self.in_the_base = 0

    def helper(self) -> None:
        self.in_the_base = 1  # in_the_base


class Task(Above):
    def __init__(self) -> None:
        self.several, self.built, self.only_built = 0, 0, 0

    def _load_scene(self, options: dict) -> None:
        self.built = 1

    def evaluate(self) -> dict:
        self.several = 2
        self.built += 1  # built
        both = {"success": self.several, "fail": False}  # success
        return dict(both, reached=1)  # reached

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.several = 3  # several
        (self.first, [self.second, *self.rest]), other = (1, [2, 3]), 4  # first second rest
        self.targets["left"][env_idx] = other  # targets['left']
        self.memory.best[0] = 5  # memory.best
        self.goal: Any = 6  # goal.raw_pose

    @property
    def answer(self) -> int:
        return 42

    @answer.setter
    def answer(self, value: int) -> None:
        self.kept = value  # kept

    def two_returns(self) -> int:
        if self.several:
            return 1
        return 2


def line_of(mark: str) -> int:
    lines, first = inspect.getsourcelines(inspect.getmodule(Task))
    [found] = [k for k, line in enumerate(lines) if mark in line.partition("  # ")[2].split()]
    return (first or 1) + found


@pytest.mark.parametrize(
    "path",
    [
        "in_the_base",
        "several",
        "built",
        "first",
        "second",
        "rest",
        "targets['left']",
        "memory.best",
        "goal.raw_pose",
        "kept",
    ],
)
def test_the_line_that_assigns_is_found_outside_of_the_build_and_first_in_the_reset(path: str) -> None:
    place = find_assignment(Task, path)
    assert place is not None and place[:2] == (__file__, line_of(path))


def test_what_no_hook_of_a_reset_assigns_has_no_line() -> None:
    assert find_assignment(Task, "only_built") is find_assignment(Task, "nothing") is None


@pytest.mark.parametrize("entry", ["success", "reached"])
def test_an_entry_is_found_as_a_key_and_as_a_keyword(entry: str) -> None:
    assert find_entry(Task, "evaluate", entry) == (__file__, line_of(entry), "evaluate")


def test_where_no_line_is_named_the_def_is() -> None:
    start = inspect.getsourcelines(Task.evaluate)[1]
    assert find_entry(Task, "evaluate", "nothing") == (__file__, start, "evaluate")
    assert place_of_return(Task, "evaluate") == (__file__, line_of("reached"), "evaluate")
    several = inspect.getsourcelines(Task.two_returns)[1]
    assert place_of_return(Task, "two_returns") == (__file__, several, "two_returns")
    assert place_of_class(Task) == (__file__, inspect.getsourcelines(Task)[1], "Task")
    assert place_of_class(type("Made", (), {"__module__": "nowhere"})) is None

"""Random edits: whatever reload level a save gets, the env then behaves like an env newly made from the text."""

from __future__ import annotations

import ast
import random
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drive.session import TASKS
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv
from workbench.live.messages import Load
from workbench.live.worker.reload import Running, load_version
from workbench.task.description import TaskOptions
from workbench.task.open import open_task
from workbench.task.reload_level import Inherited, find_change

pytestmark = pytest.mark.thorough

TEXT = (TASKS / "push_cube.py").read_text()
OPTIONS = TaskOptions(num_envs=2, env_kwargs={"render_backend": "none"})


def numbers(text: str) -> list[ast.Constant]:
    """Lengths, factors and bounds of a task. An int is included only where it is a factor."""
    tree = ast.parse(text)
    factors = {id(node.left) for node in ast.walk(tree) if isinstance(node, ast.BinOp)}
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Constant)]
    return [
        node
        for node in found
        if isinstance(node.value, float) or (type(node.value) is int and id(node) in factors)
    ]


def edited(text: str, rng: random.Random) -> str:
    """Return the text with one or two numbers changed and one line added."""
    lines = text.splitlines(keepends=True)
    for node in rng.sample(numbers(text), rng.randint(1, 2)):
        line = lines[node.lineno - 1]
        assert isinstance(node.value, (int, float)) and node.end_col_offset is not None
        if len(line) == len(text.splitlines()[node.lineno - 1]) + 1:
            value = node.value * 1.25 if isinstance(node.value, float) else node.value + 1
            lines[node.lineno - 1] = f"{line[: node.col_offset]}{value!r}{line[node.end_col_offset :]}"
    lines.insert(
        rng.choice([at for at, line in enumerate(lines) if line.startswith("    def ")]), "    # more\n"
    )
    return "".join(lines)


def played(env: TaskEnv) -> Iterator[StepResult]:
    """Play an episode from a seeded reset."""
    rng = np.random.default_rng(0)
    yield env.reset(seed=[3, 4])
    for _ in range(3):
        yield env.step(rng.uniform(-1, 1, (2, 8)).astype(np.float32))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 8))])
def test_after_each_save_the_env_behaves_like_a_new_one(seed: int, tmp_path: Path) -> None:
    rng, text, levels = random.Random(seed), TEXT, []
    file, other = tmp_path / "push.py", tmp_path / "new.py"
    file.write_text(text)
    request = Load(str(file), OPTIONS)
    opened, _ = load_version(request, None)
    try:
        for _ in range(5):
            text = edited(text, rng)
            file.write_text(text)
            other.write_text(text.replace("WorkbenchPushCube-v1", "MadeOfThatText-v1"))
            again, report = load_version(request, Running(request, opened, opened.first))
            if again.env.env is not opened.env.env:
                opened.env.close()
            opened = again
            assert report is not None
            levels.append(report.level)
            new = open_task(str(other), OPTIONS)
            for step, wanted in zip(played(opened.env), played(new.env), strict=True):
                np.testing.assert_array_equal(step.poses, wanted.poses, err_msg=report.level)
                np.testing.assert_array_equal(step.reward, wanted.reward, err_msg=report.level)
                for name, rows in wanted.evaluate.items():
                    np.testing.assert_array_equal(
                        step.evaluate[name], rows, err_msg=f"{name}, {report.level}"
                    )
            new.env.close()
    finally:
        opened.env.close()
    assert seed or len(set(levels)) > 1, "not every save may rebuild the scene"


@settings(max_examples=15)
@given(st.lists(st.integers(0, TEXT.count("\n") - 1), min_size=1, max_size=5))
def test_blank_lines_and_comments_are_no_change(places: list[int]) -> None:
    lines = TEXT.splitlines(keepends=True)
    outside = [
        at
        for at, line in enumerate(lines)
        if line.startswith(("    def ", "    @property", "CUBE", "GOAL_R"))
    ]
    for place in sorted(places, reverse=True):
        lines.insert(outside[place % len(outside)], "\n    # a remark\n")
    texts = {"/author/task.py": TEXT}, {"/author/task.py": "".join(lines)}
    assert find_change(*texts, "/author/task.py", "PushCubeEnv", Inherited(frozenset())).level == "same"

"""The range of a uniform spawn: measured from what a reset draws, and changed in the text so that a run gives the new range."""

from __future__ import annotations

import importlib.util
import itertools
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drive.scenes import step_of
from workbench.envs.step_result import StepResult
from workbench.hands.questions import EpisodeStart, ReadStart
from workbench.hands.spawn_source import Range, Spawn, measure_spawn, plan_spawn
from workbench.hands.start_worker import read_start
from workbench.source.parsed import RefusedEdit

ENVS, SEEDS = 4, (3, 7, 11)
TASK = """import torch
from mani_skill.envs.utils import randomization
from mani_skill.envs.utils.randomization import UniformPlacementSampler, uniform
LOW, HIGH = -0.1, 0.1
HALF = 0.1
SIZE = 0.2
class Env:
    NEAR = -0.1
    FAR = 0.1
    device = "cpu"
    def __init__(self):
        self.reach = 0.2
        self.reach = self.reach * 1
        self.size = SIZE
    def place(self, b):
        xyz = torch.zeros((b, 3))
        xyz[:, :2] = 0.05
        RESET
        return xyz
"""
numbers = itertools.count()


def task(*lines: str) -> str:
    return TASK.replace("RESET", "\n        ".join(lines))


def loaded(file: Path, text: str) -> ModuleType:
    file.write_text(text)
    name = f"spawn_task_{next(numbers)}"
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    exec(compile(text, str(file), "exec"), vars(module))
    return module


def starts_of(file: Path, text: str) -> list[EpisodeStart]:
    module = loaded(file, text)
    try:

        def reset(seed: int) -> Callable[[], StepResult]:
            def poses() -> StepResult:
                torch.manual_seed(seed)
                placed = module.Env().place(ENVS).numpy()
                rows = np.concatenate([placed, np.zeros((ENVS, 4))], axis=1).astype(np.float32)
                return step_of(rows[:, None])

            return poses

        texts = {str(file): text}
        return [read_start(ReadStart(seed, texts), ENVS, reset(seed)) for seed in SEEDS]
    finally:
        del sys.modules[module.__name__]


def measured(file: Path, text: str) -> Spawn:
    spawn = measure_spawn(starts_of(file, text), 0)
    assert spawn is not None
    return spawn


def sides(file: Path, text: str) -> np.ndarray:
    """(2, 2) minimum and maximum of x and of y."""
    return np.array(measured(file, text).ranges, np.float64)


def planned(file: Path, text: str, x: Range | None, y: Range | None = None) -> str:
    return plan_spawn({str(file): text}, "cube", measured(file, text), (x, y)).new_text


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("spawn") / "task.py"


SQUARE = (-0.1, 0.1), (-0.1, 0.1)
WAYS: dict[str, tuple[tuple[str, ...], tuple[Range, Range]]] = {
    "two columns": (("xyz[..., :2] = torch.rand((b, 2)) * 0.2 - 0.1",), SQUARE),
    "a line for each": (
        ("xyz[:, 0] = torch.rand(b) * 0.1 - 0.05", "xyz[:, 1] = torch.rand((b,)) * 0.364 - 0.364 / 2"),
        ((-0.05, 0.05), (-0.182, 0.182)),
    ),
    "a number around zero": (
        ("xyz[:, 0] = (torch.rand(b) * 2 - 1) * 0.3 - 0.1", "xyz[:, 1] = torch.rand(b) * 0.2 + 0.5"),
        ((-0.4, 0.2), (0.5, 0.7)),
    ),
    "subtracted": (
        ("xyz[:, 0] = -torch.rand(b) * 0.2 - 0.1", "xyz[:, 1] = -0.15 - torch.rand(b) * 0.1 + 0.05"),
        ((-0.3, -0.1), (-0.2, -0.1)),
    ),
    "constants of the module": (("xyz[:, :2] = torch.rand((b, 2)) * (HIGH - LOW) + LOW",), SQUARE),
    "constants of the class": (
        ("xyz[:, 0] = self.NEAR + (self.FAR - self.NEAR) * torch.rand(b)", "xyz[:, 1] = torch.rand(b)"),
        ((-0.1, 0.1), (0.0, 1.0)),
    ),
    "one constant for both numbers": (("xyz[:, :2] = torch.rand((b, 2)) * 2 * HALF - HALF",), SQUARE),
    "a constant of something else too": (
        ("xyz[:, :2] = torch.rand((b, 2)) * SIZE - 0.1", "xyz[:, 2] = SIZE"),
        SQUARE,
    ),
    "a computed attribute": (("xyz[:, :2] = torch.rand((b, 2)) * self.reach - self.reach / 2",), SQUARE),
    "uniform with lists": (
        ("xyz[:, :2] = uniform([0.01, -0.1], [0.1, 0.1], size=(b, 2))",),
        ((0.01, 0.1), (-0.1, 0.1)),
    ),
    "uniform with tensors": (
        (
            "xy = randomization.uniform(",
            "    low=torch.tensor([-0.1, -0.3]), high=torch.tensor([0.1, 0]), size=(b, 2)",
            ")",
            "xyz[:, :2] = xy",
        ),
        ((-0.1, 0.1), (-0.3, 0.0)),
    ),
    "uniform with one number": (
        ("xyz[:, :2] = randomization.uniform(-0.05, 0.05, size=(b, 2))",),
        ((-0.05, 0.05), (-0.05, 0.05)),
    ),
    "moved later": (
        ("xyz[:, :2] = torch.rand((b, 2)) * 0.2 - 0.1", "xyz[:, 0] += 0.3"),
        ((0.2, 0.4), (-0.1, 0.1)),
    ),
    "given a name": (("u = torch.rand((b, 2))", "xyz[:, :2] = u * 0.2 - 0.1"), SQUARE),
    "rand_like, and a division": (("xyz[:, :2] = torch.rand_like(xyz[:, :2]) / 5 - 0.1",), SQUARE),
    "a part of what is computed": (
        (
            "xyz[..., 0] = (torch.rand((b, 1)) * 0.05 - 0.1)[..., 0]",
            "xyz[..., 1] = torch.rand((b, 1))[..., 0]",
        ),
        ((-0.1, -0.05), (0.0, 1.0)),
    ),
    "a height too": (("xyz = torch.rand((b, 3)) * torch.tensor([0.2, 0.2, 0.0]) - 0.1",), SQUARE),
    "a context of the device": (
        (
            "with torch.device(self.device):",
            "    xyz[:, :2] = torch.rand((b, 2)).to(self.device) * 0.2 - 0.1",
        ),
        SQUARE,
    ),
}


def ranges() -> st.SearchStrategy[Range]:
    ends = st.tuples(st.integers(-900, 900), st.integers(10, 800))
    return ends.map(lambda one: (one[0] / 1000, (one[0] + one[1]) / 1000))


@pytest.mark.parametrize(("lines", "found"), WAYS.values(), ids=WAYS)
def test_the_range_is_exact_although_few_resets_show_all_of_it(
    file: Path, lines: tuple[str, ...], found: tuple[Range, Range]
) -> None:
    np.testing.assert_allclose(sides(file, task(*lines)), found, atol=1e-5)


@pytest.mark.parametrize(("lines", "found"), WAYS.values(), ids=WAYS)
@given(x=ranges(), y=ranges() | st.none())
@settings(max_examples=5, deadline=None)
def test_a_run_of_the_new_text_gives_the_new_range_and_keeps_the_rest(
    file: Path, lines: tuple[str, ...], found: tuple[Range, Range], x: Range, y: Range | None
) -> None:
    text = task(*lines)
    before = starts_of(file, text)
    new = planned(file, text, x, y)
    np.testing.assert_allclose(sides(file, new), (x, y or found[1]), atol=2e-4)
    for old, start in zip(before, starts_of(file, new), strict=True):
        np.testing.assert_allclose(start.poses[..., 2], old.poses[..., 2], atol=1e-6)


SMALLEST = {
    "xyz[..., :2] = torch.rand((b, 2)) * 0.2 - 0.1": "xyz[..., :2] = torch.rand((b, 2)) * torch.tensor([0.4, 0.2], device=self.device) - torch.tensor([0.2, 0.1], device=self.device)",
    "xyz[:, 0] = torch.rand(b) * 0.3 - 0.2": "xyz[:, 0] = torch.rand(b) * 0.4 - 0.2",
    "xyz[:, 0] = torch.rand(b) * 0.3 + 0.2": "xyz[:, 0] = torch.rand(b) * 0.4 - 0.2",
    "xyz[:, 0] = torch.rand(b)": "xyz[:, 0] = torch.rand(b) * 0.4 - 0.2",
    "xyz[:, 0] = 0.3 - torch.rand(b) * 0.4": "xyz[:, 0] = 0.2 - torch.rand(b) * 0.4",
    "xyz[:, 0] = torch.rand((b, 1))[:, 0]": "xyz[:, 0] = (torch.rand((b, 1)) * 0.4 - 0.2)[:, 0]",
    "xyz[:, :2] = uniform(-0.1, 0.2, size=(b, 2))": "xyz[:, :2] = uniform([-0.2, -0.1], 0.2, size=(b, 2))",
    "LOW, HIGH = -0.1, 0.1": "LOW, HIGH = -0.2, 0.2",
    "    NEAR = -0.1\n    FAR = 0.1": "    NEAR = -0.2\n    FAR = 0.2",
}


@pytest.mark.parametrize(("old", "new"), SMALLEST.items(), ids=SMALLEST)
def test_only_the_numbers_that_change_are_replaced(file: Path, old: str, new: str) -> None:
    uses = {
        "L": "xyz[:, 0] = torch.rand(b) * (HIGH - LOW) + LOW",
        " ": "xyz[:, 0] = torch.rand(b) * (self.FAR - self.NEAR) + self.NEAR",
    }
    text = task(uses.get(old[0], old))
    assert planned(file, text, (-0.2, 0.2)) == text.replace(old, new)


REFUSED = {
    "a sum of two numbers": (
        "xyz[:, 0] = torch.rand(b) * 0.1 + torch.rand(b) * 0.1",
        "not one uniform number",
    ),
    "no linear function": ("xyz[:, 0] = torch.rand(b) ** 2", "not one uniform number"),
    "a fixed place": ("xyz[:, 0] = 0.3", "not one uniform number"),
    "another distribution": ("xyz[:, 0] = torch.randn(b)", "not one uniform number"),
    "a sampler": (
        "xyz[:, :2] = UniformPlacementSampler([[0, 0], [1, 1]], b).sample(0.1, 10)",
        "draws by itself",
    ),
    "a number that is scaled elsewhere": (
        "u = torch.rand((b, 2)); xyz[:, 0] = u[:, 0] * 0.2; xyz[:, 1] = u[:, 1]",
        "scaled in another place",
    ),
    "one number for x and y": ("xyz[:, :2] = torch.rand((b, 1)) * 0.2", "both x and y"),
}


@pytest.mark.parametrize(("line", "why"), REFUSED.values(), ids=REFUSED)
def test_what_is_not_proven_is_refused_with_lines_to_copy(file: Path, line: str, why: str) -> None:
    with pytest.raises(RefusedEdit, match=why) as refused:
        planned(file, task(line), (-0.25, 0.3), (0.125, 0.25))
    assert "* 0.55" in refused.value.snippet and "-0.25" in refused.value.snippet


def test_a_range_without_width_or_without_a_change_is_refused(file: Path) -> None:
    text = task("xyz[:, 0] = torch.rand(b) * 0.2")
    for x in ((0.1, 0.1), (0.1, -0.1), (0.0, 0.20004)):
        with pytest.raises(RefusedEdit):
            planned(file, text, x)


def test_a_file_of_an_installed_package_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "site-packages" / "task.py"
    file.parent.mkdir()
    with pytest.raises(RefusedEdit, match="installed package"):
        planned(file, task("xyz[:, 0] = torch.rand(b) * 0.2"), (0.0, 0.5))


def test_a_body_in_no_env_has_no_range(file: Path) -> None:
    starts = starts_of(file, task("xyz[:] = torch.nan"))
    assert measure_spawn(starts, 0) is None

"""Reloads on real envs: what each level keeps, and that no mixture of two versions remains."""

from __future__ import annotations

import ast
import random
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mani_skill.envs.tasks.tabletop as tabletop
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from workbench.envs import action_vector as actions
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv
from workbench.live.messages import Load, LoadLevel, ReloadReport
from workbench.live.worker.reload import Running, load_version
from workbench.pictures.render import take_pictures
from workbench.task.description import TaskOptions
from workbench.task.open import OpenedTask, open_task
from workbench.task.problem import TaskError

pytestmark = pytest.mark.usefixtures("renderer")

TASKS = Path(__file__).parents[3] / "tasks"
UPSTREAM = Path(tabletop.__file__).parent
NUM_ENVS = 3


@dataclass
class Desk:
    """An author's file and its running version, as in the worker."""

    file: Path
    good: str
    options: TaskOptions
    running: Running
    reports: list[ReloadReport] = field(default_factory=list)

    @property
    def task(self) -> TaskEnv:
        return self.running.opened.env

    def save(self, text: str, level: LoadLevel = "auto") -> ReloadReport:
        """Save and reload; raises the reload's TaskError."""
        self.file.write_text(text)
        request = Load(str(self.file), self.options, level=level)
        opened, report = load_version(request, self.running)
        assert report is not None
        if opened.env.env is not self.task.env:
            self.task.close()
        self.running = Running(request, opened, opened.first)
        self.reports.append(report)
        return report

    def edit(self, old: str, new: str, level: LoadLevel = "auto") -> ReloadReport:
        assert old in self.good, old
        return self.save(self.good.replace(old, new, 1), level)

    def step(self, times: int = 1) -> StepResult:
        rng = np.random.default_rng(times)
        for _ in range(times):
            action = actions.random_action(self.task.parts, NUM_ENVS, rng)
            last = self.task.step(action)
            self.running = Running(self.running.request, self.running.opened, last)
        return self.running.last


def open_desk(file: Path, **env_kwargs: Any) -> Desk:
    options = TaskOptions(num_envs=NUM_ENVS, env_kwargs=env_kwargs)
    request = Load(str(file), options)
    opened, report = load_version(request, None)
    assert report is None, "the first version replaces none"
    return Desk(file, file.read_text(), options, Running(request, opened, opened.first))


@pytest.fixture(scope="module")
def desk(task_file: Path) -> Iterator[Desk]:
    desk = open_desk(task_file)
    yield desk
    desk.task.close()


@pytest.fixture(autouse=True)
def good_version(request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    if "desk" in request.fixturenames:
        desk = request.getfixturevalue("desk")
        desk.save(desk.good)


def state_of(task: TaskEnv) -> list[bytes]:
    return [*task.snapshot().simulation.packed]  # type: ignore[union-attr]


# --- patched ---------------------------------------------------------------------------------------


def test_an_edited_reset_is_tried_without_changing_the_moment_and_used_at_the_next_reset(desk: Desk) -> None:
    before = desk.step(4)
    state, rng = state_of(desk.task), torch.get_rng_state()
    report = desk.edit("SPAWN_HALF_WIDTH = 0.1", "SPAWN_HALF_WIDTH = 0.0")
    assert (report.level, report.reason) == (
        "patched",
        "only SPAWN_HALF_WIDTH changed: seen from the next reset on",
    )
    assert state_of(desk.task) == state and torch.equal(torch.get_rng_state(), rng)
    np.testing.assert_array_equal(desk.running.last.poses, before.poses)
    desk.task.reset(seed=0)
    cube = desk.task.env.cube.pose.p  # type: ignore[attr-defined]
    assert torch.allclose(cube[:, :2], torch.zeros(2), atol=1e-6)


def test_a_patched_version_is_described_as_a_fresh_one_and_has_its_time_limit(desk: Desk) -> None:
    env = desk.task.env
    report = desk.save(desk.good.replace("return reward\n", "return reward + 3\n"))
    assert report.level == "patched" and desk.task.env is env
    fresh = open_task(str(desk.file), desk.options)
    try:
        mine, theirs = desk.running.opened.description, fresh.description
        for name in (
            *(
                "source_files",
                "source_hash",
                "source",
                "max_episode_steps",
                "chosen",
                "others",
                "in_place_of",
            ),
            *("notices", "outlier_rules", "env_id", "class_name", "actions", "reward_mode", "obs_mode"),
        ):
            assert getattr(mine, name) == getattr(theirs, name), name
        limit = mine.max_episode_steps
        assert limit is not None
    finally:
        fresh.env.close()
    desk.task.reset(0)
    desk.task.env._elapsed_steps += limit - 3
    assert [desk.step().truncated.tolist() for _ in range(3)] == [[False] * 3, [False] * 3, [True] * 3]


@pytest.mark.parametrize("level", ["patched", "rebuilt"])
def test_a_requested_level_is_taken_whatever_has_changed(desk: Desk, level: LoadLevel) -> None:
    before, env = desk.step(2), desk.task.env
    report = desk.edit("base_color=[0.05,", "base_color=[0.4,", level)
    assert report.level == level and (desk.task.env is env) == (level == "patched")
    np.testing.assert_allclose(desk.running.last.poses, before.poses, atol=1e-4)
    np.testing.assert_array_equal(desk.running.last.elapsed_steps, before.elapsed_steps)
    assert desk.save(desk.file.read_text()).level == "same"


# --- levels: cameras, rebuilt, requested ------------------------------------------------------------------------


def pictures(task: TaskEnv) -> list[np.ndarray]:
    wanted = [("base_camera", "sensor", ("rgb", "segmentation")), ("render_camera", "human", ("rgb",))]
    made = take_pictures(task.env, 1, wanted)  # type: ignore[arg-type]
    return [array for picture in made for array in (picture.rgb, picture.segmentation) if array is not None]


def test_edited_cameras_equal_those_of_a_fresh_env_and_the_scene_stays(desk: Desk) -> None:
    before = desk.step(3)
    env, state, was = desk.task.env, state_of(desk.task), pictures(desk.task)
    text = desk.good.replace("eye=[0.45, 0, 0.6]", "eye=[0.5, 0.1, 0.7]").replace(
        "width=512, height=512", "width=256, height=192"
    )
    report = desk.save(text)
    assert report.level == "cameras" and "_default_sensor_configs" in report.reason
    assert desk.task.env is env and state_of(desk.task) == state
    np.testing.assert_array_equal(desk.running.last.poses, before.poses)
    human = next(c for c in desk.running.opened.description.cameras if c.kind == "human")
    assert (human.width, human.height) == (256, 192)
    now = pictures(desk.task)
    assert now[2].shape == (192, 256, 3) and not np.array_equal(now[0], was[0])
    fresh = open_task(str(desk.file), desk.options)
    try:
        fresh.env.restore(desk.task.snapshot())
        for mine, theirs in zip(now, pictures(fresh.env), strict=True):
            np.testing.assert_array_equal(mine, theirs)
    finally:
        fresh.env.close()


def test_cameras_can_be_replaced_repeatedly_and_snapshots_stay_exact(desk: Desk) -> None:
    for height in (0.5, 0.6, 0.7):
        assert desk.edit("eye=[0.45, 0, 0.6]", f"eye=[0.4, 0, {height}]").level == "cameras"
    snapshot = desk.task.snapshot()
    _, report = desk.task.restore(snapshot)
    assert not report.not_carried, "renumbered entities still get the same physics"


def test_if_the_new_scene_fails_at_the_moment_a_fresh_episode_starts(desk: Desk) -> None:
    desk.step(5)
    text = desk.good.replace("base_color=[0.05,", "base_color=[0.5,")
    late = "assert (self._elapsed_steps < 3).all(), 'too late'\n        distance = torch"
    report = desk.save(text.replace("distance = torch", late, 1))
    assert report.level == "rebuilt" and "too late" in report.not_carried["the moment"]
    assert (desk.running.last.elapsed_steps == 0).all()


def test_a_module_that_a_hook_imports_at_run_time_is_compared_with_the_disk(tmp_path: Path) -> None:
    helper = tmp_path / "late.py"
    helper.write_text("def weight():\n    return 1.0\n")
    file = tmp_path / "push_cube.py"
    lines = "import late\n        return late.weight() * reward\n"
    file.write_text((TASKS / "push_cube.py").read_text().replace("return reward\n", lines, 1))
    desk = open_desk(file)
    try:
        before = desk.step(3)
        helper.write_text("def weight():\n    return 2.0\n")
        report = desk.save(file.read_text())
        assert report.level == "patched" and "weight of late.py" in report.reason
        np.testing.assert_allclose(desk.running.last.reward, 2 * before.reward, rtol=1e-6)
    finally:
        desk.task.close()


# --- never a mixture -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_random_reload_equals_a_fresh_env_step_for_step(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Edits anywhere in real tasks: in hooks, constants, defaults, scenes and cameras."""
    folder = tmp_path_factory.mktemp("author")
    desks = [open_desk(Path(shutil.copy(path, folder / path.name)), obs_mode="state") for path in EDITED]
    tried: list[str] = []

    @settings(max_examples=60, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
    @given(st.integers(0, len(EDITED) - 1), st.integers(0, 10**6), st.integers(1, 2))
    def edit(number: int, seed: int, edits: int) -> None:
        desk = desks[number]
        text = randomly_edited(desk.file.read_text(), random.Random(seed), edits)
        desk.step(3)
        desk.file.write_text(text)
        try:
            report = desk.save(text)
        except TaskError:
            with pytest.raises(TaskError):
                open_task(str(desk.file), desk.options)
            desk.save(desk.good)
            return
        tried.append(report.level)
        fresh = open_task(str(desk.file), desk.options)
        try:
            goes_on_as(desk.running.opened, fresh)
        finally:
            fresh.env.close()
            # The running version must be the newest load of the file, or it could not be undone.
            desk.save(text)

    edit()
    for desk in desks:
        desk.task.close()
    assert {"patched", "rebuilt"} <= set(tried), tried


EDITED = (
    TASKS / "push_cube.py",
    UPSTREAM / "roll_ball.py",
    UPSTREAM / "stack_cube.py",
    UPSTREAM / "lift_peg_upright.py",
)


def randomly_edited(text: str, rng: random.Random, edits: int) -> str:
    """`text` with some numbers changed or moved to functions, or statements removed or duplicated."""
    for _ in range(edits):
        kind = rng.choice(("number", "number", "number", "moved", "gone", "doubled"))
        text = (
            _with_a_statement(text, rng, kind)
            if kind in ("gone", "doubled")
            else _with_a_number(text, rng, kind)
        )
    return text


def _with_a_number(text: str, rng: random.Random, kind: str) -> str:
    constants = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Constant)]
    numbers = [node for node in constants if isinstance(node.value, float)]
    node = rng.choice(numbers)
    assert isinstance(node.value, float)
    value = f"{node.value * rng.choice((0.9, 1.1, 1.25)):.6g}"
    lines = text.splitlines(keepends=True)
    line = lines[node.lineno - 1]
    new = f"number_of_line_{node.lineno}()" if kind == "moved" else value
    lines[node.lineno - 1] = f"{line[: node.col_offset]}{new}{line[node.end_col_offset :]}"
    if kind == "moved":
        # After the docstring and __future__ imports only: constants of the file may need it.
        first = next(i for i, line in enumerate(lines) if line.startswith(("import ", "from typing")))
        lines.insert(first, f"def number_of_line_{node.lineno}():\n    return {value}\n\n\n")
    return "".join(lines)


def _with_a_statement(text: str, rng: random.Random, kind: str) -> str:
    tree = ast.parse(text)
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name != "__init__"]
    simple = [
        s for f in functions for s in f.body if isinstance(s, (ast.Assign, ast.AugAssign)) and len(f.body) > 1
    ]
    chosen = rng.choice(simple)
    lines = text.splitlines(keepends=True)
    own = lines[chosen.lineno - 1 : chosen.end_lineno]
    lines[chosen.lineno - 1 : chosen.end_lineno] = [] if kind == "gone" else own * 2
    return "".join(lines)


def goes_on_as(reloaded: OpenedTask, fresh: OpenedTask) -> None:
    """Check for equal bits from a reset, then from the same moment with the same actions."""
    mine, theirs = reloaded.env, fresh.env
    moment = mine.snapshot()
    # First, because a snapshot would copy state of the reloaded env into the fresh one.
    same(mine.reset(seed=11), theirs.reset(seed=11))
    assert torch.equal(mine.obs, theirs.obs)
    start = mine.snapshot()
    for snapshot in (start, moment):
        same(*[task.restore(snapshot)[0] for task in (mine, theirs)])
        same_steps(mine, theirs)
    cameras = [
        [(c.name, c.width, c.height, c.fovy, c.mount) for c in opened.description.cameras]
        for opened in (reloaded, fresh)
    ]
    assert cameras[0] == cameras[1]


def same_steps(mine: TaskEnv, theirs: TaskEnv) -> None:
    rng = np.random.default_rng(5)
    for _ in range(4):
        action = actions.random_action(mine.parts, NUM_ENVS, rng)
        same(mine.step(action), theirs.step(action))
        assert torch.equal(mine.obs, theirs.obs)


def same(mine: StepResult, theirs: StepResult) -> None:
    np.testing.assert_array_equal(mine.poses, theirs.poses)
    np.testing.assert_array_equal(mine.reward, theirs.reward)
    np.testing.assert_array_equal(mine.elapsed_steps, theirs.elapsed_steps)
    assert mine.evaluate.keys() == theirs.evaluate.keys()
    for name, value in mine.evaluate.items():
        np.testing.assert_array_equal(value, theirs.evaluate[name], err_msg=name)

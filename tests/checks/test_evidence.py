"""Evidence that rules read: places in the source, random draws, hollow meshes, bodies as they are built, odd states."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import trimesh

from workbench.checks.evidence.collect import Checkup
from workbench.checks.evidence.meshes import is_hollow, triangles_in
from workbench.checks.evidence.odd_states import AT_GOAL, KINDS, SHORT, odd_states
from workbench.checks.evidence.places import Module, Places
from workbench.checks.evidence.random_draws import global_draw, torch_draw
from workbench.task.load import load_task, undo_load

pytestmark = pytest.mark.thorough

# --- places in the source --------------------------------------------------------------------------------

BASE = """
from mani_skill.envs.sapien_env import BaseEnv

class LidBase(BaseEnv):
    def evaluate(self):
        return dict(success=self.is_open())

    def is_open(self):
        return self.angle() > 1

    def angle(self):
        return self.lid.qpos
"""
TASK = """
import numpy as np
from base_of_lids import LidBase

class OtherEnv(LidBase):
    def _initialize_episode(self, env_idx, options):
        self.lid.set_qpos(3)

    def angle(self):
        return 2

class LidEnv(LidBase):
    def _load_scene(self, options):
        self.lid = self.loader.load("box-lid")
        self.cup = self.builder.build(name="cup")

    def _initialize_episode(self, env_idx, options):
        q = self.cup.pose
        self.cup.pose.set_all(q)
        self.lid.set_qpos(0)
        self.agent.robot.set_qpos(0)

    def _get_obs_extra(self, info):
        return {"lid": helper(self.lid)}

def helper(lid):
    return lid.qpos

def unused():
    return helper(None)
"""


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Places]:
    folder = tmp_path_factory.mktemp("places")
    (folder / "base_of_lids.py").write_text(BASE)
    (folder / "lids.py").write_text(TASK)
    loaded = load_task(f"{folder / 'lids.py'}:LidEnv")
    yield Places(loaded)
    undo_load(loaded)


def at(place: tuple[str, int, str] | None) -> tuple[str, str, str]:
    """File, text of the line, and function."""
    assert place is not None
    text = {"lids.py": TASK, "base_of_lids.py": BASE}[Path(place[0]).name]
    return Path(place[0]).name, text.splitlines()[place[1] - 1].strip(), place[2]


def test_a_hook_is_found_in_the_class_or_in_a_base_of_another_file(places: Places) -> None:
    assert at(places.hook("evaluate")) == ("base_of_lids.py", "def evaluate(self):", "evaluate")
    line = "def _initialize_episode(self, env_idx, options):"
    assert at(places.hook("step", "_initialize_episode", "evaluate")) == (
        "lids.py",
        line,
        "_initialize_episode",
    )
    assert places.hook("_initialize_episode") != (places.modules[0].file, 6, "_initialize_episode"), (
        "of another task"
    )
    assert at(places.hook("compute_dense_reward")) == ("lids.py", "class LidEnv(LidBase):", "LidEnv")
    assert at(places.task) == ("lids.py", "class LidEnv(LidBase):", "LidEnv")


def test_an_entry_is_found_as_a_key_and_as_a_keyword(places: Places) -> None:
    keyword = ("base_of_lids.py", "return dict(success=self.is_open())", "evaluate")
    assert at(places.entry("success")) == keyword
    assert at(places.entry("lid", "_get_obs_extra")) == (
        "lids.py",
        'return {"lid": helper(self.lid)}',
        "_get_obs_extra",
    )
    assert at(places.entry("cup")) == ("base_of_lids.py", "def evaluate(self):", "evaluate")


def test_a_body_is_found_where_it_is_placed_else_where_it_is_named(places: Places) -> None:
    reset = "_initialize_episode"
    assert at(places.body("box-lid/link_1", reset)) == ("lids.py", "self.lid.set_qpos(0)", reset)
    assert at(places.body("cup", reset)) == ("lids.py", "self.cup.pose.set_all(q)", reset)
    assert at(places.body("panda", reset)) == ("lids.py", "self.agent.robot.set_qpos(0)", reset)
    assert at(places.body("cup", "step")) == (
        "lids.py",
        'self.cup = self.builder.build(name="cup")',
        "_load_scene",
    )
    assert at(places.body("ground", reset))[1] == "def _initialize_episode(self, env_idx, options):"


def test_functions_that_a_hook_reaches_are_those_of_this_task(places: Places) -> None:
    reached = [
        (Path(module.file).name, node.name)
        for module, node in places.reached_from("evaluate", "_get_obs_extra")
    ]
    assert reached == [
        ("base_of_lids.py", "evaluate"),
        ("lids.py", "_get_obs_extra"),
        ("base_of_lids.py", "is_open"),
        ("lids.py", "helper"),
        ("base_of_lids.py", "angle"),
    ]
    assert "OtherEnv" not in {
        name for _, name, _ in (at(module.place(node)) for module, node in places.functions())
    }
    assert [node.name for _, node in places.functions("unused", "angle")] == ["angle", "unused"]


# --- random draws ----------------------------------------------------------------------------------------

IMPORTS = """
import random
import numpy as np, numpy.random as npr, torch
import scipy.spatial.transform
from numpy.random import default_rng, rand as draw
from random import uniform
from scipy.spatial.transform import Rotation as R
from mani_skill.envs.utils import randomization as mr
from torch import randn as normal_numbers
rng = np.random.RandomState(0)
"""
GLOBAL = """
np.random.rand(3); npr.normal(); draw(2); random.random(); uniform(0, 1); np.random.RandomState(); default_rng()
np.random.default_rng(); R.random(); R.random(3)
"""
TORCH = (
    "torch.rand(3); torch.randint(0, 2, (3,)); x.uniform_(0, 1); mr.random_quaternions(3); normal_numbers(2)"
)
# In `default_rng().random()` the call inside draws, which is a node of its own.
NEITHER = """
np.random.RandomState(3); default_rng(seed=1); np.random.default_rng(3).normal(); np.random.seed(0); random.getstate()
R.random(3, 4); R.random(random_state=rng); rng.rand(); self.random.random(); torch.zeros(3); x.normal()
torch.rand(3, generator=g); x.normal_(generator=g); torch.manual_seed(0); default_rng().random()
"""


def calls(text: str) -> list[str]:
    return [call.strip() for line in text.strip().splitlines() for call in line.split(";")]


@pytest.mark.parametrize(
    ("call", "drawn"),
    [
        *((call, "global") for call in calls(GLOBAL)),
        *((call, "torch") for call in calls(TORCH)),
        *((call, "") for call in calls(NEITHER)),
    ],
)
def test_a_draw_is_told_by_the_generator_that_it_uses(call: str, drawn: str) -> None:
    module = Module("task.py", ast.parse(IMPORTS))
    node = ast.parse(call, mode="eval").body
    written = f"{call.partition('(')[0]}()"
    for kind, draws in (("global", global_draw), ("torch", torch_draw)):
        assert draws(node, module) == (written if kind == drawn else None)
    assert global_draw(ast.parse("np.random.rand", mode="eval").body, module) is None


# --- meshes ----------------------------------------------------------------------------------------------


def shell(*sides: tuple[int, int, int]) -> trimesh.Trimesh:
    """Walls of a cube of 20 cm on these sides."""
    walls = []
    for side in sides:
        wall = trimesh.creation.box([0.01 if each else 0.2 for each in side])
        wall.apply_translation([0.1 * each for each in side])
        walls.append(wall)
    return cast(trimesh.Trimesh, trimesh.util.concatenate(walls))


SIDES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, -1))
MESHES = {
    "box without a lid": (shell(*SIDES), True),
    "box without a side": (shell(*SIDES[1:], (0, 0, 1)), True),
    "closed box": (shell(*SIDES, (0, 0, 1)), False),
    "tube": (shell(*SIDES[:4]), False),
    "corner": (shell(*SIDES[::2]), False),
    "ball": (trimesh.creation.icosphere(), False),
    "flat": (trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]), False),
    "one triangle": (trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 1, 2]]), False),
}


@pytest.mark.parametrize("name", MESHES)
def test_a_mesh_is_hollow_if_something_can_be_put_in_from_one_side(name: str, tmp_path: Path) -> None:
    mesh, hollow = MESHES[name]
    turned = mesh.copy()
    turned.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3], [1, 0, 0]))
    for kind, each in (("as is", mesh), ("turned", turned)):
        each.export(tmp_path / f"{kind}.ply")
        assert is_hollow(str(tmp_path / f"{kind}.ply")) == hollow, kind


def test_triangles_are_counted_only_in_a_file_that_may_have_too_many(tmp_path: Path) -> None:
    file, text = tmp_path / "ball.ply", tmp_path / "text.obj"
    trimesh.creation.icosphere(subdivisions=3).export(file)
    assert triangles_in(str(file), 1000) == 1280
    assert triangles_in(str(file), 1_000_000) == 0 and triangles_in(str(tmp_path / "gone.ply"), 10) == 0
    text.write_text("no mesh " * 100)
    assert triangles_in(str(text), 10) is None and is_hollow(str(text)) is None


# --- bodies as they are built, and poses as they are set -------------------------------------------------


def test_each_body_is_noted_with_its_line_its_envs_and_its_shapes(example: Checkup) -> None:
    assert example.task
    built = {each.name: each for each in example.builds}
    cube, goal, robot = built["cube"], built["goal"], built["panda"]
    assert (cube.kind, goal.kind, robot.kind) == ("dynamic", "kinematic", "articulation")
    assert (cube.of_robot, goal.of_robot, robot.of_robot) == (False, False, True)
    assert cube.envs == goal.envs == (0, 1, 2)
    assert (
        cube.place is not None and cube.place[2] == "_load_scene" and built["table-workspace"].place is None
    )
    assert cube.quaternion is not None and cube.quaternion.tolist() == [[1, 0, 0, 0]]
    assert [shape.kind for shape in cube.collision] == ["box"] and [shape.kind for shape in goal.visual] == [
        "cylinder"
    ] * 5
    assert goal.collision == () and len({shape.numbers for shape in goal.visual}) == 5
    # Three sizes, radius, length, the pose; then the colour of what is seen, or friction and density.
    assert cube.collision[0].numbers[:3] == (0.02, 0.02, 0.02) and cube.visual[0].numbers[-4:] == (
        0.05,
        0.2,
        0.75,
        1.0,
    )


def test_a_single_env_is_built_for_two_seeds_as_in_the_batch(example: Checkup) -> None:
    alone = example.alone
    assert alone.seeds == (2022, 2023) and [*alone.shapes] == [2022, 2023] and not alone.rebuilds
    assert alone.shapes[2022] == alone.shapes[2023] and len(alone.shapes[2022]) >= 4


# --- odd states ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def odd(example: Checkup) -> dict[str, list[dict[str, np.ndarray]]]:
    """Observations (N, D) by leaf, of each kind of odd states."""
    example.task.env.obs_mode  # noqa: B018
    seen = odd_states(example)
    assert (
        len(seen.seeds) == len(seen.kinds) == len(seen.obs) == len(seen.evaluate) == len(seen.reward["dense"])
    )
    assert seen.seeds[0] == [20, 21, 22] and set(map(tuple, seen.seeds)) == {(20, 21, 22)}
    found: dict[str, list[dict[str, np.ndarray]]] = {}
    for kind, obs, entries, *rewards in zip(seen.kinds, seen.obs, seen.evaluate, seen.reward["dense"], seen.reward["normalized_dense"], seen.reward_if_success["dense"], strict=True):  # fmt: skip
        dense, normalized, paid = rewards
        np.testing.assert_allclose(dense / 3, normalized, atol=1e-6)
        assert (paid == 3).all() or (dense[~entries["success"].astype(bool)] < 3).all()
        found.setdefault(kind, []).append({**obs, **entries, "dense": dense})
    return found


def test_joints_and_bodies_are_put_where_an_author_would_not_look(
    odd: dict[str, list[dict[str, np.ndarray]]], example: Checkup
) -> None:
    cubes = example.starts.poses[0, :, example.bodies.index("cube"), :3]
    limits = example.task.env.agent.robot.get_qlimits().numpy(force=True)[0].clip(-np.pi, np.pi)
    (begun,), (placed,), (at_limits,) = (odd[kind] for kind in KINDS)
    cube = placed["extra/cube_pose"]
    np.testing.assert_allclose(begun["extra/cube_pose"][:, :3], cubes, atol=1e-6)
    low, high = cubes.min(axis=0) - 0.151, cubes.max(axis=0) + 0.151
    assert (cube[:, :2] > low[:2]).all() and (cube[:, :2] < high[:2]).all()
    assert (cube[:, 2] > cubes[:, 2]).all() and (cube[:, 2] < cubes[:, 2] + 0.3).all()
    np.testing.assert_allclose(np.linalg.norm(cube[:, 3:], axis=1), 1, atol=1e-5)
    assert np.ptp(cube, axis=0).min() > 1e-3, "each env has a place and a turn of its own"
    for state in (placed, at_limits):
        assert (state["agent/qpos"] >= limits[:, 0] - 1e-5).all() and (
            state["agent/qpos"] <= limits[:, 1] + 1e-5
        ).all()
        assert not state["agent/qvel"].any()
    ends = np.abs(at_limits["agent/qpos"][:, :, None] - limits[None]).min(axis=2)
    assert (
        ends.max() < 1e-5 and np.abs(placed["agent/qpos"][:, :, None] - limits[None]).min(axis=2).max() > 0.1
    )
    assert np.ptp(at_limits["agent/qpos"], axis=0).max() > 1


def test_bodies_are_put_at_the_goal_and_then_nearly_out_of_success(
    odd: dict[str, list[dict[str, np.ndarray]]], example: Checkup
) -> None:
    (there,) = odd[AT_GOAL.format("goal")]
    goal, cube = there["extra/goal_pos"], there["extra/cube_pose"]
    np.testing.assert_allclose(cube[:, :2], goal[:, :2], atol=1e-6)
    # The height of the goal in odd envs, where a goal may hang in the air; its own in the others.
    np.testing.assert_allclose(cube[:, 2], [0.02, goal[1, 2], 0.02], atol=1e-6)
    assert there["success"].tolist() == [True, False, True] and there["dense"].tolist()[::2] == [3, 3]
    short = odd[SHORT]
    assert len(short) == 6
    # Success ends at a distance of 10 cm from the goal, on the way back to 20 cm.
    last = short[-1]["cube_to_goal"][::2]
    assert np.abs(last - 0.1).max() < 0.2 / 32
    success = np.array([state["success"] for state in short])
    assert success[:, ::2].any() and not success[:, ::2].all()

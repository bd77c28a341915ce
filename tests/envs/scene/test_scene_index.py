"""The pose array of all bodies equals the poses of ManiSkill's own structs."""

# SAPIEN and ManiSkill annotate vectors and poses as what they become.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import gc
import weakref
from typing import Any

import mani_skill.envs  # noqa: F401 (registers the tasks)
import numpy as np
import pytest
import sapien
import torch
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv
from mani_skill.utils.structs import Actor, Pose

from tests.drive.envs import batched, stock
from tests.envs.by_hand import box, by_hand
from tests.envs.stock_env import Bare, batch_of
from tests.envs.written import Written
from workbench.envs.maniskill_private import setting_only
from workbench.envs.scene.scene_index import joint_names, present_states, read_joints, read_poses, scene_index

TASKS = ["PickCube-v1", "PegInsertionSide-v1"]


def after_one_step(env: Any) -> Any:
    env.reset(seed=1)
    return env


def assert_poses_equal_the_structs(env: Any) -> None:
    table, poses = scene_index(env), read_poses(env)
    assert poses.shape == (env.num_envs, len(table.names), 7) and poses.dtype == np.float32
    checked = np.zeros(poses.shape[:2], bool)
    named = {**env.scene.actors, **env.scene.actor_views}
    for name, articulation in env.scene.articulations.items():
        named.update({f"{name}/{link.name}": link for link in articulation.links})
    for body, name in enumerate(table.names):
        struct = named[name]
        envs = struct._scene_idxs.numpy()
        np.testing.assert_array_equal(poses[envs, body], struct.pose.raw_pose.numpy(), err_msg=name)
        checked[envs, body] = True
    np.testing.assert_array_equal(checked, ~np.isnan(poses).any(axis=-1))


@pytest.mark.thorough
@pytest.mark.parametrize("make", [stock, batched])
@pytest.mark.parametrize("task", TASKS)
def test_poses_equal_maniskills(task: str, make: Any) -> None:
    env = make(task)
    table = scene_index(env)
    assert len(set(table.names)) == len(table.names)
    for _ in range(3):
        env.step(torch.from_numpy(np.atleast_2d(env.action_space.sample())))
        assert_poses_equal_the_structs(env)
    env.reset(seed=2)
    # PegInsertionSide builds new pegs for every episode of a single env.
    assert_poses_equal_the_structs(env)
    env.close()


@pytest.mark.thorough
@pytest.mark.parametrize("task", TASKS)
def test_poses_equal_those_of_the_physics(task: str) -> None:
    """Compares with SAPIEN's entities, which do not depend on ManiSkill's tensors."""
    env = after_one_step(batched(task, 4))
    table = scene_index(env)
    env.step(torch.from_numpy(env.action_space.sample()))
    env.reset(options={"env_idx": torch.tensor([1, 3])})
    poses = read_poses(env)
    for e in range(env.num_envs):
        for b in range(len(table.names)):
            pose = table.entities[e, b].pose
            np.testing.assert_allclose(poses[e, b], [*pose.p, *pose.q], atol=1e-6, err_msg=table.names[b])
    env.close()


def test_a_hidden_body_has_the_pose_it_would_be_shown_at() -> None:
    env: Any = after_one_step(batched("PickCube-v1", 4))
    table = scene_index(env)
    goal = table.names.index("goal_site")
    shown = read_poses(env)
    env.goal_site.hide_visual()
    np.testing.assert_array_equal(read_poses(env), shown)
    env.reset(seed=5)
    moved = read_poses(env)
    assert np.abs(moved[:, goal, :3]).max() < 2.0
    assert (moved[:, goal, :3] != shown[:, goal, :3]).any()
    env.goal_site.show_visual()
    np.testing.assert_array_equal(read_poses(env), moved)
    env.close()


class SparseBodiesEnv(PushCubeEnv):
    """A body that only envs 0 and 2 have, and a merged view of two bodies of the same env."""

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)

        def ball(name: str, scene_idxs: list[int] | None = None) -> Actor:
            builder = self.scene.create_actor_builder()
            builder.add_sphere_collision(radius=0.02)
            builder.initial_pose = Pose.create(sapien.Pose([0.3, 0.3, 1.0 + 0.1 * len(name)]))
            builder.set_scene_idxs(scene_idxs)
            return builder.build_dynamic(name=name)

        self.rare = ball("rare", list(range(0, self.num_envs, 2)))
        self.pair = Actor.merge([ball("left"), ball("right")], name="pair")


def test_a_body_that_an_env_lacks_is_nan_there_only() -> None:
    env = after_one_step(batched(SparseBodiesEnv, 4))
    table = scene_index(env)
    missing = np.isnan(read_poses(env)).all(axis=-1)
    assert np.argwhere(missing).tolist() == [[1, table.names.index("rare")], [3, table.names.index("rare")]]
    assert_poses_equal_the_structs(env)
    env.close()


def test_a_scene_is_indexed_once_and_again_after_a_rebuild() -> None:
    env = after_one_step(batched("PickCube-v1", 2))
    before = scene_index(env)
    env.step(torch.from_numpy(env.action_space.sample()))
    assert scene_index(env) is before
    env.reset(seed=0, options={"reconfigure": True})
    after = scene_index(env)
    assert after is not before and after.names == before.names
    assert not {id(e) for e in after.entities.ravel()} & {id(e) for e in before.entities.ravel()}
    assert_poses_equal_the_structs(env)
    env.close()


def test_the_index_is_freed_with_its_scene() -> None:
    env = after_one_step(batched("PickCube-v1", 2))
    scene, index = weakref.ref(env.scene), weakref.ref(scene_index(env))
    env.close()
    del env
    gc.collect()
    assert scene() is None and index() is None


class SameNames(Bare):
    """An actor that is called like a link, two chains, and actors that are hidden in some envs only."""

    def _load_scene(self, options: dict) -> None:
        box(self, "left/link0", pose=sapien.Pose([1, 0, 1]))
        self.left, self.right = by_hand(self, 1, "left"), by_hand(self, 2, "right")
        for number in range(self.num_envs):
            builder = self.scene.create_actor_builder()
            builder.add_sphere_collision(radius=0.02)
            builder.initial_pose = sapien.Pose([2, 0, 1 + number])
            builder.set_scene_idxs([number])
            body = builder.build_kinematic(f"mark-{number}")
            if number == 1:
                self._hidden_objects.append(body)
            self.marks = [*getattr(self, "marks", []), body]
        self.mark = Actor.merge(self.marks, name="mark")


def test_bodies_and_joints_of_the_same_name_are_told_apart() -> None:
    env: Any = batch_of(SameNames, 3)
    index = scene_index(env)
    assert len(set(index.names)) == len(index.names)
    actor, link = (
        next(
            name
            for name, owner in zip(index.names, index.owners, strict=True)
            if owner == of and "link0" in name
        )
        for of in ("left/link0", "left")
    )
    assert actor == "left/link0" and link != actor
    env.left.set_qpos(torch.tensor([[0.1], [0.2], [0.3]]))
    env.right.set_qpos(torch.tensor([[0.4, 0.5], [0.6, 0.7], [0.8, 0.9]]))
    env.apply()
    poses = read_poses(env)
    np.testing.assert_allclose(poses[:, index.names.index(actor), :3], [[1, 0, 1]] * 3)
    np.testing.assert_array_equal(poses[:, index.names.index(link)], env.left.links[1].pose.raw_pose)
    assert joint_names(env) == ("left/hinge0", "right/hinge0", "right/hinge1")
    joints = read_joints(env)
    assert joints is not None
    np.testing.assert_allclose(joints, [[0.1, 0.4, 0.5], [0.2, 0.6, 0.7], [0.3, 0.8, 0.9]], rtol=1e-6)
    # What one env hides counts as hidden in all: it is one body.
    hidden = {name for name, is_hidden in zip(index.names, index.hidden, strict=True) if is_hidden}
    assert hidden == {"mark"}
    column = index.names.index("mark")
    np.testing.assert_allclose(poses[:, column, 2], [1, 2, 3])
    for number in range(3):
        assert index.name_of(env.marks[number]._objs[0]) == "mark"
        row = index.row_of(number, "mark")
        assert env.scene.px.cuda_rigid_body_data.torch()[row, 2] == 1 + number
    assert index.row_of(0, link) is not None and index.name_of(sapien.Entity()) is None
    env.close()


@pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")
@pytest.mark.parametrize("kept", [1, 3])
def test_after_a_body_was_removed_or_built_each_row_is_that_of_its_body(kept: int) -> None:
    env: Any = batch_of(Written, 3)
    env.reset(seed=0)
    env.falls.set_pose(Pose.create_from_pq(torch.tensor([[0.1 * i, 0, 0.5] for i in range(3)])))
    states, before = present_states(env), read_poses(env)
    with setting_only(env, [0, 1, 2][-kept:]):
        env.lies.remove_from_scene()
    names = scene_index(env).names
    poses, now = read_poses(env), present_states(env)
    index = scene_index(env)
    for name in names:
        column, gone = index.names.index(name), np.zeros(3, bool)
        gone[-kept:] = name == "lies"
        np.testing.assert_array_equal(np.isnan(poses[:, column, 0]), gone, err_msg=name)
        np.testing.assert_array_equal(poses[~gone, column], before[~gone, names.index(name)], err_msg=name)
    for name in ("actors/falls", "articulations/chain"):
        np.testing.assert_array_equal(np.asarray(now[name]), np.asarray(states[name]))
    late = box(env, "late", pose=sapien.Pose([4, 4, 4]))
    late.set_pose(sapien.Pose([5, 5, 5]))
    poses = read_poses(env)
    index = scene_index(env)
    np.testing.assert_allclose(poses[:, index.names.index("late"), :3], [[5] * 3] * 3)
    np.testing.assert_array_equal(poses[:, index.names.index("falls")], before[:, names.index("falls")])
    env.close()

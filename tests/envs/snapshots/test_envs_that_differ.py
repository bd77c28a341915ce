"""In a batch whose envs hold different objects, steps, resets and restores change only the chosen envs."""

# ManiSkill annotates an env's members as the widest thing they may be in any task.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportOptionalIterable=false

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.pose import Pose

from tests.envs.by_hand import box, by_hand
from tests.envs.stock_env import Bare, batch_of
from workbench.envs.inspect_env import inspect_env
from workbench.envs.scene.scene_index import joint_names, present_states, read_joints, read_poses, scene_index
from workbench.envs.snapshots.snapshot import restore_snapshot, take_snapshot
from workbench.envs.state_columns import read_state_columns
from workbench.envs.task_env import TaskEnv

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning"),
]
N = 4


class Unlike(Bare):
    """A merged box or ball, a two-hinge chain in odd envs only, and a wall that the task moves in each env."""

    def _load_scene(self, options: dict) -> None:
        self.floor = box(self, "floor", [3, 3, 0.1], sapien.Pose([0, 0, -0.1]), "static")
        self.wall = box(self, "wall", pose=sapien.Pose([0.5, 0.5, 0.05]), kind="static")
        things = []
        for i in range(self.num_envs):
            builder = self.scene.create_actor_builder()
            if i % 2:
                builder.add_sphere_collision(radius=0.05)
            else:
                builder.add_box_collision(half_size=[0.05, 0.04, 0.03])
            builder.initial_pose = sapien.Pose([1, 0, 0.2])
            builder.set_scene_idxs([i])
            things.append(builder.build(f"thing-{i}"))
            self.remove_from_state_dict_registry(things[-1])
        self.thing = Actor.merge(things, name="thing")
        self.add_to_state_dict_registry(self.thing)
        self.everywhere = by_hand(self, 1, "everywhere")
        self.chain = by_hand(self, 2, "chain", [1, 3])
        self.best = torch.zeros(self.num_envs)
        self.visits = torch.zeros(self.num_envs)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        rng = self._batched_episode_rng[env_idx]
        drawn = torch.from_numpy(np.asarray(rng.uniform(0, 0.3, (3,)))).float()
        self.thing.set_pose(Pose.create_from_pq(drawn + torch.tensor([1.0, 0, 0.2])))
        self.everywhere.set_qpos(drawn[:, :1])
        for env in env_idx.tolist():
            self.wall._objs[env].set_pose(
                sapien.Pose([0.5 + float(self.drawn_of(drawn, env_idx, env)), 0, 0.05])
            )
        self.best[env_idx] = drawn[:, 2]
        self.target = self.best = self.best.clone()  # two attributes, one tensor

    @staticmethod
    def drawn_of(drawn: torch.Tensor, env_idx: torch.Tensor, env: int) -> torch.Tensor:
        return drawn[env_idx.tolist().index(env), 0]

    def evaluate(self) -> dict:
        self.visits += 1
        return {}


def env_states(env: Any) -> list[tuple[Any, ...]]:
    """Return all state of each env: physics, poses, attributes, step count and generator."""
    packs, poses = [system.pack() for system in env.scene.px.systems], read_poses(env)
    return [
        (
            packs[i],
            poses[i].tobytes(),
            float(env.target[i]),
            float(env.visits[i]),
            int(env.elapsed_steps[i]),
            env._batched_episode_rng[i].get_state()[2],
        )
        for i in range(N)
    ]


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    env = batch_of(Unlike, N)
    env.reset(seed=[0, 1, 2, 3])
    yield env
    env.close()


CHOSEN = st.sets(st.integers(0, N - 1), min_size=1)
OPERATIONS = st.one_of(
    st.tuples(st.just("step"), st.integers(1, 4)),
    st.tuples(st.just("reset"), CHOSEN),
    st.tuples(st.just("keep"), st.none()),
    st.tuples(st.just("put back"), CHOSEN),
    st.tuples(st.just("exchange"), st.sampled_from([(0, 2), (2, 0), (1, 3), (3, 1)])),
)


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(OPERATIONS, min_size=3, max_size=9))
def test_operations_on_some_envs_leave_the_others(env: Any, operations: list[Any]) -> None:
    env.reset(seed=[0, 1, 2, 3])
    kept, was = take_snapshot(env), env_states(env)
    for operation, of in operations:
        before = env_states(env)
        if operation == "step":
            for _ in range(of):
                env.step(None)
            assert all(now[4] == then[4] + of for now, then in zip(env_states(env), before, strict=True))
            continue
        if operation == "reset":
            env.reset(options={"env_idx": torch.tensor(sorted(of))})
            touched = dict.fromkeys(of)
        elif operation == "keep":
            kept, was, touched = take_snapshot(env), env_states(env), {}
        elif operation == "put back":
            restore_snapshot(env, kept, sorted(of))
            touched = {i: i for i in of}
        else:
            to, source = of
            restore_snapshot(env, kept, [to], source=source)
            touched = {to: source}
        now = env_states(env)
        for i in range(N):
            if i not in touched:
                # A reset's `evaluate` increments the visits (index 3) of all envs.
                same = [k for k in range(6) if not (operation == "reset" and k == 3)]
                assert [now[i][k] for k in same] == [before[i][k] for k in same], (operation, i)
            elif (source := touched[i]) is not None:
                assert now[i][2:] == was[source][2:], (operation, i)
                np.testing.assert_allclose(
                    np.frombuffer(now[i][0], np.float32), np.frombuffer(was[source][0], np.float32), atol=1e-6
                )
                np.testing.assert_allclose(
                    np.frombuffer(now[i][1], np.float32), np.frombuffer(was[source][1], np.float32), atol=1e-6
                )
        assert env.target is env.best, "both attributes must still hold the same tensor"


def test_bodies_that_some_envs_lack_are_read_only_where_they_exist(env: Any) -> None:
    env.reset(seed=[0, 1, 2, 3])
    for _ in range(3):
        env.step(None)
    task = TaskEnv(env)
    for i in range(N):
        read = {one.articulation: one for one in inspect_env(task, i, ["joints"]).joints}
        assert set(read) == ({"everywhere", "chain"} if i % 2 else {"everywhere"})
        np.testing.assert_array_equal(read["everywhere"].position, env.everywhere._objs[i].qpos)
        if i % 2:
            np.testing.assert_array_equal(read["chain"].position, env.chain._objs[i // 2].qpos)
            np.testing.assert_array_equal(read["chain"].velocity, env.chain._objs[i // 2].qvel)
    # Only joints that every env has are compared.
    assert joint_names(env) == ("hinge0",)
    joints = read_joints(env)
    assert joints is not None
    np.testing.assert_array_equal(
        joints[:, 0], [articulation.qpos[0] for articulation in env.everywhere._objs]
    )
    poses, names = read_poses(env), scene_index(env).names
    lacking = np.isnan(poses[:, names.index("chain/link1")]).all(axis=1)
    assert lacking.tolist() == [True, False, True, False]
    columns = {name.partition("/")[2]: column for name, column in read_state_columns(task).items()}
    for states in (present_states(env), columns):
        assert states.keys() == {"actors/thing", "articulations/everywhere", "articulations/chain"}
        chains, rows = np.asarray(states["articulations/chain"]), env.chain.get_state().numpy()
        assert np.isnan(chains).all(axis=1).tolist() == [True, False, True, False]
        np.testing.assert_array_equal(chains[[1, 3]], rows)
        for name, struct in (("actors/thing", env.thing), ("articulations/everywhere", env.everywhere)):
            np.testing.assert_array_equal(np.asarray(states[name]), struct.get_state().numpy())
    for _ in range(2):  # static poses are read again after the task has moved them
        walls = read_poses(env)[:, names.index("wall"), 0]
        assert len(set(walls.tolist())) == N and np.allclose(walls, [e.pose.p[0] for e in env.wall._objs])
        env.reset(options={"env_idx": torch.tensor([1, 2])})

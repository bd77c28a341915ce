"""A task's own attributes are found, restored by row, and named when they cannot be."""

# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false

from __future__ import annotations

import collections
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import torch
from mani_skill.utils.structs.pose import Pose

from tests.drive.envs import PUSH_CUBE, batched
from workbench.envs.snapshots.snapshot import restore_snapshot, take_snapshot
from workbench.envs.task_env import TaskEnv

N = 4


@dataclass
class Stage:
    reached: torch.Tensor
    name: str


class Notes:
    def __init__(self, num_envs: int) -> None:
        self.visits = torch.zeros(num_envs)


class Remembers(PUSH_CUBE):
    """PushCube with attributes of many types."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.threshold = 0.02
        self.reach_offset = torch.tensor(
            [0.1, 0.2, 0.3, 0.4]
        )  # one value per env by coincidence: a constant, not a buffer
        super().__init__(*args, **kwargs)
        self.weight = 1.5

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        self.object_heights = torch.arange(self.num_envs, dtype=torch.float32)
        self.filled_later = torch.zeros(self.num_envs)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        if not hasattr(self, "best_distance"):
            n = self.num_envs
            self.best_distance = torch.full((n,), torch.inf)
            self.phases = {"reach": torch.zeros(n, dtype=torch.bool), "steps": {"count": torch.zeros(n, 2)}}
            self.history = [torch.zeros(n, 3), torch.zeros(n, 3)]
            self.pair = (torch.zeros(n), torch.zeros(n, dtype=torch.int64))
            self.goal_pose = Pose.create_from_pq(torch.zeros(n, 3))
            self.stage = Stage(torch.zeros(n), "reach")
            self.notes = Notes(n)
            self.prompts = [""] * n
            self.scores = np.zeros(n)
            self.half = torch.zeros(n, dtype=torch.bfloat16)
            self.recent: Any = collections.deque(maxlen=3)
            self.total_resets = 0
        self.best_distance[env_idx] = torch.inf
        self.total_resets += 1

    def evaluate(self) -> dict:
        result = super().evaluate()
        if hasattr(self, "best_distance"):
            distance = torch.linalg.norm(self.obj.pose.p - self.agent.tcp.pose.p, dim=1)
            self.best_distance = torch.minimum(self.best_distance, distance)
            self.notes.visits += 1
        return result

    def write(self, value: float) -> None:
        """Write a different value into every env's row of every buffer."""
        rows = torch.arange(self.num_envs) + value
        self.best_distance = rows.clone()
        self.phases["reach"] = rows > value + 1
        self.phases["steps"]["count"][:] = rows[:, None]
        self.history[1][:] = rows[:, None]
        self.pair = (rows.clone(), rows.long())
        self.goal_pose.raw_pose[:, 0] = rows
        self.stage.reached = rows.clone()
        self.notes.visits = rows.clone()
        self.prompts = [f"push {row}" for row in rows.tolist()]
        self.scores[:] = rows.numpy()
        self.half[:] = rows.to(torch.bfloat16)
        self.filled_later += value
        self.recent.append(value)

    def buffers(self) -> dict[str, torch.Tensor]:
        return {
            "best_distance": self.best_distance,
            "reach": self.phases["reach"],
            "count": self.phases["steps"]["count"],
            "history": self.history[1],
            "pair": self.pair[0],
            "integers": self.pair[1],
            "goal_pose": self.goal_pose.raw_pose,
            "stage": self.stage.reached,
            "visits": self.notes.visits,
            "prompts": torch.tensor([float(p.split()[1]) for p in self.prompts]),
            "scores": torch.from_numpy(self.scores),
            "half": self.half,
            "filled_later": self.filled_later,
        }

    def copied(self) -> dict[str, torch.Tensor]:
        return {name: value.clone() for name, value in self.buffers().items()}


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    env = batched(Remembers, N)
    yield env
    env.close()


@pytest.fixture(autouse=True)
def fresh(env: Any) -> None:
    env.reset(seed=[0, 1, 2, 3])


def test_all_buffers_are_restored(env: Any) -> None:
    env.write(1.0)
    before, snapshot = env.copied(), take_snapshot(env)
    env.write(50.0)
    report = restore_snapshot(env, snapshot)
    for name, value in env.buffers().items():
        assert torch.equal(value, before[name]), name
    assert "best_distance" in report.carried
    assert list(report.not_carried) == ["recent"], "a deque cannot be carried and must be named"
    assert snapshot.omitted == {"recent": "a collections.deque"}


def test_rows_of_chosen_envs_are_restored_into_chosen_envs(env: Any) -> None:
    env.write(1.0)
    before, snapshot = env.copied(), take_snapshot(env, [1, 2])
    env.write(50.0)
    now = env.copied()
    restore_snapshot(env, snapshot, [3, 0], source=[1, 2])
    for name, value in env.buffers().items():
        expected = now[name].clone()
        expected[3], expected[0] = before[name][1], before[name][2]
        assert torch.equal(value, expected), name


def test_attributes_that_describe_the_scene_stay_with_their_env(env: Any) -> None:
    env.write(1.0)
    restore_snapshot(env, take_snapshot(env, [3]), range(N))
    assert env.object_heights.tolist() == [0, 1, 2, 3]
    torch.testing.assert_close(env.reach_offset, torch.tensor([0.1, 0.2, 0.3, 0.4]))
    assert env.best_distance.tolist() == [4.0] * N


def test_buffers_unwritten_at_the_snapshot_return_to_their_built_values() -> None:
    env = batched(Remembers, N)
    env.reset(seed=[0, 1, 2, 3])
    snapshot = take_snapshot(env)
    env.filled_later += 7
    env.threshold = 1.0
    restore_snapshot(env, snapshot)
    assert env.filled_later.tolist() == [0.0] * N and env.threshold == 0.02
    env.close()


def test_changed_scene_attributes_return_to_that_envs_built_values() -> None:
    env = batched(Remembers, N)
    env.reset(seed=[0, 1, 2, 3])
    snapshot = take_snapshot(env, [3])
    env.object_heights = env.object_heights + 10
    restore_snapshot(env, snapshot, [1])
    assert env.object_heights.tolist() == [10, 1, 12, 13]
    env.close()


def test_batch_wide_attributes_are_restored_only_with_all_envs(env: Any) -> None:
    env.kept_tensor, env.written_tensor = torch.ones(3), torch.tensor(1)
    snapshot, count = take_snapshot(env), env.total_resets
    env.total_resets += 5
    env.written_tensor += 1
    report = restore_snapshot(env, snapshot, [0, 1])
    assert env.total_resets == count + 5
    assert "whole batch" in report.not_carried["total_resets"]
    assert "written_tensor" in report.not_carried and "kept_tensor" not in report.not_carried
    report = restore_snapshot(env, snapshot, range(N), source=2)
    assert env.total_resets == count and "total_resets" not in report.not_carried
    env.total_resets += 5
    restore_snapshot(env, snapshot)
    assert env.total_resets == count


def test_a_batch_wide_tensor_that_is_written_in_place_is_restored_again_and_again(env: Any) -> None:
    env.curriculum = torch.zeros(3)
    snapshot = take_snapshot(env)
    for _ in range(2):
        env.curriculum += 1
        restore_snapshot(env, snapshot)
        assert env.curriculum.tolist() == [0.0] * 3


def test_a_tensor_with_other_references_is_not_written_to(env: Any) -> None:
    env.write(1.0)
    snapshot = take_snapshot(env)
    theirs = torch.full((N,), 9.0)
    env.best_distance = theirs
    env.stage.reached = theirs
    restore_snapshot(env, snapshot, [0])
    assert theirs.tolist() == [9.0] * N
    assert env.best_distance.tolist() == [1.0, 9.0, 9.0, 9.0]


def test_evaluate_after_a_restore_leaves_all_counters(env: Any) -> None:
    task = TaskEnv(env, 50)
    task.reset(seed=0)
    env.write(1.0)
    snapshot, before = task.snapshot(), env.copied()
    task.step(None)
    later = env.copied()
    task.restore(snapshot, [2])
    for name, value in env.buffers().items():
        expected = later[name].clone()
        expected[2] = before[name][2]
        assert torch.equal(value, expected), name


class Edited(Remembers):
    """`Remembers` after an edit: constants changed, one buffer removed, one reshaped, one added."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.threshold = 0.05
        self.weight = 2.0

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        self.half = torch.zeros(self.num_envs, 2)
        self.velocity_bonus = torch.full((self.num_envs,), 3.0)
        if hasattr(self, "notes"):
            del self.notes

    def evaluate(self) -> dict:
        return PUSH_CUBE.evaluate(self)


def test_an_edited_task_keeps_its_constants_and_gets_the_buffers_that_fit(env: Any) -> None:
    env.write(1.0)
    snapshot = take_snapshot(env)
    edited = batched(Edited, N)
    edited.best_distance[:] = 0
    report = restore_snapshot(edited, snapshot)
    assert edited.threshold == 0.05 and edited.weight == 2.0
    assert edited.best_distance.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert edited.velocity_bonus.tolist() == [3.0] * N
    assert edited.half.shape == (N, 2)
    assert {"half", "notes.visits", "velocity_bonus"} <= report.not_carried.keys()
    edited.close()


class Late(PUSH_CUBE):
    """Attributes with a default on the class, which the first `evaluate` with `sets` gives a value."""

    best: Any = None
    words: Any = None
    limit: Any = None
    sets = False

    def evaluate(self) -> dict:
        if self.sets:
            self.best = torch.arange(self.num_envs) + 1.0
            self.words = [f"env {i}" for i in range(self.num_envs)]
            self.limit = torch.tensor([4.0, 5.0])
        return super().evaluate()


def test_attributes_that_an_env_has_not_set_yet_are_restored_with_all_envs_only() -> None:
    old, new = batched(Late, N), batched(Late, N)
    old.sets = True
    old.reset(seed=[0, 1, 2, 3])
    snapshot = take_snapshot(old)
    report = restore_snapshot(new, snapshot, [0, 1])
    assert new.best is new.words is new.limit is None
    assert {"best", "words", "limit"} <= report.not_carried.keys()
    report = restore_snapshot(new, snapshot, [3, 2, 1, 0], source=[0, 1, 2, 3])
    assert {"best", "words", "limit"} <= set(report.carried) and not report.not_carried
    assert new.best.tolist() == [4, 3, 2, 1] and new.words == ["env 3", "env 2", "env 1", "env 0"]
    assert new.limit.tolist() == [4, 5] and new.limit is not old.limit
    old.close()
    new.close()


class Point(NamedTuple):
    x: torch.Tensor
    label: str


def test_what_cannot_be_kept_is_named_and_the_rest_is_kept(env: Any) -> None:
    deep: Any = {"here": torch.zeros(N)}
    for _ in range(10):
        deep = {"in": deep}
    env.deep, env.odd = deep, np.array([object()] * N)
    env.data, env.data_each = torch.zeros(1 << 17), torch.zeros(N, 1 << 17)
    env.point = Point(torch.arange(N) + 1.0, "a")
    env.view = env.scene.px.cuda_rigid_body_data.torch()[:N]
    try:
        snapshot = take_snapshot(env)
        named = {*snapshot.omitted} - {"recent"}
        assert {name.partition("[")[0] for name in named} == {"deep", "odd", "data"}
        env.point = Point(torch.zeros(N), "b")
        env.data_each += 1
        report = restore_snapshot(env, snapshot, [1])
        assert named <= report.not_carried.keys()
        assert env.point.x.tolist() == [0, 2, 0, 0] and type(env.point) is Point
        assert env.data_each[:, 0].tolist() == [1, 0, 1, 1]
    finally:
        del env.deep, env.odd, env.data, env.data_each, env.point, env.view


def test_a_value_that_has_rows_now_is_not_replaced_by_one_for_the_batch(env: Any) -> None:
    env.scale, env.words = torch.zeros(3), ["a"] * N
    snapshot = take_snapshot(env)
    env.scale = torch.full((N,), 5.0)
    env.words = [f"{i}" for i in range(N)]
    report = restore_snapshot(env, snapshot)
    assert "scale" in report.not_carried and env.scale.tolist() == [5.0] * N
    assert env.words == ["a"] * N
    env.words = [f"{i}" for i in range(N)]
    restore_snapshot(env, snapshot, [2])
    assert env.words == ["0", "1", "a", "3"]
    env.words = env.words[:2]
    report = restore_snapshot(env, snapshot, [2])
    assert "words" in report.not_carried and env.words == ["0", "1"]
    del env.scale, env.words

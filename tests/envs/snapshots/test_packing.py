"""A packed snapshot unpacks to an equal snapshot, and unchanged parts are sent once."""

# A task's own attributes are not known to the checker.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.drive.envs import batched
from workbench.envs import action_vector as actions
from workbench.envs.snapshots.cpu_state import CpuState
from workbench.envs.snapshots.packing import PackedSnapshot, SnapshotPacker, WholeSnapshot, unpack_snapshot
from workbench.envs.snapshots.snapshot import Snapshot
from workbench.envs.task_env import TaskEnv

N = 4


@pytest.fixture(scope="module")
def task() -> Iterator[TaskEnv]:
    task = TaskEnv(batched("PickCube-v1", N), 50)
    yield task
    task.close()


class Receiver:
    """Stores and returns the parts of packed snapshots, as a server does."""

    def __init__(self) -> None:
        self.parts: dict[int, bytes] = {}
        self.keys: tuple[int, ...] = ()

    def take(self, packed: PackedSnapshot) -> list[bytes]:
        self.parts.update(packed.new_parts)
        self.keys = self.keys if packed.keys is None else packed.keys
        return [self.parts[key] for key in self.keys]


def same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if type(a) is not type(b):
        return False
    if hasattr(a, "__dataclass_fields__"):
        return all(same(getattr(a, name), getattr(b, name)) for name in a.__dataclass_fields__)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)  # type: ignore[union-attr]
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))  # type: ignore[arg-type]
    return a == b


def step(task: TaskEnv, rng: np.random.Generator) -> None:
    task.step(actions.random_action(task.parts, N, rng))


def test_snapshots_survive_packing_after_any_changes(task: TaskEnv) -> None:
    rng, packer, receiver = np.random.default_rng(0), SnapshotPacker(), Receiver()
    task.reset(seed=0)
    for number in range(30):
        step(task, rng)
        if number == 7:
            task.reset(seed=[3], env_idx=[2])
        if number == 12:
            task.env.best = torch.arange(N, dtype=torch.float32)
        if number == 15:
            task.env.best += 1
        if number == 18:
            del task.env.best
        if number == 21:
            task.env.best = torch.zeros(N)
        if number in (22, 26):  # the same bytes with another dtype
            task.env.count = np.zeros(N, np.float32 if number == 22 else np.int32)
        if number == 24:
            torch.rand(1)
            np.random.rand()
        snapshot = task.snapshot()
        packed = packer.pack(snapshot)
        assert same(unpack_snapshot(packed.body, receiver.take(packed)), snapshot), f"after step {number}"
        # A receiver may keep only the parts that the newest snapshot needs.
        receiver.parts = {key: receiver.parts[key] for key in receiver.keys}
    del task.env.best, task.env.count


def test_contacts_and_sleep_flags_stay_with_their_env(task: TaskEnv) -> None:
    """The envs differ: one holds an object, one pushes two, and one sleeps."""
    snapshot = task.snapshot()
    state = snapshot.simulation
    assert isinstance(state, CpuState)
    asleep = [
        tuple((part + env) % 3 == 0 for part in range(len(contents)))
        for env, contents in enumerate(state.contents)
    ]
    touching = (1, "cube", "panda/panda_leftfinger"), (1, "cube", "table"), (3, "cube", "table")
    impulses = np.arange(9, dtype=np.float32).reshape(3, 3)
    other = snapshot._replace(
        simulation=replace(state, asleep=tuple(asleep), touching=touching, impulses=impulses)
    )
    packed = SnapshotPacker().pack(other)
    assert same(unpack_snapshot(packed.body, Receiver().take(packed)), other)


def test_after_a_step_only_changes_are_sent(task: TaskEnv) -> None:
    rng, packer = np.random.default_rng(0), SnapshotPacker()
    task.reset(seed=0)
    step(task, rng)
    packer.pack(task.snapshot())
    step(task, rng)
    packer.pack(task.snapshot())
    step(task, rng)
    snapshot = task.snapshot()
    packed = packer.pack(snapshot)
    assert packed.keys is None and packed.new_parts == {}
    assert len(packed.body) < 0.2 * len(pickle.dumps(snapshot))


def test_a_buffer_of_the_task_that_stays_is_sent_once(task: TaskEnv) -> None:
    env: Any = task.env
    packer, receiver = SnapshotPacker(), Receiver()
    env.heights = torch.rand((N, 5000))
    try:
        task.reset(seed=0)
        bodies = []
        for number in range(4):
            if number == 3:
                env.heights = env.heights + 1
            packed = packer.pack(task.snapshot())
            bodies.append(len(packed.body) + sum(map(len, packed.new_parts.values())))
            read = unpack_snapshot(packed.body, receiver.take(packed))
            assert same(read, task.snapshot())
        assert bodies[2] < env.heights.nbytes / 4 < bodies[3], bodies
    finally:
        del env.heights


def test_snapshots_of_changing_sets_of_envs_survive_packing(task: TaskEnv) -> None:
    packer, receiver = SnapshotPacker(), Receiver()
    for chosen in ([0], [0, 1], [0, 1, 2, 3], [0, 1]):
        snapshot = task.snapshot(chosen)
        assert same(unpack_snapshot((packed := packer.pack(snapshot)).body, receiver.take(packed)), snapshot)


def test_whole_bytes_unpickle_as_a_snapshot(task: TaskEnv) -> None:
    snapshot = task.snapshot()
    packed = SnapshotPacker().pack(snapshot)
    whole = pickle.dumps(WholeSnapshot(packed.body, tuple(Receiver().take(packed))))
    back = pickle.loads(whole)
    assert isinstance(back, Snapshot) and same(back, snapshot)

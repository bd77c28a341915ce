"""Takes and restores snapshots of chosen envs, and steps some envs alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.envs import maniskill_private
from workbench.envs.indices import env_numbers, envs_of_batch
from workbench.envs.scene.scene_index import in_every_env, present_states, scene_index
from workbench.envs.simulation.cpu_system import batched_system
from workbench.envs.simulation.state_layout import BODY
from workbench.envs.snapshots.cpu_state import CpuState, make_cpu_exact_point, read_cpu_state, write_cpu_state
from workbench.envs.snapshots.rng_state import (
    RngReader,
    RngState,
    SharedRng,
    read_shared_rng,
    write_shared_rng,
)
from workbench.envs.snapshots.task_state import TaskState, read_task_state, write_task_state


class Memory(NamedTuple):
    """State of n envs that is not in the simulation."""

    elapsed_steps: NDArray[np.int32]
    """(n,) control steps since each env's reset."""
    episode_seeds: NDArray[np.int64]
    """(n,) from `maniskill_private.episode_seeds`."""
    rng: dict[str, list[RngState]]
    """(n,) states of ManiSkill's generators, one per env, by purpose (``episode``, ``main``)."""
    task: TaskState
    shared_rng: SharedRng


class Snapshot(NamedTuple):
    """Everything that decides how the episodes of chosen envs continue. Copies only: it can be pickled, and outlives its env.

    It holds PhysX's bodies, joints and drive targets (`cpu_state`), the tensors of the task and its
    controllers (`task_state`), elapsed steps and random generators (`rng_state`), with a row per env. So one
    env's state can be restored in place, into another env, or by name into an env that was built again.

    *Two restores of a snapshot continue identically*, to the last bit: a restored env gets a new PhysX scene.

    *A restore continues like the uninterrupted run* except for state that PhysX does not expose: contact caches, the order
    in which it solves contacts, and the last bit of an articulation's root. Nothing else is missing (tested: an
    uninterrupted run whose bodies move into a new scene, with no number written, continues like the restored one). After
    five steps the difference is zero for a cart-pole, 1e-3 rad of a joint where a hand holds or pushes, 2e-2 rad for a
    humanoid that lies on the ground, and unbounded where a fall or a slip depends on it
    (``tests/benchmarks/restore_distance.py``; figures in ``web_assets/docs/reference/task_ids.md``). Writing an earlier
    state and repeating the steps does not help. To continue exactly, take the snapshot at an *exact point* (`begin_anew`, or
    right after a restore) and repeat every step since then, as the session does (`live.worker.go_back`).
    """

    num_envs: int
    """N of the env from which the snapshot was taken."""
    env_idx: tuple[int, ...]
    """(n,) the envs in the snapshot."""
    simulation: CpuState | GpuState
    memory: Memory

    @property
    def omitted(self) -> dict[str, str]:
        """State of the task that could not be kept: path and reason."""
        return self.memory.task.omitted


@dataclass(frozen=True)
class RestoreReport:
    """What a restore wrote: actors, articulations, and attributes of the task by path."""

    carried: tuple[str, ...]
    not_carried: dict[str, str]
    """What was not restored: name and reason. Empty if a snapshot is restored where it was taken."""


def take_snapshot(env: Any, env_idx: Sequence[int] | int | None = None) -> Snapshot:
    """Copy the state of the envs in `env_idx`, or of all.

    Args:
        env: a ManiSkill env, batched on the CPU or on the GPU, reset at least once; wrappers are removed.

    Raises:
        IndexError, ValueError: `env_idx` names an unknown env, an env twice, or no env.
        NotImplementedError: `env` is a stock CPU env.
    """
    env = maniskill_private.open_env(env)
    chosen = [*range(env.num_envs)] if env_idx is None else envs_of_batch(env_idx, env.num_envs)
    px = batched_system(env.scene)
    if px is not None:
        simulation: Any = read_cpu_state(env, chosen)
    else:
        _require_gpu(env)
        simulation = read_gpu_state(env, chosen)
    return Snapshot(env.num_envs, tuple(chosen), simulation, take_memory(env, chosen))


def restore_snapshot(
    env: Any,
    snapshot: Snapshot,
    env_idx: Sequence[int] | int | None = None,
    source: int | Sequence[int] | None = None,
    fresh_physics: bool = True,
) -> RestoreReport:
    """Restore the state of a snapshot's envs into envs of `env`; other envs of `env` are not touched.

    ``restore_snapshot(env, s)`` restores every env; ``restore_snapshot(env, s, [7], source=3)`` puts env 3's state into
    env 7; ``restore_snapshot(env, s, range(env.num_envs), source=3)`` into all.

    `env` may be another env than that of the snapshot: the same task made again, or an edited task. Then
    actors and articulations are matched by name, articulations also by the names of their joints, and
    attributes of the task by name and shape. What the task keeps for a whole batch (counters, a controller's
    step) is restored only if all envs are restored. The process's random generators are restored only if, in
    addition, each env gets its own state back and the env of the snapshot had as many envs as `env`.

    Afterwards the tensors, poses and contact queries are those of the restored moment, but ``env._last_obs``
    is not. Call ``env.get_obs(env.get_info())`` for the observation, or use `TaskEnv.restore`, which observes
    too.

    Args:
        env_idx: the envs to restore; None for those of the snapshot.
        source: the env in the snapshot whose state all envs of `env_idx` get, or a list with one such env for
            each. None: each env gets its own state; if the snapshot has a single env, all get the state of
            that env.
        fresh_physics: give the envs a new PhysX scene, so that they continue identically, to the last bit.
            Without it, a restore is several times as fast, and later contacts may be solved in another order
            (`renew_physics`).

    Raises:
        IndexError, ValueError: `env_idx` or `source` names an env that does not exist, or their lengths differ.
        TypeError: the snapshot is of a GPU env and `env` is on the CPU, or the reverse.
    """
    env = maniskill_private.open_env(env)
    if not isinstance(snapshot, Snapshot):
        raise TypeError(f"expected a Snapshot from take_snapshot, not {type(snapshot).__name__}")
    targets, positions = _pairs(env, snapshot, env_idx, source)
    px = batched_system(env.scene)
    state: Any = snapshot.simulation
    if isinstance(state, CpuState) != (px is not None):
        raise TypeError("a snapshot of CPU simulation cannot be restored in GPU simulation, or the reverse")
    if px is not None:
        carried, missed = write_cpu_state(env, targets, state, positions, fresh_physics)
    else:
        _require_gpu(env)
        carried, missed = write_gpu_state(env, targets, state, positions)
    # All envs, each with its own state, in any order.
    whole = snapshot.num_envs == env.num_envs == len(targets) and all(
        snapshot.env_idx[k] == i for i, k in zip(targets, positions, strict=True)
    )
    more, less = restore_memory(env, snapshot.memory, targets, positions, whole)
    return RestoreReport((*carried, *more), {**missed, **less})


def begin_anew(env: Any, env_idx: list[int]) -> None:
    """Make the present state an exact point of these envs, in new PhysX scenes whose state reads back as
    written.

    From an exact point, a snapshot and the same actions give the same bits as the uninterrupted run.

    Args:
        env: batched on the CPU and reset at least once; wrappers are removed.
    """
    make_cpu_exact_point(maniskill_private.open_env(env), env_idx)


def in_this_state(env: Any, env_idx: int, snapshot: Snapshot, source: int) -> bool:
    """Whether an env's PhysX state equals that of env `source` of the snapshot, to the last byte."""
    wanted: Any = snapshot.simulation
    k = snapshot.env_idx.index(source)
    return read_cpu_state(env, [env_idx]).essence(0) == wanted.essence(k)


def take_memory(env: BaseEnv, env_idx: list[int]) -> Memory:
    """Copy the state that is not in the simulation; see `Memory`."""
    seeds = maniskill_private.episode_seeds(env)
    reader = _rng_readers.setdefault(env, RngReader())
    generators = maniskill_private.episode_generators(env)
    return Memory(
        elapsed_steps=env.elapsed_steps.cpu().numpy()[env_idx].astype(np.int32),
        episode_seeds=np.zeros(len(env_idx), np.int64)
        if seeds is None
        else np.array(seeds, np.int64)[env_idx],
        rng={name: _chosen(reader.read(name, every), env_idx) for name, every in generators.items()},
        task=read_task_state(env, env_idx),
        shared_rng=read_shared_rng(env.device),
    )


@contextmanager
def remembering(env: BaseEnv) -> Iterator[None]:
    """Context that restores the task's memory at its end: a hook may count or draw random numbers, which must
    not happen twice in a step."""
    every = list(range(env.num_envs))
    memory = take_memory(env, every)
    try:
        yield
    finally:
        restore_memory(env, memory, every, every, whole=True)


def restore_memory(
    env: BaseEnv, memory: Memory, env_idx: list[int], positions: list[int], whole: bool
) -> tuple[dict[str, None], dict[str, str]]:
    """Put entry ``positions[k]`` of `memory` into env ``env_idx[k]``; returns what was carried and what was not.

    Args:
        whole: whether each env gets its own state back; if so, restore the process's random generators too.
    """
    steps = env.elapsed_steps
    steps[env_idx] = steps.new_tensor(memory.elapsed_steps[positions])
    maniskill_private.keep_episode_seeds(env, env_idx, memory.episode_seeds[positions])
    reader = _rng_readers.setdefault(env, RngReader())
    generators = maniskill_private.episode_generators(env)
    for name, states in memory.rng.items():
        reader.write(name, generators[name], env_idx, _chosen(states, positions))
    if whole:
        write_shared_rng(memory.shared_rng, env.device)
    return write_task_state(env, memory.task, env_idx, positions)


_rng_readers: WeakKeyDictionary[Any, RngReader] = WeakKeyDictionary()


def _chosen(items: list[RngState], positions: list[int]) -> list[RngState]:
    return [items[k] for k in positions]


def _require_gpu(env: BaseEnv) -> None:
    if not env.scene.gpu_sim_enabled:
        raise NotImplementedError(
            "snapshots need a batched env: make it with workbench.make (num_envs=1 is enough)"
        )


def _pairs(
    env: BaseEnv, snapshot: Snapshot, env_idx: Sequence[int] | int | None, source: int | Sequence[int] | None
) -> tuple[list[int], list[int]]:
    """The envs to restore, and for each of them the position of its source env in the snapshot."""
    if env_idx is None and source is not None:
        raise ValueError("source needs env_idx: name the envs that get the state")
    if env_idx is None and max(snapshot.env_idx) >= env.num_envs:
        raise IndexError(
            f"the snapshot holds envs {list(snapshot.env_idx)}, but this env has only {env.num_envs}: pass env_idx, the envs "
            "to restore, and source, the envs of the snapshot to copy from"
        )
    targets = envs_of_batch(snapshot.env_idx if env_idx is None else env_idx, env.num_envs)
    if source is None:
        sources = [snapshot.env_idx[0]] * len(targets) if len(snapshot.env_idx) == 1 else targets
    else:
        sources = env_numbers(source)
        if np.ndim(source) == 0:
            sources *= len(targets)
    if len(sources) != len(targets):
        raise ValueError(
            f"{len(sources)} sources for {len(targets)} envs: give one for each, or a single number"
        )
    position = {i: k for k, i in enumerate(snapshot.env_idx)}
    missing = sorted(set(sources) - set(position))
    if missing:
        raise IndexError(
            f"the snapshot was taken of envs {list(snapshot.env_idx)}: it has no state of {missing}"
        )
    return targets, [position[i] for i in sources]


# --- some envs alone ---------------------------------------------------------------------------------


@contextmanager
def step_only(env: Any, env_idx: Sequence[int], others: Snapshot | None) -> Iterator[None]:
    """Context in which control steps move these envs only.

    The task's hooks run for all envs or for none. But on the CPU PhysX has a scene per env, and the scenes of
    the other envs are not stepped. What hooks changed in those envs (a counted step, targets, a buffer) is
    restored from `others`. The physics of an env is restored only if a hook wrote to it: writing even the
    present state wakes sleeping bodies. In GPU simulation all envs step, and the others are restored.

    Args:
        others: a snapshot of all other envs, restored at the end; None if their state does not matter.
    """
    px = batched_system(env.scene)
    if px is None:
        try:
            yield
        finally:
            if others is not None:
                restore_snapshot(env, others)
        return
    before = px.packs()
    px.freeze_envs(set(range(env.num_envs)) - {int(i) for i in env_idx})
    try:
        yield
    finally:
        now = px.packs()
        px.freeze_envs(())
        if others is not None:
            still = [i for i in others.env_idx if now[i] == before[i]]
            moved = [i for i in others.env_idx if now[i] != before[i]]
            if moved:
                restore_snapshot(env, others, moved, moved, fresh_physics=False)
            if still:
                positions = [others.env_idx.index(i) for i in still]
                restore_memory(env, others.memory, still, positions, whole=False)
            env.scene._gpu_fetch_all()


# --- simulation state of ManiSkill's GPU simulation -------------------------------------------------


_JOINT_TENSORS = ("qf", "target_qpos", "target_qvel")
"""Tensors of an articulation that a snapshot has in addition to ``get_state()``: ``px.cuda_articulation_NAME``."""


@dataclass(frozen=True)
class GpuState:
    """The simulation state of n envs: the tensors that ManiSkill reads and writes, by name.

    Other state of PhysX on the device (contacts, sleep) cannot be read.
    """

    states: dict[str, NDArray[np.float32]]
    """(n, 13) of each actor: position, quaternion wxyz, linear and angular velocity; (n, 13 + 5 D) of each
    articulation: the same of the root, then qpos, qvel, and `_JOINT_TENSORS`. By the names of
    `SceneIndex.states`; NaN for an env that lacks the actor or articulation."""


def read_gpu_state(env: Any, env_idx: list[int]) -> GpuState:
    """The simulation state of the envs in `env_idx`."""
    states, structs = present_states(env), scene_index(env).states
    for name, state in states.items():
        width = maniskill_private.joints_of(structs[name])
        tensors = _joint_tensors(env) if width else ()
        rows = [t[maniskill_private.data_rows_of_articulation(structs[name]).long(), :width] for t in tensors]
        every = [torch.as_tensor(state), *(in_every_env(env, structs[name], row) for row in rows)]
        states[name] = torch.hstack(every).cpu().numpy()[env_idx]
    return GpuState(states)


def write_gpu_state(
    env: Any, env_idx: list[int], state: GpuState, positions: list[int]
) -> tuple[dict[str, None], dict[str, str]]:
    """Put env ``positions[j]`` of `state` into env ``env_idx[j]``, apply and fetch; returns like
    `write_cpu_state`."""
    carried: dict[str, None] = {}
    missed: dict[str, str] = {}
    position, structs = dict(zip(env_idx, positions, strict=True)), scene_index(env).states
    for name, rows in state.states.items():
        if name not in structs and not np.isnan(rows[positions]).all():
            missed[_plain_name(name)] = "this env has no actor or articulation of this name"
    for name, struct in structs.items():
        width = maniskill_private.joints_of(struct)
        kept = state.states.get(name, np.zeros((0, 0), np.float32))
        # Lowest env first, the order of rows in ManiSkill's setters.
        targets = [i for i in maniskill_private.envs_of(struct).tolist() if i in position]
        fits = kept.shape[1] == BODY + (2 + len(_JOINT_TENSORS)) * width
        fitting = [i for i in targets if fits and not np.isnan(kept[position[i]]).any()]
        if len(fitting) < len(targets):
            missed[_plain_name(name)] = (
                "the snapshot has no actor or articulation of this name and shape; left unchanged"
            )
        if not fitting:
            continue
        carried[_plain_name(name)] = None
        values = torch.from_numpy(kept[[position[i] for i in fitting]]).to(env.device)
        struct.set_state(values[:, : BODY + 2 * width], torch.tensor(fitting, device=env.device))
        if width:
            own = np.flatnonzero(np.isin(maniskill_private.envs_of(struct), fitting)).tolist()
            index = maniskill_private.data_rows_of_articulation(struct).long()[own]
            parts = values[:, BODY + 2 * width :].split(width, dim=1)
            for tensor, part in zip(_joint_tensors(env), parts, strict=True):
                tensor[index, :width] = part
    maniskill_private.apply_and_fetch(env)
    return carried, missed


def _plain_name(name: str) -> str:
    kind, _, own = name.partition("/")
    return f"{kind.removesuffix('s')} {own}"


def _joint_tensors(env: Any) -> list[torch.Tensor]:
    return [getattr(env.scene.px, f"cuda_articulation_{name}").torch() for name in _JOINT_TENSORS]

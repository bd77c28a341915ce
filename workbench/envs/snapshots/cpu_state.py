"""Reads the simulation state of chosen envs of a `BatchedCpuSystem`, and writes it into the same or other envs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate
from typing import Any

import numpy as np
import sapien
import sapien.physx as physx
from numpy.typing import NDArray

from workbench.envs.backends import give_brdf_table
from workbench.envs.rendering.camera_shader import made_again
from workbench.envs.scene.scene_index import once_a_scene, scene_index
from workbench.envs.simulation.cpu_system import BatchedCpuSystem, batched_system
from workbench.envs.simulation.state_layout import BODY

_ROOT_POSE_ATTEMPTS = 4
"""Maximum attempts to set a root pose; two were enough in all tasks that were tried."""
_EXACT_POINT_ATTEMPTS = 40
"""Maximum attempts to find a state that reads back as written; one is enough for all but some humanoids."""
_LAST_BIT = np.float32(2**-24)
"""Last bit (2**-24) of the numbers of a quaternion, and of a position of about a metre."""


@dataclass(frozen=True)
class PackedPart:
    """A body or an articulation in the packed state of an env."""

    name: str
    joints: tuple[str, ...] | None
    """Names of the active joints of an articulation; None for a body."""

    @property
    def size(self) -> int:
        """Count of numbers (float32) of the part in the packed state."""
        return BODY + (0 if self.joints is None else 4 * len(self.joints))

    def __str__(self) -> str:
        return f"{'actor' if self.joints is None else 'articulation'} {self.name}"


Contents = tuple[PackedPart, ...]
"""Contents of an env's packed state, in order: bodies, then articulations."""


@dataclass(frozen=True)
class CpuState:
    """The simulation state of n envs, as columns.

    ``PhysxCpuSystem.pack()`` has pose and velocity of every body, qpos, qvel and drive targets. This state
    adds:

    * *Names*: bytes of two envs mean the same only if the envs have the same parts, which `Contents` lists.
      Where the parts differ, the bytes to write are assembled from those of the env that is restored and
      those of the snapshot.
    * *Sleep*: writing a pose wakes a body, which then moves by micrometres. Bodies that slept are put to
      sleep again. Each body is queried (2 us each), because a velocity in the pack does not mean that the
      body is awake (cubes of StackCube sleep with some velocity left).
    * *Forces* of ``set_qf``.
    * *Contacts*: after a restore PhysX's list is that of another moment, and ``is_grasping`` would be wrong.
      The counted impulses are part of this state, and answer queries until the next substep.
    * *Poses of static actors*, if the task has moved one.
    """

    contents: tuple[Contents, ...]
    """(n,)"""
    packed: tuple[bytes, ...]
    """(n,) as ``PhysxCpuSystem.pack()`` gives it."""
    asleep: tuple[tuple[bool, ...], ...]
    """(n,) for each env: whether each of its `contents` sleeps."""
    qf: NDArray[np.float32]
    """(A, D) joint forces of the articulations of all n envs, env after env, padded with zeros."""
    touching: tuple[tuple[int, str, str], ...]
    """(T,) contacts that a query counts: index among the n envs, and the names of two bodies."""
    impulses: NDArray[np.float32]
    """(T, 3) newton seconds on the first body of each contact."""
    statics: tuple[dict[str, tuple[float, ...]], ...]
    """(n,) poses (7,) of static actors, by name; empty if no static actor was ever moved."""

    def articulations(self, k: int) -> slice:
        """Rows of `qf` of the articulations of the k-th of the n envs."""
        first = sum(_articulations(contents) for contents in self.contents[:k])
        return slice(first, first + _articulations(self.contents[k]))

    def essence(self, k: int) -> tuple[Any, ...]:
        """A value for the k-th of the n envs; equal PhysX states give equal values."""
        rows = self.articulations(k)
        return self.contents[k], self.packed[k], self.asleep[k], self.qf[rows].tobytes(), self.statics[k]


def _articulations(contents: Contents) -> int:
    return sum(part.joints is not None for part in contents)


@dataclass
class CpuStatePlan:
    """Parts, bodies and rows of each env of a built scene."""

    contents: list[Contents]
    """Contents of each env; envs with the same parts share one object."""
    sleepers: list[list[tuple[int, Callable[[], bool], Any]]]
    """For each env: index into its contents, function that returns whether the part sleeps, component that can be put
    to sleep."""
    articulations: list[range]
    """Rows of each env in the (A, D) tensors."""
    names: dict[int, tuple[int, str]]
    """Env and name of a body, by the ``id`` of its component."""
    bodies: list[dict[str, int]]
    """``id`` of each component by its name, for each env."""
    statics: list[dict[str, Any]]
    """Entities of static actors by name, for each env."""
    held: list[Any]
    """Objects whose ids are used, kept alive: ids are reused once an object is gone."""
    settled: list[dict[int, tuple[bytes, bytes]]]
    """For each env, by offset in its packed bytes: a root pose, and the pose to set so that PhysX
    returns that root pose."""


@once_a_scene
def plan_cpu_state(env: Any) -> CpuStatePlan:
    """The plan of an env's present scene, for `read_cpu_state` and `write_cpu_state`."""
    px = batched_system(env.scene)
    assert px is not None, "only for the batched CPU simulation"
    scene = scene_index(env)

    def name_of(component: Any) -> str:
        return scene.name_of(component) or component.entity.name

    alike: dict[Contents, Contents] = {}
    plan = CpuStatePlan([], [], [], {}, [], [], [], [{} for _ in px.systems])
    first_articulation = 0
    for index, system in enumerate(px.systems):
        bodies, links = system.rigid_dynamic_components, system.articulation_link_components
        statics = system.rigid_static_components
        plan.held += [*bodies, *links, *statics]
        by_name = {name_of(c): id(c) for c in [*statics, *links, *bodies]}
        plan.bodies.append(by_name)
        plan.statics.append({name_of(c): c.entity for c in statics})
        plan.names.update({component: (index, name) for name, component in by_name.items()})
        parts, sleepers = [], []
        for body in bodies:
            if not body.kinematic:
                sleepers.append((len(parts), _getter(body, "is_sleeping"), body))
            parts.append(PackedPart(name_of(body), None))
        roots = [link for link in links if link.is_root]
        for root in roots:
            articulation: Any = root.articulation
            name = name_of(root).rpartition("/")[0] or articulation.name
            sleepers.append((len(parts), _getter(root, "sleeping"), root))
            # Joints of SAPIEN's "scene-0_panda" are called "scene-0-panda_panda_joint1".
            prefix = articulation.name.replace("_", "-", 1) + "_"
            joints = tuple(joint.name.removeprefix(prefix) for joint in articulation.active_joints)
            parts.append(PackedPart(name, joints))
        contents = tuple(parts)
        plan.contents.append(alike.setdefault(contents, contents))
        plan.sleepers.append(sleepers)
        plan.articulations.append(range(first_articulation, first_articulation + len(roots)))
        first_articulation += len(roots)
    return plan


def _getter(component: Any, name: str) -> Callable[[], bool]:
    # Called for every body at every snapshot, so the property is looked up only once.
    return partial(getattr(type(component), name).fget, component)


def read_cpu_state(env: Any, env_idx: list[int]) -> CpuState:
    """The simulation state of the envs in `env_idx`."""
    px: BatchedCpuSystem = env.scene.px
    plan = plan_cpu_state(env)
    packs = px.packs()
    awake = {len(contents): (False,) * len(contents) for contents in plan.contents}
    asleep = []
    for i in env_idx:
        sleeping = {part for part, is_asleep, _ in plan.sleepers[i] if is_asleep()}
        parts = len(plan.contents[i])
        asleep.append(tuple([part in sleeping for part in range(parts)]) if sleeping else awake[parts])
    rows = [row for i in env_idx for row in plan.articulations[i]]
    touches = _touching(px, plan, env_idx)
    return CpuState(
        contents=tuple([plan.contents[i] for i in env_idx]),
        packed=tuple([packs[i] for i in env_idx]),
        asleep=tuple(asleep),
        qf=px.cuda_articulation_qf.torch().numpy()[rows],
        touching=tuple([touch for touch, _ in touches]),
        impulses=np.array([impulse for _, impulse in touches], np.float32).reshape(-1, 3),
        statics=tuple(
            [_poses(plan.statics[i]) for i in env_idx] if px.static_moves else [{} for _ in env_idx]
        ),
    )


def _poses(entities: dict[str, Any]) -> dict[str, tuple[float, ...]]:
    return {name: tuple(map(float, (*e.pose.p, *e.pose.q))) for name, e in entities.items()}


def write_cpu_state(
    env: Any, env_idx: list[int], state: CpuState, positions: list[int], fresh_physics: bool
) -> tuple[dict[str, None], dict[str, str]]:
    """Put env ``positions[j]`` of `state` into env ``env_idx[j]``, and fetch the tensors. Other envs are not touched.

    Returns:
        Names of the carried parts, and of the parts that were not carried, with the reason.
    """
    carried: dict[str, None] = {}
    missed: dict[str, str] = {}
    px: BatchedCpuSystem = env.scene.px
    plan = plan_cpu_state(env)
    own = px.packs()
    for i in env_idx:
        for _, _, component in plan.sleepers[i]:
            # Without this, the time until the body sleeps depends on its earlier contacts: a cube that had
            # been in a hand fell asleep one substep later than another cube.
            component.put_to_sleep()
    if fresh_physics:
        for i in renew_physics(env.scene, env_idx):
            missed[f"fresh physics of env {i}"] = "entities were removed from its scene since it was built"
    packed: dict[int, bytes] = {}
    matches: dict[int, Sequence[int | None]] = {}
    alike: dict[int, Contents] = {}
    for i, k in zip(env_idx, positions, strict=True):
        contents, packed[i] = plan.contents[i], state.packed[k]
        if state.contents[k] == contents:
            alike[id(contents)], matches[i] = contents, range(len(contents))
        else:
            packed[i], matches[i] = _joined(contents, own[i], state, k, carried, missed)
    for i, k in zip(env_idx, positions, strict=True):
        there = _poses(plan.statics[i]) if state.statics[k] else {}
        for name, pose in state.statics[k].items():
            if there.get(name, pose) != pose:
                plan.statics[i][name].pose = sapien.Pose(pose[:3], pose[3:])
                px.static_moves += 1
    _unpack(px, plan, packed)
    _write_joint_forces(px, plan, dict(zip(env_idx, positions, strict=True)), state, matches, fresh_physics)
    touches: dict[int, list[tuple[str, str, Any]]] = {}
    for (k, first, second), impulse in zip(state.touching, state.impulses, strict=True):
        touches.setdefault(k, []).append((first, second, impulse))
    for i, k in zip(env_idx, positions, strict=True):
        slept = {part.name for part, asleep in zip(state.contents[k], state.asleep[k], strict=True) if asleep}
        for part, _, component in plan.sleepers[i] if slept else ():
            if plan.contents[i][part].name in slept:
                component.put_to_sleep()
        ids = plan.bodies[i]
        known = [touch for touch in touches.get(k, ()) if touch[0] in ids and touch[1] in ids]
        px.contacts.carry(i, [((ids[a], ids[b]), impulse) for a, b, impulse in known])
    env.scene._gpu_fetch_all()
    carried.update({str(part): None for contents in alike.values() for part in contents})
    return carried, missed


def make_cpu_exact_point(env: Any, env_idx: list[int]) -> None:
    """Give these envs a new PhysX scene with their present state.

    Restoring a snapshot that is taken right after this call, and repeating the actions, gives the same run to
    the last bit. If PhysX returns an articulation's root pose with other last bits than were set, these bits
    are changed until PhysX returns what is set.
    """
    left, state, dice = env_idx, read_cpu_state(env, env_idx), np.random.default_rng(0)
    positions = list(range(len(env_idx)))
    for attempt in range(_EXACT_POINT_ATTEMPTS):
        write_cpu_state(env, left, state, positions, fresh_physics=True)
        found = read_cpu_state(env, left)
        other = [j for j, k in enumerate(positions) if found.packed[j] != state.packed[k]]
        if not other:
            return
        left, state, positions = [left[j] for j in other], found, other
        if attempt > 0:
            moved = {k: _nudged(found.contents[k], found.packed[k], dice) for k in other}
            state = replace(found, packed=tuple(moved.get(k, was) for k, was in enumerate(found.packed)))


def _nudged(contents: Contents, packed: bytes, dice: np.random.Generator) -> bytes:
    numbers = np.frombuffer(packed, dtype=np.float32).copy()
    at = 0
    for part in contents:
        if part.joints is not None:
            numbers[at : at + 7] += _LAST_BIT * dice.integers(-2, 3, 7).astype(np.float32)
        at += part.size
    return numbers.tobytes()


def _unpack(px: BatchedCpuSystem, plan: CpuStatePlan, packed: dict[int, bytes]) -> None:
    """Write packed states into envs so that each reads back as packed."""
    for i, wanted in packed.items():
        px.systems[i].unpack(_asked_for(plan, i, wanted))
    px.note_change()
    got = px.packs()
    unsettled = [i for i, wanted in packed.items() if got[i] != wanted]
    for i in unsettled:
        _settle_roots(px, plan, i, packed[i])
    if unsettled:
        px.note_change()


def _write_joint_forces(
    px: BatchedCpuSystem,
    plan: CpuStatePlan,
    sources: dict[int, int],
    state: CpuState,
    matches: dict[int, Sequence[int | None]],
    fresh_physics: bool,
) -> None:
    """Write the forces of ``set_qf`` into each env.

    Args:
        sources: by env, the position in `state` of the env whose forces it gets.
        matches: by env, as returned by `_joined`.
    """
    rows, theirs = [], []
    firsts = list(accumulate(map(_articulations, state.contents), initial=0))
    for i, k in sources.items():
        bodies, their_bodies = (len(c) - _articulations(c) for c in (plan.contents[i], state.contents[k]))
        first = firsts[k] - their_bodies
        for row, match in zip(plan.articulations[i], matches[i][bodies:], strict=True):
            if match is not None:
                rows.append(row)
                theirs.append(first + match)
    qf = px.cuda_articulation_qf.torch().numpy()
    width = min(qf.shape[1], state.qf.shape[1])
    qf[rows, :width] = state.qf[theirs, :width]
    px.gpu_apply_articulation_qf()
    if fresh_physics and qf.any():
        for row in (row for i in sources for row in plan.articulations[i]):
            if qf[row].any():  # a new scene has no joint forces, even if the tensor did not change
                px.articulation(row).set_qf(qf[row, : px.articulation(row).dof])


def _asked_for(plan: CpuStatePlan, env: int, packed: bytes) -> bytes:
    """The bytes to write so that `packed` is read back: with the root poses that `_settle_roots` found."""
    for at, (wanted, asked) in plan.settled[env].items():
        if packed[at : at + len(wanted)] == wanted:
            packed = packed[:at] + asked + packed[at + len(wanted) :]
    return packed


def _settle_roots(px: BatchedCpuSystem, plan: CpuStatePlan, env: int, packed: bytes) -> None:
    """Make articulations' root poses read back as packed.

    PhysX stores a root by its centre of mass, and returns a pose with another last bit; the error adds up
    over snapshots of snapshots. So the pose is set with the opposite error. The result is cached, because
    most roots do not move.
    """
    numbers = np.frombuffer(packed, dtype=np.float32)
    at = sum(part.size for part in plan.contents[env] if part.joints is None)
    roots = [part for part in plan.contents[env] if part.joints is not None]
    for row, part in enumerate(roots, plan.articulations[env].start):
        articulation = px.articulation(row)
        wanted = numbers[at : at + 7]
        asked = wanted
        for _ in range(_ROOT_POSE_ATTEMPTS):
            got = _packed_pose(articulation.root_pose)
            if np.array_equal(got, wanted):
                break
            asked = asked + (wanted - got)
            articulation.root_pose = sapien.Pose(asked[4:], asked[:4])  # type: ignore[arg-type]
        else:
            asked = wanted
        if asked is not wanted:
            plan.settled[env][at * wanted.itemsize] = wanted.tobytes(), asked.tobytes()
        at += part.size


def _packed_pose(pose: sapien.Pose) -> NDArray[np.float32]:
    return np.concatenate([pose.q, pose.p])


def _joined(
    contents: Contents,
    own: bytes,
    state: CpuState,
    k: int,
    carried: dict[str, None],
    missed: dict[str, str],
) -> tuple[bytes, list[int | None]]:
    """Packed bytes for an env that is built differently from env k of `state`; and for each part of the env,
    the index of the same part in env k, or None."""
    numbers = np.frombuffer(own, dtype=np.float32).copy()
    parts, theirs = state.contents[k], np.frombuffer(state.packed[k], dtype=np.float32)
    starts = np.cumsum([0, *(part.size for part in parts)])
    index_of = {(part.name, part.joints is None): k for k, part in enumerate(parts)}
    matches: list[int | None] = []
    at = 0
    for part in contents:
        source = index_of.pop((part.name, part.joints is None), None)
        if source is None:
            missed[str(part)] = "it is not in the snapshot; left unchanged"
        elif parts[source].joints != part.joints:
            missed[str(part)] = "its joints differ from those in the snapshot; left unchanged"
            source = None
        else:
            numbers[at : at + part.size] = theirs[starts[source] : starts[source] + part.size]
            carried[str(part)] = None
        matches.append(source)
        at += part.size
    for source in index_of.values():
        missed[str(parts[source])] = "this env has no actor or articulation of this name"
    return numbers.tobytes(), matches


def _touching(
    px: BatchedCpuSystem, plan: CpuStatePlan, env_idx: list[int]
) -> list[tuple[tuple[int, str, str], NDArray[np.float32]]]:
    position = {i: k for k, i in enumerate(env_idx)}
    found = []
    for (first, second), impulse in px.contacts.counted():
        # Only bodies of this scene have names.
        if first in plan.names and second in plan.names and plan.names[first][0] in position:
            index, name = plan.names[first]
            found.append(((position[index], name, plan.names[second][1]), impulse))
    return found


# --- a new PhysX scene --------------------------------------------------------------------------------


def renew_physics(scene: Any, env_idx: list[int]) -> list[int]:
    """Give these envs of a batched CPU scene a new PhysX scene.

    PhysX solves contacts in the order of numbers that it assigns to pairs of shapes, and reuses freed numbers, last freed
    first. So the last bits of a result depend on every contact that the scene ever had, and no call resets that (tried:
    ``unpack``, moving everything apart and together). The same grasp, written twice into the same env, continued differently
    in five of eight envs. So the env's entities move, in order, into a new ``sapien.Scene`` with a new ``PhysxCpuSystem``
    and the same ``RenderSystem``: 0.2 ms for a Panda, a table and a cube. SAPIEN's components stay the same Python objects.

    Poses, velocities and drive targets stay; joint forces (``set_qf``) and contacts are gone.

    Args:
        scene: the env's ``ManiSkillScene``, over a `BatchedCpuSystem`.

    Returns:
        Envs that were left unchanged: entities were removed from them since they were built, so SAPIEN would renumber the
        remaining entities, and ManiSkill's segmentation pictures name bodies by number.
    """
    px: BatchedCpuSystem = scene.px
    px.packs()  # makes the old systems do their pending substeps
    default = physx.get_scene_config()
    left = [i for i in env_idx if not _keeps_entity_ids(px.scenes[i])]
    try:
        for i in sorted(set(env_idx) - set(left)):
            old = px.systems[i]
            # A new system takes gravity and solver from the process's default config, which may be that of
            # another env.
            physx.set_scene_config(old.config)
            system = physx.PhysxCpuSystem()
            system.timestep = old.timestep
            scene.sub_scenes[i] = _moved(px.scenes[i], system)
            px.replace(i, scene.sub_scenes[i])
    finally:
        physx.set_scene_config(default)
    px.note_change()
    return left


def _keeps_entity_ids(scene: sapien.Scene) -> bool:
    return [entity.per_scene_id for entity in scene.entities] == [*range(1, len(scene.entities) + 1)]


def _moved(old: sapien.Scene, physics: physx.PhysxCpuSystem) -> sapien.Scene:
    """A scene with the system `physics`, and with all entities of `old`, in their order, and its render
    system."""
    entities = old.entities
    systems = _render_systems(old)
    cameras = [camera for system in systems for camera in system.cameras]
    new = sapien.Scene([physics, *systems])
    for entity in entities:
        entity.remove_from_scene()
    carriers = [camera.entity for camera in cameras]
    for entity, camera in zip(carriers, cameras, strict=True):
        entity.remove_component(camera)
    for entity in entities:
        new.add_entity(entity)
    for entity, camera in zip(carriers, cameras, strict=True):
        # Add cameras one by one, since two cameras of an entity may have different shaders.
        with made_again(camera):
            entity.add_component(camera)
        give_brdf_table(camera)  # the camera has a new renderer, which would compute a table for seconds
    return new


def _render_systems(scene: sapien.Scene) -> list[Any]:
    try:
        return [scene.render_system]
    except RuntimeError:
        return []  # made without rendering; SAPIEN offers no way to ask

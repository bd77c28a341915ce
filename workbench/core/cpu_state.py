"""The simulation state of chosen envs of a `BatchedCpuSystem`: read, and written into the same or other envs.

``PhysxCpuSystem.pack()`` has the pose and velocity of every body, qpos, qvel and the drive targets of an
env, and ``unpack()`` writes them; after a control step the bytes are there already. What is added here:

* *Names.* The bytes of two envs mean the same only if the envs are built alike. `Contents` says what
  they mean, by the names that the rest of the workbench uses; where they differ (another task, an object more,
  an arm with another joint), the bytes for the target are put together from its own and the source's.
* *Sleep.* Writing a pose wakes a body, and a body at rest that wakes moves by some micrometres before it
  sleeps again. What slept is put to sleep again. Every body is asked, 2 us each: a velocity in the pack does
  not mean that one is awake (cubes of StackCube fall asleep with some left, and keep it).
* *Forces* that ``set_qf`` left on the joints, and which drives were ever set (`BatchedCpuSystem.drive_flags`).
* *Contacts.* PhysX lists contacts of the last substep only, so after a restore its list is that of another
  moment, and ``is_grasping`` would answer for it. The impulses that the task's queries count go along, and are
  what the queries see until the next substep.
* *Hidden objects* are drawn 99999 m away; it is their true pose that is kept.

``unpack`` does not quite give back the bits that ``pack`` gave (`_settle_roots`). What PhysX keeps to itself
is described in `snapshot` and `fresh_physics`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import sapien
from numpy.typing import NDArray

from workbench.core.cpu_layout import BODY
from workbench.core.cpu_system import BatchedCpuSystem
from workbench.core.fresh_physics import renew_physics
from workbench.core.scene_index import hidden_poses, once_a_scene, scene_index
from workbench.core.seams import batched_system

_ATTEMPTS = 4
"""How often a root pose is asked for; in all tasks that were tried, two were enough."""
_TRIES = 40
"""How often a state is looked for that reads back as it was written; all but some humanoids need one."""
_LAST_BIT = np.float32(2**-24)
"""Of the numbers of a quaternion, and of a metre."""
_FAR = np.float32(99999)
"""By how much ``Actor.hide_visual`` moves an actor along each axis, metres."""


@dataclass(frozen=True)
class Part:
    """A body or an articulation in the packed state of an env."""

    name: str
    joints: tuple[str, ...] | None
    """Names of the active joints of an articulation; None for a body."""

    @property
    def size(self) -> int:
        """How many float32 it takes."""
        return BODY + (0 if self.joints is None else 4 * len(self.joints))

    def __str__(self) -> str:
        return f"{'actor' if self.joints is None else 'articulation'} {self.name}"


Contents = tuple[Part, ...]
"""What the packed state of one env holds, in its order: bodies, then articulations."""

Touch = tuple[str, str, NDArray[np.float32]]
"""A contact that a query counts: the names of two bodies, and the impulse (3,) in N s on the first."""


class CpuEnvState(NamedTuple):
    """The simulation state of one env. A tuple, since hundreds are made at once."""

    contents: Contents
    packed: bytes
    """As ``PhysxCpuSystem.pack()`` gives it; hidden actors where they really are."""
    asleep: tuple[bool, ...]
    """One for each of `contents`."""
    qf: NDArray[np.float32]
    """(articulations, D) joint forces, padded with zeros."""
    driven: NDArray[np.bool_]
    """(2, articulations) whether position and velocity targets were ever set."""
    touching: tuple[Touch, ...]


@dataclass
class CpuStatePlan:
    """What of a built scene belongs to which env."""

    contents: list[Contents]
    """Of each env; envs that are alike share one object."""
    sleepers: list[list[tuple[int, Callable[[], bool], Any]]]
    """Of each env: index into its contents, whether it sleeps, the component that can be put to sleep."""
    articulations: list[slice]
    """Of each env: its rows in the (A, D) tensors."""
    names: dict[int, tuple[int, str]]
    """Env and name of a body, by the ``id`` of its component."""
    bodies: list[dict[str, int]]
    """Of each env: the ``id`` of the component, by name."""
    held: list[Any]
    """Objects whose ids are used: pybind11 gives an id anew once its object is gone."""
    offsets: dict[int, tuple[int, int]]
    """Env and offset in its packed floats of an actor, by the slot of its entity (`SceneIndex`)."""
    settled: list[dict[int, tuple[bytes, bytes]]]
    """Of each env, by offset in its packed bytes: a root pose that was wanted, and which was asked for to get it."""


@once_a_scene
def plan_cpu_state(env: Any) -> CpuStatePlan:
    """What `read_cpu_state` and `write_cpu_state` need to know of the scene that an env has now."""
    px = batched_system(env.scene)
    assert px is not None, "only for the batched CPU simulation"
    scene = scene_index(env)

    def name_of(component: Any) -> str:
        return scene.name_of(component) or component.entity.name

    alike: dict[Contents, Contents] = {}
    plan = CpuStatePlan([], [], [], {}, [], [], {}, [{} for _ in px.systems])
    first_articulation = 0
    for index, system in enumerate(px.systems):
        bodies, links = system.rigid_dynamic_components, system.articulation_link_components
        statics = system.rigid_static_components
        plan.held += [*bodies, *links, *statics]
        by_name = {name_of(c): id(c) for c in [*statics, *links, *bodies]}
        plan.bodies.append(by_name)
        plan.names.update({component: (index, name) for name, component in by_name.items()})
        parts, sleepers = [], []
        for body in bodies:
            if id(body.entity) in scene.slot_of:
                plan.offsets[scene.slot_of[id(body.entity)]] = index, sum(part.size for part in parts)
            if not body.kinematic:
                sleepers.append((len(parts), _getter(body, "is_sleeping"), body))
            parts.append(Part(name_of(body), None))
        roots = [link for link in links if link.is_root]
        for root in roots:
            articulation: Any = root.articulation
            name = name_of(root).rpartition("/")[0] or articulation.name
            sleepers.append((len(parts), _getter(root, "sleeping"), root))
            # SAPIEN's "scene-0_panda" has joints that are called "scene-0-panda_panda_joint1".
            prefix = articulation.name.replace("_", "-", 1) + "_"
            joints = tuple(joint.name.removeprefix(prefix) for joint in articulation.active_joints)
            parts.append(Part(name, joints))
        contents = tuple(parts)
        plan.contents.append(alike.setdefault(contents, contents))
        plan.sleepers.append(sleepers)
        plan.articulations.append(slice(first_articulation, first_articulation + len(roots)))
        first_articulation += len(roots)
    return plan


def _getter(component: Any, name: str) -> Callable[[], bool]:
    # Asked for every body at every snapshot: past the look-up of the property.
    return partial(getattr(type(component), name).fget, component)


def read_cpu_state(env: Any, env_idx: list[int]) -> list[CpuEnvState]:
    """The simulation state of the envs in `env_idx`, one each."""
    px: BatchedCpuSystem = env.scene.px
    plan = plan_cpu_state(env)
    packs = px.packs()
    hidden = _hidden(env, plan)
    qf = px.cuda_articulation_qf.torch().numpy().copy()
    driven = np.stack(px.drive_flags)
    touching = _touching(px, plan)
    awake = {len(contents): (False,) * len(contents) for contents in plan.contents}
    states = []
    for i in env_idx:
        packed, contents, rows = packs[i], plan.contents[i], plan.articulations[i]
        if i in hidden:
            numbers = np.frombuffer(packed, dtype=np.float32).copy()
            for offset, pose in hidden[i]:
                numbers[offset : offset + 7] = pose[[3, 4, 5, 6, 0, 1, 2]]
            packed = numbers.tobytes()
        sleeping = [part for part, is_asleep, _ in plan.sleepers[i] if is_asleep()]
        asleep = (
            tuple([part in sleeping for part in range(len(contents))]) if sleeping else awake[len(contents)]
        )
        states.append(CpuEnvState(contents, packed, asleep, qf[rows], driven[:, rows], touching.get(i, ())))
    return states


def write_cpu_state(
    env: Any, env_idx: list[int], states: list[CpuEnvState], fresh_physics: bool
) -> tuple[dict[str, None], dict[str, str]]:
    """Put ``states[k]`` into env ``env_idx[k]``; the other envs are not touched. The tensors are fetched.

    Returns:
        What was carried, and what was not with the reason, each by the words that name it.
    """
    carried: dict[str, None] = {}
    missed: dict[str, str] = {}
    px: BatchedCpuSystem = env.scene.px
    plan = plan_cpu_state(env)
    own = px.packs()
    for i in env_idx:
        for _, _, component in plan.sleepers[i]:
            # Or the time until it falls asleep would depend on what it touched before: a cube that was in
            # a hand fell asleep one substep later than one that was not.
            component.put_to_sleep()
    if fresh_physics:
        for i in renew_physics(env.scene, env_idx):
            missed[f"fresh physics of env {i}"] = "entities were removed from its scene since it was built"
    hidden = _hidden(env, plan)
    packed: dict[int, bytes] = {}
    matches: dict[int, list[int | None]] = {}
    alike: dict[int, Contents] = {}
    for i, state in zip(env_idx, states, strict=True):
        packed[i] = state.packed
        if state.contents == plan.contents[i]:
            alike[id(plan.contents[i])] = plan.contents[i]
        else:
            packed[i], matches[i] = _joined(plan.contents[i], own[i], state, carried, missed)
        if i in hidden:
            packed[i] = _hide(packed[i], hidden[i])
    _unpack(px, plan, packed)
    _write_joint_forces(px, plan, dict(zip(env_idx, states, strict=True)), matches, fresh_physics)
    for i, state in zip(env_idx, states, strict=True):
        if any(state.asleep):
            slept = {part.name for part, asleep in zip(state.contents, state.asleep, strict=True) if asleep}
            for part, _, component in plan.sleepers[i]:
                if plan.contents[i][part].name in slept:
                    component.put_to_sleep()
    env.scene._gpu_fetch_all()
    for i, state in zip(env_idx, states, strict=True):
        known = plan.bodies[i]
        px.contacts.carry(
            i,
            [
                ((known[a], known[b]), impulse)
                for a, b, impulse in state.touching
                if a in known and b in known
            ],
        )
    carried.update({str(part): None for contents in alike.values() for part in contents})
    return carried, missed


def begin_cpu_state_anew(env: Any, env_idx: list[int]) -> None:
    """Give these envs a PhysX scene without a past, and the state that they have.

    What follows can then be had again to the last bit, from a snapshot of now and the same actions. A root of an
    articulation that PhysX does not give back as it is set is moved by some last bits, to where it does.
    """
    left, states, dice = env_idx, read_cpu_state(env, env_idx), np.random.default_rng(0)
    for attempt in range(_TRIES):
        write_cpu_state(env, left, states, fresh_physics=True)
        found = read_cpu_state(env, left)
        other = [
            k for k, (now, was) in enumerate(zip(found, states, strict=True)) if now.packed != was.packed
        ]
        if not other:
            return
        left, states = [left[k] for k in other], [found[k] for k in other]
        if attempt > 0:
            states = [_nudged(state, dice) for state in states]


def _nudged(state: CpuEnvState, dice: np.random.Generator) -> CpuEnvState:
    numbers = np.frombuffer(state.packed, dtype=np.float32).copy()
    at = 0
    for part in state.contents:
        if part.joints is not None:
            numbers[at : at + 7] += _LAST_BIT * dice.integers(-2, 3, 7).astype(np.float32)
        at += part.size
    return state._replace(packed=numbers.tobytes())


def _unpack(px: BatchedCpuSystem, plan: CpuStatePlan, packed: dict[int, bytes]) -> None:
    """Put packed states into envs, so that each reads back as it was packed."""
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
    states: dict[int, CpuEnvState],
    matches: dict[int, list[int | None]],
    fresh_physics: bool,
) -> None:
    """Put ``set_qf``'s forces and the drives' flags back, by env; `matches` as of `_joined`, where envs differ."""
    qf = px.cuda_articulation_qf.torch().numpy()
    for i, state in states.items():
        rows = plan.articulations[i]
        if i not in matches and state.qf.shape[1] == qf.shape[1]:
            qf[rows] = state.qf
            for flags, was in zip(px.drive_flags, state.driven, strict=True):
                flags[rows] = was
            continue
        contents = plan.contents[i]
        bodies, their_bodies = (sum(p.joints is None for p in c) for c in (contents, state.contents))
        for part in range(bodies, len(contents)):
            source = matches[i][part] if i in matches else part
            if source is not None:
                row, theirs, dof = (
                    rows.start + part - bodies,
                    source - their_bodies,
                    len(contents[part].joints or ()),
                )
                qf[row, :dof] = state.qf[theirs, :dof]
                for flags, was in zip(px.drive_flags, state.driven, strict=True):
                    flags[row] = was[theirs]
    px.gpu_apply_articulation_qf()
    if fresh_physics and qf.any():
        for i in states:
            for row in range(plan.articulations[i].start, plan.articulations[i].stop):
                if qf[row].any():  # a new scene has none, though the tensor may not have changed
                    px.articulation(row).set_qf(qf[row, : px.articulation(row).dof])


def _asked_for(plan: CpuStatePlan, env: int, packed: bytes) -> bytes:
    """The bytes to unpack for `packed` to be read: with the roots that `_settle_roots` found, where it did."""
    for at, (wanted, asked) in plan.settled[env].items():
        if packed[at : at + len(wanted)] == wanted:
            packed = packed[:at] + asked + packed[at + len(wanted) :]
    return packed


def _settle_roots(px: BatchedCpuSystem, plan: CpuStatePlan, env: int, packed: bytes) -> None:
    """Make articulations' root poses read back as they were packed.

    PhysX keeps a root by its centre of mass, and what it gives back differs in the last bit from what it was
    given; over many snapshots of snapshots that adds up. What differs is asked for that much further off. The
    last answer is kept: most roots stand still.
    """
    numbers = np.frombuffer(packed, dtype=np.float32)
    at = sum(part.size for part in plan.contents[env] if part.joints is None)
    roots = [part for part in plan.contents[env] if part.joints is not None]
    for row, part in enumerate(roots, plan.articulations[env].start):
        articulation = px.articulation(row)
        wanted = numbers[at : at + 7]
        asked = wanted
        for _ in range(_ATTEMPTS):
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
    state: CpuEnvState,
    carried: dict[str, None],
    missed: dict[str, str],
) -> tuple[bytes, list[int | None]]:
    """The bytes for an env that is built otherwise, and for each of its parts the source's index."""
    numbers = np.frombuffer(own, dtype=np.float32).copy()
    theirs = np.frombuffer(state.packed, dtype=np.float32)
    starts = np.cumsum([0, *(part.size for part in state.contents)])
    index_of = {(part.name, part.joints is None): k for k, part in enumerate(state.contents)}
    matches: list[int | None] = []
    at = 0
    for part in contents:
        source = index_of.pop((part.name, part.joints is None), None)
        if source is None:
            missed[str(part)] = "the snapshot has none of this name: left as it is"
        elif state.contents[source].joints != part.joints:
            missed[str(part)] = "its joints are others than in the snapshot: left as it is"
            source = None
        else:
            numbers[at : at + part.size] = theirs[starts[source] : starts[source] + part.size]
            carried[str(part)] = None
        matches.append(source)
        at += part.size
    for k in index_of.values():
        missed[str(state.contents[k])] = "this env has none of this name"
    return numbers.tobytes(), matches


def _touching(px: BatchedCpuSystem, plan: CpuStatePlan) -> dict[int, tuple[Touch, ...]]:
    found: dict[int, list[Touch]] = {}
    for (first, second), impulse in px.contacts.counted():
        # Only bodies of this scene have names; ManiSkill's queries know no others.
        if first in plan.names and second in plan.names:
            index, name = plan.names[first]
            found.setdefault(index, []).append((name, plan.names[second][1], impulse))
    return {index: tuple(touches) for index, touches in found.items()}


def _hidden(env: Any, plan: CpuStatePlan) -> dict[int, list[tuple[int, NDArray[np.float32]]]]:
    """Of each env with hidden actors: their offsets in its packed floats, and the poses [p, q] that are kept of them."""
    found: dict[int, list[tuple[int, NDArray[np.float32]]]] = {}
    for slots, poses in hidden_poses(env):
        for slot, pose in zip(slots.tolist(), poses, strict=True):
            if slot in plan.offsets:
                index, offset = plan.offsets[slot]
                found.setdefault(index, []).append((offset, pose))
    return found


def _hide(packed: bytes, hidden: list[tuple[int, NDArray[np.float32]]]) -> bytes:
    numbers = np.frombuffer(packed, dtype=np.float32).copy()
    for offset, kept in hidden:
        pose = numbers[offset : offset + 7]
        kept[:] = pose[[4, 5, 6, 0, 1, 2, 3]]
        pose[4:] += _FAR
    return numbers.tobytes()

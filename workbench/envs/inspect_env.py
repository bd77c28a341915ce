"""Reads one env: observation, state dict, joints and contacts."""

from __future__ import annotations

import operator
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien.physx as physx
import torch
from numpy.typing import NDArray

from workbench.envs import maniskill_private
from workbench.envs.evaluate_entries import flat_entries
from workbench.envs.indices import require_env
from workbench.envs.inspection import (
    BodyReadings,
    Inspection,
    JointReadings,
    Leaf,
    LinkJoint,
    Section,
    Touching,
)
from workbench.envs.scene.scene_index import SceneIndex, scene_index
from workbench.envs.simulation.cpu_system import batched_system
from workbench.envs.state_columns import env_states, flat_names, split_flat
from workbench.envs.task_env import TaskEnv, to_numpy

MAX_VALUES = 64
"""Maximum number of values of one array that are sent; a joint vector has fewer, a picture more."""


def inspect_env(task: TaskEnv, env: int, sections: Collection[Section], body: str = "") -> Inspection:
    """Read these sections of one env, and the body of this name; what cannot be read is named in `Inspection.refused`.

    The numbers come from where the task takes them: the last observation, ``get_state_dict()``, ManiSkill's
    batched tensors. Reading takes about 1 ms per section for a Panda on a table, and does not change how the
    episode continues.

    Raises:
        IndexError: there is no such env.
    """
    require_env(env, task.num_envs)
    readers: dict[Section, Callable[[TaskEnv, int], Any]] = {
        "observation": read_observation,
        "state": read_state,
        "joints": read_joints,
        "contacts": read_contacts,
    }
    began = time.perf_counter()
    read: dict[str, Any] = {}
    refused: list[tuple[Section, str]] = []
    for section, reader in readers.items():
        if section not in sections:
            continue
        try:
            read[section] = reader(task, env)
        except NotImplementedError as error:
            refused.append((section, str(error)))
        except Exception as error:
            # The author's get_state_dict or observation hook failed: still show the other sections.
            refused.append((section, f"reading it raised {type(error).__name__}: {error}"))
    return Inspection(
        env=env,
        elapsed_steps=int(task.env.elapsed_steps[env]),
        body=read_body(task, env, body) if body else None,
        refused=tuple(refused),
        milliseconds=1000 * (time.perf_counter() - began),
        **read,
    )


def read_observation(task: TaskEnv, env: int) -> tuple[Leaf, ...]:
    """The last observation. If it is flattened, (N, D), it is split into its entries again, by name."""
    leaves: list[Leaf] = []
    for name, value in flat_entries({} if task.obs is None else task.obs):
        # With pictures, ManiSkill's flattened part is called "state".
        names = flat_names(task, value) if name in ("", "state") else None
        if names is None:
            leaves.append(_leaf(name or "observation", _row(value, env, task.num_envs)))
        else:
            leaves += [_leaf(*part) for part in split_flat(names, to_numpy(value[env]))]
    return tuple(leaves)


def read_state(task: TaskEnv, env: int) -> tuple[Leaf, ...]:
    """``get_state_dict()``, split into named parts: 13 numbers of a body, 13 + 2 J of an articulation."""
    structs = scene_index(task.env).states
    leaves: list[Leaf] = []
    for name, value in env_states(task.env).items():
        struct = structs.get(name)
        if struct is None:
            leaves.append(_leaf(name, _row(value, env, task.num_envs)))
        elif env in maniskill_private.envs_of(struct):
            leaves += [
                _leaf(f"{name}/{part}", numbers) for part, numbers in _state_parts(to_numpy(value[env]))
            ]
    return tuple(leaves)


def read_joints(task: TaskEnv, env: int) -> tuple[JointReadings, ...]:
    """Every articulation of this env that has active joints, in the order of building."""
    found = []
    for name, articulation in task.env.scene.articulations.items():
        at = np.flatnonzero(np.asarray(maniskill_private.envs_of(articulation)) == env)
        if not len(at):
            continue
        row = int(at[0])
        joints = maniskill_private.objects_of(articulation)[row].active_joints
        count = len(joints)
        if not count:
            continue
        # Not SAPIEN's own names, which carry the env's number.
        names = tuple(joint.name for joint in articulation.active_joints)
        limits = to_numpy(articulation.get_qlimits()[row])[:count]
        stiff = np.array([joint.stiffness > 0 for joint in joints])
        found.append(
            JointReadings(
                articulation=name,
                names=names,
                kinds=tuple(str(joint.type) for joint in joints),
                position=_floats(articulation.get_qpos()[row])[:count],
                velocity=_floats(articulation.get_qvel()[row])[:count],
                target=np.where(stiff, _floats(articulation.get_drive_targets()[row])[:count], np.nan),
                low=limits[:, 0].astype(np.float32),
                high=limits[:, 1].astype(np.float32),
            )
        )
    return tuple(found)


def read_contacts(task: TaskEnv, env: int) -> tuple[Touching, ...]:
    """Pairs of bodies that touched in the last substep, strongest first.

    Raises:
        NotImplementedError: the env is simulated on the GPU.
    """
    pairs: dict[tuple[str, str], list[tuple[Contact, int]]] = {}
    for contact in list_contacts(task.env, env):
        first, second = contact.bodies
        # PhysX also lists shapes that are near and do not touch.
        if not contact.impulses.any() and not (contact.separations <= 0).any():
            continue
        ordered = (first, second) if first <= second else (second, first)
        pairs.setdefault(ordered, []).append((contact, 1 if ordered == (first, second) else -1))
    touching = [_touching(bodies, contacts) for bodies, contacts in pairs.items()]
    return tuple(sorted(touching, key=lambda pair: (-float(np.linalg.norm(pair.force)), pair.bodies)))


def read_body(task: TaskEnv, env: int, name: str) -> BodyReadings | None:
    """Physical properties of a body of this env, from SAPIEN's component; None if the env has no such body."""
    index = scene_index(task.env)
    entity = index.entities[env, index.names.index(name)] if name in index.names else None
    component = None if entity is None else entity.find_component_by_type(physx.PhysxRigidBaseComponent)
    if component is None:
        return None
    shapes = component.collision_shapes
    materials = {
        (one.static_friction, one.dynamic_friction, one.restitution): None
        for one in (shape.physical_material for shape in shapes)
    }
    moves = isinstance(component, physx.PhysxRigidBodyComponent)
    state = _state_of(task.env, env, name) if moves else None
    return BodyReadings(
        name=name,
        mass=float(component.mass) if moves else None,
        inertia=np.asarray(component.inertia, np.float32) if moves else None,
        centre_of_mass=np.asarray(component.cmass_local_pose.p, np.float32) if moves else None,
        velocity=None if state is None else state[7:10],
        angular_velocity=None if state is None else state[10:13],
        has_gravity=moves and not component.disable_gravity,
        shapes=tuple(_SHAPES.get(type(shape), type(shape).__name__) for shape in shapes),
        materials=tuple(materials),
        joint=_joint_of(task.env, env, component),
    )


def _joint_of(env: Any, env_idx: int, component: Any) -> LinkJoint | None:
    """The joint of a link; None for another body, a root link or a fixed joint."""
    joint = component.joint if isinstance(component, physx.PhysxArticulationLinkComponent) else None
    if joint is None or joint.dof == 0:
        return None
    # Not SAPIEN's own name, which carries the env's number.
    names = (
        merged.name
        for articulation in env.scene.articulations.values()
        for at in np.flatnonzero(np.asarray(maniskill_private.envs_of(articulation)) == env_idx)
        for own, merged in zip(
            maniskill_private.objects_of(articulation)[int(at)].active_joints,
            articulation.active_joints,
            strict=True,
        )
        if own.name == joint.name
    )
    name = next(names, joint.name)
    low, high = (float(one) for one in joint.limits[0])
    pose = joint.pose_in_child
    # SAPIEN's joints move about, or along, the x axis of their frame.
    axis = pose.to_transformation_matrix()[:3, 0]
    return LinkJoint(
        name, joint.type, low, high, np.asarray(pose.p, np.float32), np.asarray(axis, np.float32)
    )


_SHAPES: dict[type, str] = {
    physx.PhysxCollisionShapeBox: "box",
    physx.PhysxCollisionShapeSphere: "sphere",
    physx.PhysxCollisionShapeCapsule: "capsule",
    physx.PhysxCollisionShapeCylinder: "cylinder",
    physx.PhysxCollisionShapePlane: "plane",
    physx.PhysxCollisionShapeConvexMesh: "convex mesh",
    physx.PhysxCollisionShapeTriangleMesh: "triangle mesh",
}


def _state_of(env: Any, env_idx: int, name: str) -> NDArray[np.float32] | None:
    """(13,) position, quaternion wxyz, linear and angular velocity of a body; None for a removed body."""
    row = scene_index(env).row_of(env_idx, name)
    return None if row is None else _floats(env.scene.px.cuda_rigid_body_data.torch()[row])


def _touching(bodies: tuple[str, str], contacts: list[tuple[Contact, int]]) -> Touching:
    timestep = np.float32(contacts[0][0].timestep)
    impulses = np.concatenate([sign * contact.impulses for contact, sign in contacts])
    impulse = impulses.sum(axis=0)
    return Touching(
        bodies=bodies,
        force=impulse / timestep,
        impulse=impulse,
        points=np.concatenate([contact.points for contact, _ in contacts]),
        forces=impulses / timestep,
        separation=min(float(contact.separations.min()) for contact, _ in contacts),
    )


def _state_parts(row: NDArray) -> Iterator[tuple[str, NDArray]]:
    """Named parts of a state row, as `Actor.get_state` and `Articulation.get_state` lay them out."""
    joints = (len(row) - 13) // 2
    widths = [("p", 3), ("q", 4), ("v", 3), ("w", 3), ("qpos", joints), ("qvel", joints)]
    if 13 + 2 * joints != len(row):
        widths = [("", len(row))]
    at = 0
    for name, width in widths:
        if width:
            yield name, row[at : at + width]
        at += width


def _row(value: Any, env: int, num_envs: int) -> NDArray:
    shape: tuple[int, ...] = tuple(getattr(value, "shape", ()))
    # Only the row leaves the device: a picture of every env would be megabytes.
    return to_numpy(value[env] if shape[:1] == (num_envs,) else value)


def _leaf(name: str, value: NDArray, dtype: str | None = None) -> Leaf:
    numeric = value.dtype.kind in "fiub" and value.size > 0
    low, high = (float(value.min()), float(value.max())) if numeric else (np.nan, np.nan)
    values = value.reshape(-1)[:MAX_VALUES].copy()
    return Leaf(name, tuple(value.shape), dtype or str(value.dtype), values, low, high)


def _floats(value: torch.Tensor) -> NDArray[np.float32]:
    return to_numpy(value).astype(np.float32)


# --- contacts of one env: for people, not for rewards -------------------------------------------------


@dataclass(frozen=True)
class Contact:
    """Contact of two collision shapes in the last substep, at K points; float32, in the env's own world
    frame.

    PhysX lists every pair of shapes that are nearer to each other than their contact offsets (1 cm each by
    default). So a pair of bodies may be listed more than once, and two shapes with positive `separations` and
    no impulse do not touch.
    """

    bodies: tuple[str, str]
    """Names as in `SceneIndex.names`; the ``sapien.Entity``'s name for a body not managed by ManiSkill."""
    points: NDArray[np.float32]
    """(K, 3) metres."""
    normals: NDArray[np.float32]
    """(K, 3) unit vectors from the second body towards the first."""
    impulses: NDArray[np.float32]
    """(K, 3) newton seconds ON the first body, BY the second, in the last substep, friction included."""
    separations: NDArray[np.float32]
    """(K,) metres between the surfaces; negative where they overlap."""
    timestep: float
    """Seconds of a substep."""

    @property
    def impulse(self) -> NDArray[np.float32]:
        """(3,) newton seconds on the first body: the sum of `impulses`."""
        return self.impulses.sum(axis=0)

    @property
    def force(self) -> NDArray[np.float32]:
        """(3,) newtons on the first body, the mean over the last substep. The force on the second is its
        negative."""
        return self.impulse / np.float32(self.timestep)


def list_contacts(env: Any, env_idx: int) -> tuple[Contact, ...]:
    """All contacts of one env in its last substep, ordered by their bodies' names, then by their points.

    Stock ManiSkill has this for a single env only (``scene.get_contacts()``). Only the chosen env is read.

    Contacts are sorted because SAPIEN's order depends on memory addresses, and differs between equal runs.

    A reset or a restored snapshot does not change the list until the next step, as in stock ManiSkill.

    Args:
        env: a ManiSkill env, reset at least once, batched on the CPU or stock; wrappers are removed.

    Raises:
        IndexError: there is no such env.
        NotImplementedError: the env is simulated on the GPU.
    """
    env, env_idx = maniskill_private.open_env(env), operator.index(env_idx)
    require_env(env_idx, env.num_envs)
    batched = batched_system(env.scene)
    if batched is None and env.scene.gpu_sim_enabled:
        raise NotImplementedError(
            "PhysX on the GPU keeps no list of contacts that can be read: open the task with the CPU backend."
        )
    system = env.scene.px if batched is None else batched.systems[env_idx]
    index, timestep = scene_index(env), env.scene.timestep
    contacts = [_read(contact, index, timestep) for contact in system.get_contacts()]
    return tuple(sorted(contacts, key=_place))


def _place(contact: Contact) -> tuple[Any, ...]:
    # Two shapes of one body may touch at the same point, with different depths.
    return contact.bodies, contact.points.tolist(), contact.separations.tolist(), contact.impulses.tolist()


def _read(contact: physx.PhysxContact, index: SceneIndex, timestep: float) -> Contact:
    first, second = contact.bodies
    points = contact.points
    return Contact(
        bodies=(index.name_of(first) or first.entity.name, index.name_of(second) or second.entity.name),
        points=_rows([point.position for point in points]),
        normals=_rows([point.normal for point in points]),
        impulses=_rows([point.impulse for point in points]),
        separations=np.array([point.separation for point in points], dtype=np.float32),
        timestep=timestep,
    )


def _rows(vectors: Sequence[Any]) -> NDArray[np.float32]:
    return np.array(vectors, dtype=np.float32).reshape(-1, 3)

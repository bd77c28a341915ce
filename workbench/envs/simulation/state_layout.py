"""Layout of the state of N CPU physics systems: rows in tensors, and positions in packs."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
import sapien.physx as physx
from numpy.typing import NDArray

BODY = 13
"""Number of floats of a body in ``pack()``: quaternion wxyz, position, linear and angular velocity."""
_FROM_PACKED_BODY = np.array([4, 5, 6, 0, 1, 2, 3, 7, 8, 9, 10, 11, 12])
"""Position of each column of ManiSkill's row [p, q, v, w] in a packed body [q, p, v, w]."""
_IN_ENV = re.compile(r"^scene-\d+[-_]")
_FROM_PACKED_POSE = np.array([4, 5, 6, 0, 1, 2, 3])


@dataclass(frozen=True)
class StateLayout:
    """Rows in the tensors, and positions in the concatenated packs.

    ``PhysxCpuSystem.pack()`` gives float32: each dynamic or kinematic body as quaternion wxyz, position, linear and angular
    velocity; then each articulation as the same 13 numbers of its root, its qpos, its qvel, and target position and target
    velocity of each joint in turn. ``sapien.Scene.pack_poses()`` gives quaternion and position of each entity. Neither is
    documented (found by measuring, sapien 3.0.3), so `check_layout` compares both with the getters. Envs need not have the
    same bodies: each env's rows follow those of the env before, and joints that are missing read a zero.
    """

    bodies: list[Any]
    """PhysxRigidDynamicComponent. Typed as Any, here and below, since SAPIEN's stubs want arrays of a literal shape."""
    body_rows: NDArray[np.int64]
    links: list[Any]
    """PhysxArticulationLinkComponent."""
    link_rows: NDArray[np.int64]
    articulations: list[Any]
    """PhysxArticulation."""
    root_rows: NDArray[np.int64]
    dofs: NDArray[np.int64]
    body_at: NDArray[np.int64]
    """Positions of the numbers in the concatenated packs, here and in the next five fields."""
    root_at: NDArray[np.int64]
    qpos_at: NDArray[np.int64]
    qvel_at: NDArray[np.int64]
    target_qpos_at: NDArray[np.int64]
    target_qvel_at: NDArray[np.int64]
    entities: list[Any]
    """(R,) entity of each row."""
    env_of_row: NDArray[np.int64]
    names: list[str]
    """(R,) name of the body in each row, the same in every env."""
    articulation_names: list[str]
    """(A,) name of each articulation, the same in every env."""
    row_of: dict[int, int]
    """Row of each body and link, by the ``id`` of its component."""
    index_of: dict[int, int]
    """Index of each articulation, by its ``id``."""
    size: int
    """Count of numbers in the packs of all envs."""
    parts: list[list[slice]]
    """For each env, the slice of each body and articulation in the env's pack."""


def lay_out(systems: Sequence[physx.PhysxCpuSystem]) -> StateLayout:
    rows: list[Any] = []  # the component of each row
    env_of_row, body_at, joints_at = [], [], []
    roots: dict[int, tuple[int, Any]] = {}  # by id of each articulation: row of its first link, articulation
    packed = 0
    parts: list[list[slice]] = []
    for env, system in enumerate(systems):
        bodies, links = system.rigid_dynamic_components, system.articulation_link_components
        body_at += [packed + BODY * i for i in range(len(bodies))]
        packed += BODY * len(bodies)
        before = len(roots)
        for row, link in enumerate(links, len(rows) + len(bodies)):
            roots.setdefault(id(link.articulation), (row, link.articulation))
        own = [slice(BODY * i, BODY * (i + 1)) for i in range(len(bodies))]
        for _, articulation in [*roots.values()][before:]:
            joints_at.append(packed + BODY)
            packed += BODY + 4 * articulation.dof
            start = own[-1].stop if own else 0
            own.append(slice(start, start + BODY + 4 * articulation.dof))
        parts.append(own)
        rows += [*bodies, *links]
        env_of_row += [env] * (len(bodies) + len(links))
    is_link = np.array([isinstance(c, physx.PhysxArticulationLinkComponent) for c in rows], dtype=bool)
    articulations = [articulation for _, articulation in roots.values()]
    dofs = _numbers([articulation.dof for articulation in articulations])
    start, each, dof = _numbers(joints_at)[:, None], np.arange(dofs.max(initial=0)), dofs[:, None]

    def joint_columns(at: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.where(each < dof, start + at, packed)  # padding reads the zero behind all packs

    entities = [component.entity for component in rows]
    return StateLayout(
        bodies=[rows[row] for row in np.flatnonzero(~is_link)],
        body_rows=np.flatnonzero(~is_link),
        links=[rows[row] for row in np.flatnonzero(is_link)],
        link_rows=np.flatnonzero(is_link),
        articulations=articulations,
        root_rows=_numbers([row for row, _ in roots.values()]),
        dofs=dofs,
        body_at=_numbers(body_at)[:, None] + _FROM_PACKED_BODY,
        root_at=start - BODY + _FROM_PACKED_BODY,
        qpos_at=joint_columns(each),
        qvel_at=joint_columns(dof + each),
        target_qpos_at=joint_columns(2 * dof + 2 * each),
        target_qvel_at=joint_columns(2 * dof + 2 * each + 1),
        entities=entities,
        env_of_row=_numbers(env_of_row),
        names=[_IN_ENV.sub("", entity.name) for entity in entities],
        articulation_names=[_IN_ENV.sub("", articulation.name) for articulation in articulations],
        row_of={id(component): row for row, component in enumerate(rows)},
        index_of={id(a): i for i, a in enumerate(articulations)},
        size=packed,
        parts=parts,
    )


def link_poses_at(layout: StateLayout, scenes: Sequence[sapien.Scene]) -> NDArray[np.int64]:
    """(L, 7) positions of each link's pose in the concatenated pose packs of all envs."""
    where: dict[int, int] = {}
    first, held = 0, [scene.entities for scene in scenes]  # an id is unique only among objects that are alive
    for entities in held:
        where.update({id(entity): first + 7 * i for i, entity in enumerate(entities)})
        first += 7 * len(entities)
    found = [where.get(id(link.entity), 0) for link in layout.links]
    return _numbers(found)[:, None] + _FROM_PACKED_POSE


def _numbers(values: list[int]) -> NDArray[np.int64]:
    return np.array(values, dtype=np.int64)


def check_layout(
    layout: StateLayout, packed: NDArray[np.float32], link_poses: Callable[[], NDArray[np.float32]]
) -> None:
    """Compare the packs with the getters, since SAPIEN documents neither their order nor their size.

    Args:
        packed: the packs of all envs, then a zero.
        link_poses: returns the poses (L, 7) from the packs of poses; called only if `packed` has the right size.

    Raises:
        RuntimeError: they differ.
    """
    expected = BODY * (len(layout.bodies) + len(layout.articulations)) + 4 * int(layout.dofs.sum())
    agrees = len(packed) == expected + 1
    if agrees:
        for body, at in zip(layout.bodies, layout.body_at, strict=True):
            pose = body.entity.pose
            agrees &= np.allclose(packed[at[:7]], [*pose.p, *pose.q], atol=1e-5)
        for i, articulation in enumerate(layout.articulations):
            dof = articulation.dof
            agrees &= np.allclose(packed[layout.qpos_at[i, :dof]], articulation.qpos, atol=1e-5)
        for link, packed_pose in zip(layout.links, link_poses(), strict=True):
            pose = link.entity.pose
            agrees &= np.allclose(packed_pose, [*pose.p, *pose.q], atol=1e-5)
    if not agrees:
        raise RuntimeError(
            f"sapien {sapien.__version__} packs its state in another order than the batched CPU core "
            "was written for (3.0.3): install the pinned version."
        )

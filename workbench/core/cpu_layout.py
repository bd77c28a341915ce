"""Where the state of N CPU physics systems lies: rows of the batch's tensors, and bytes of the packs.

``PhysxCpuSystem.pack()`` gives the state of one env as float32: each dynamic or kinematic body as
quaternion wxyz, position, linear and angular velocity; then each articulation as the same 13 numbers of
its root, its qpos, its qvel, and target position and target velocity of each joint in turn.
``sapien.Scene.pack_poses()`` gives quaternion and position of each entity. Neither is documented (found
by measuring, sapien 3.0.3); so `check_layout` compares both with the getters when a scene is built.

The envs need not be alike: the rows of one follow those of the other, and where an articulation has
fewer joints than the widest, the padding reads a zero.
"""

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
"""Floats of a body in ``pack()``: quaternion wxyz, position, linear and angular velocity."""
_FROM_PACKEDBODY = np.array([4, 5, 6, 0, 1, 2, 3, 7, 8, 9, 10, 11, 12])
"""Where ManiSkill's row [p, q, v, w] finds its columns in a packed body [q, p, v, w]."""
_IN_ENV = re.compile(r"^scene-\d+[-_]")
_FROM_PACKED_POSE = np.array([4, 5, 6, 0, 1, 2, 3])


@dataclass(frozen=True)
class Layout:
    """Where everything lies: rows of the tensors, and positions in the concatenated packs."""

    bodies: list[Any]
    """PhysxRigidDynamicComponent. Any, here and below: SAPIEN's stubs want arrays of a literal shape."""
    body_rows: NDArray[np.int64]
    links: list[Any]
    """PhysxArticulationLinkComponent."""
    link_rows: NDArray[np.int64]
    articulations: list[Any]
    """PhysxArticulation."""
    root_rows: NDArray[np.int64]
    dofs: NDArray[np.int64]
    body_at: NDArray[np.int64]
    root_at: NDArray[np.int64]
    qpos_at: NDArray[np.int64]
    qvel_at: NDArray[np.int64]
    target_qpos_at: NDArray[np.int64]
    target_qvel_at: NDArray[np.int64]
    entities: list[Any]
    """(R,) of each row."""
    pose_at: NDArray[np.int64]
    """(R, 7) of each row, within the packed poses of its own env."""
    env_of_row: NDArray[np.int64]
    names: list[str]
    """(R,) of the body in each row, the same in every env."""
    articulation_names: list[str]
    """(A,) likewise."""
    row_of: dict[int, int]
    index_of: dict[int, int]
    row_count: int


def lay_out(systems: Sequence[physx.PhysxCpuSystem], scenes: Sequence[sapien.Scene]) -> Layout:
    bodies: list[Any] = []
    links: list[Any] = []
    articulations: list[Any] = []
    body_rows, link_rows, root_rows, dofs = [], [], [], []
    body_at, root_at, pose_at = [], [], []
    row_entities: list[Any] = []
    env_of_row: list[int] = []
    joint_at: list[tuple[int, int]] = []
    row = packed = 0
    for env, (system, scene) in enumerate(zip(systems, scenes, strict=True)):
        entities = scene.entities  # held, because an id is unique only among objects that are alive
        entity_at = {id(entity): 7 * i for i, entity in enumerate(entities)}
        for body in system.rigid_dynamic_components:
            bodies.append(body)
            body_rows.append(row)
            row_entities.append(body.entity)
            pose_at.append(entity_at[id(body.entity)] + _FROM_PACKED_POSE)
            env_of_row.append(env)
            body_at.append(packed + _FROM_PACKEDBODY)
            row, packed = row + 1, packed + BODY
        seen: set[int] = set()
        env_articulations = []
        for link in system.articulation_link_components:
            links.append(link)
            link_rows.append(row)
            row_entities.append(link.entity)
            pose_at.append(entity_at[id(link.entity)] + _FROM_PACKED_POSE)
            env_of_row.append(env)
            articulation = link.articulation
            if id(articulation) not in seen:
                seen.add(id(articulation))
                env_articulations.append(articulation)
                articulations.append(articulation)
                root_rows.append(row)
                dofs.append(articulation.dof)
            row += 1
        for articulation in env_articulations:
            root_at.append(packed + _FROM_PACKEDBODY)
            packed += BODY
            joint_at.append((packed, articulation.dof))
            packed += 4 * articulation.dof
    width = max(dofs, default=0)
    nothing = packed  # one zero behind all packs: what the padding of shorter articulations reads

    def joint_columns(offset: Callable[[int, int], NDArray[np.int64]]) -> NDArray[np.int64]:
        columns = np.full((len(joint_at), width), nothing, dtype=np.int64)
        for i, (start, dof) in enumerate(joint_at):
            columns[i, :dof] = offset(start, dof)
        return columns

    def stacked(rows: list[NDArray[np.int64]], columns: int) -> NDArray[np.int64]:
        return np.stack(rows) if rows else np.zeros((0, columns), dtype=np.int64)

    every_body = bodies + links
    return Layout(
        bodies=bodies,
        body_rows=np.array(body_rows, dtype=np.int64),
        links=links,
        link_rows=np.array(link_rows, dtype=np.int64),
        articulations=articulations,
        root_rows=np.array(root_rows, dtype=np.int64),
        dofs=np.array(dofs, dtype=np.int64),
        body_at=stacked(body_at, BODY),
        root_at=stacked(root_at, BODY),
        qpos_at=joint_columns(lambda start, dof: start + np.arange(dof)),
        qvel_at=joint_columns(lambda start, dof: start + dof + np.arange(dof)),
        target_qpos_at=joint_columns(lambda start, dof: start + 2 * dof + 2 * np.arange(dof)),
        target_qvel_at=joint_columns(lambda start, dof: start + 2 * dof + 2 * np.arange(dof) + 1),
        entities=row_entities,
        pose_at=stacked(pose_at, 7),
        env_of_row=np.array(env_of_row, dtype=np.int64),
        names=[_IN_ENV.sub("", entity.name) for entity in row_entities],
        articulation_names=[_IN_ENV.sub("", articulation.name) for articulation in articulations],
        row_of={id(b): r for b, r in zip(every_body, [*body_rows, *link_rows], strict=True)},
        index_of={id(a): i for i, a in enumerate(articulations)},
        row_count=row,
    )


def check_layout(
    layout: Layout, packed: NDArray[np.float32], link_poses: Callable[[], NDArray[np.float32]]
) -> None:
    """Compare the packs with the getters, since SAPIEN documents neither their order nor their size.

    Args:
        packed: the packs of all envs, and the zero behind them.
        link_poses: gives the poses (L, 7) that were found in the packs of poses; asked if `packed` has the size.

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

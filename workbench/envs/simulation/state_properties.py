"""ManiSkill's state properties: their place in the tensors, and in SAPIEN's own objects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import sapien
import sapien.physx as physx
import torch
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.articulation import Articulation
from mani_skill.utils.structs.articulation_joint import ArticulationJoint
from mani_skill.utils.structs.base import PhysxRigidBodyComponentStruct, PhysxRigidDynamicComponentStruct
from mani_skill.utils.structs.link import Link
from mani_skill.utils.structs.pose import Pose
from numpy.typing import NDArray

from workbench.envs.simulation.mirrors import Floats, Group, pose_of_row

MirrorName = Literal["bodies", "links", "qpos", "qvel", "qf", "targets", "velocity_targets"]
_POSE, _LINEAR, _ANGULAR = slice(0, 7), slice(7, 10), slice(10, 13)


@dataclass(frozen=True)
class StateProperty:
    """A property of a struct, with a row for each of the struct's objects."""

    owner: type
    """The class that defines it."""
    name: str
    group: Group
    mirror: MirrorName
    columns: slice
    """Columns of the mirror's tensor; a property of a joint uses the joint's ``active_index`` instead."""
    read: Callable[[Any, int], Any]
    """Reads the numbers of the struct's i-th object from SAPIEN."""
    write: Callable[[Any, int, Floats], None] | None = None
    """Writes the numbers, as ManiSkill's setter does on a stock CPU env; None where there is no setter."""

    def rows(self, struct: Any) -> torch.Tensor:
        """(M,) the row of each object in the mirror's tensor."""
        if self.group in ("bodies", "links"):
            body: Any = struct.root if isinstance(struct, Articulation) else struct
            return body._body_data_index
        return struct._data_index

    def at(self, struct: Any, rows: NDArray[np.int64], chosen: NDArray[np.int64]) -> Any:
        """Index into the mirror's tensor for the objects `chosen`, whose rows are `rows`."""
        if isinstance(struct, ArticulationJoint):
            return rows, struct.active_index.numpy()[chosen]
        return rows, self.columns

    def read_all(self, struct: Any) -> Any:
        """The getter's value, read from SAPIEN's objects: (M, W), or (M,) for a joint."""
        values = [np.asarray(self.read(struct, i), np.float32) for i in range(len(struct._objs))]
        width = max(map(len, values)) if values[0].ndim else 0
        rows = [np.pad(v, (0, width - len(v))) for v in values] if width else values
        tensor = torch.from_numpy(np.stack(rows)).to(struct.device)
        return Pose.create(tensor) if self.name == "pose" else tensor


def _numbers(pose: Any) -> list[float]:
    return [*pose.p, *pose.q]


def _setter(owner: type, name: str) -> Callable[[Any, Any], None]:
    """SAPIEN's own setter, which `accessors` later replaces on the class by a guarded one."""
    return vars(owner)[name].fset


_ENTITY_POSE, _LINK_POSE = _setter(sapien.Entity, "pose"), _setter(sapien.Component, "pose")
_VELOCITY = {
    name: _setter(physx.PhysxRigidDynamicComponent, name) for name in ("linear_velocity", "angular_velocity")
}
_ROOT_VELOCITY = {
    name: _setter(physx.PhysxArticulation, name) for name in ("root_linear_velocity", "root_angular_velocity")
}
_JOINTS = {name: _setter(physx.PhysxArticulation, name) for name in ("qpos", "qvel", "qf")}
_TARGETS = {
    name: _setter(physx.PhysxArticulationJoint, name) for name in ("drive_target", "drive_velocity_target")
}


def _write_velocity(struct: Any, i: int, row: Floats, name: str) -> None:
    body = struct._bodies[i]
    # ManiSkill's `set_state` sets the velocity of every actor; a stock CPU env sets it only for dynamic ones.
    if not body.kinematic:
        _VELOCITY[name](body, row)


def _write_joint(struct: Any, i: int, row: Floats, name: str) -> None:
    articulation = struct._physx_articulations[i]
    every = getattr(articulation, name)
    every[int(struct.active_index[i])] = row
    _JOINTS[name](articulation, every)


def _read_joint(struct: Any, i: int, name: str) -> Any:
    return getattr(struct._physx_articulations[i], name)[int(struct.active_index[i])]


def _of_articulation(name: Literal["qpos", "qvel", "qf"], group: Group) -> StateProperty:
    return StateProperty(
        Articulation,
        name,
        group,
        name,
        slice(None),
        lambda s, i: getattr(s._objs[i], name),
        lambda s, i, row: _JOINTS[name](s._objs[i], row[: s._objs[i].dof]),
    )


def _of_joint(name: Literal["qpos", "qvel"], written: bool) -> StateProperty:
    return StateProperty(
        ArticulationJoint,
        name,
        "joints",
        name,
        slice(None),
        lambda s, i: _read_joint(s, i, name),
        (lambda s, i, row: _write_joint(s, i, row, name)) if written else None,
    )


def _target(name: str, mirror: MirrorName) -> StateProperty:
    return StateProperty(
        ArticulationJoint,
        name,
        "targets",
        mirror,
        slice(None),
        lambda s, i: float(np.ravel(getattr(s._objs[i], name))[0]),
        lambda s, i, row: _TARGETS[name](s._objs[i], np.ravel(row)),
    )


STATE_PROPERTIES = (
    StateProperty(
        Actor,
        "pose",
        "bodies",
        "bodies",
        _POSE,
        lambda s, i: _numbers(s._objs[i].pose),
        lambda s, i, row: _ENTITY_POSE(s._objs[i], pose_of_row(row)),
    ),
    StateProperty(
        PhysxRigidDynamicComponentStruct,
        "linear_velocity",
        "bodies",
        "bodies",
        _LINEAR,
        lambda s, i: s._bodies[i].linear_velocity,
        lambda s, i, row: _write_velocity(s, i, row, "linear_velocity"),
    ),
    StateProperty(
        PhysxRigidDynamicComponentStruct,
        "angular_velocity",
        "bodies",
        "bodies",
        _ANGULAR,
        lambda s, i: s._bodies[i].angular_velocity,
        lambda s, i, row: _write_velocity(s, i, row, "angular_velocity"),
    ),
    StateProperty(
        Link,
        "pose",
        "links",
        "links",
        _POSE,
        lambda s, i: _numbers(s._objs[i].entity_pose),
        lambda s, i, row: _LINK_POSE(s._objs[i], pose_of_row(row)),
    ),
    StateProperty(
        PhysxRigidBodyComponentStruct,
        "linear_velocity",
        "links",
        "links",
        _LINEAR,
        lambda s, i: s._bodies[i].linear_velocity,
    ),
    StateProperty(
        PhysxRigidBodyComponentStruct,
        "angular_velocity",
        "links",
        "links",
        _ANGULAR,
        lambda s, i: s._bodies[i].angular_velocity,
    ),
    StateProperty(
        Articulation,
        "root_linear_velocity",
        "links",
        "links",
        _LINEAR,
        lambda s, i: s._objs[i].links[0].linear_velocity,
        lambda s, i, row: _ROOT_VELOCITY["root_linear_velocity"](s._objs[i], row),
    ),
    StateProperty(
        Articulation,
        "root_angular_velocity",
        "links",
        "links",
        _ANGULAR,
        lambda s, i: s._objs[i].links[0].angular_velocity,
        lambda s, i, row: _ROOT_VELOCITY["root_angular_velocity"](s._objs[i], row),
    ),
    _of_articulation("qpos", "joints"),
    _of_articulation("qvel", "joints"),
    _of_articulation("qf", "forces"),
    _of_joint("qpos", written=True),
    _of_joint("qvel", written=False),
    _target("drive_target", "targets"),
    _target("drive_velocity_target", "velocity_targets"),
)
TARGETS_OF_ALL = {
    "drive_targets": "drive_target",
    "drive_velocities": "drive_velocity_target",
}
"""Properties of an Articulation, with the property of each active joint that they collect."""
TARGET_SETTERS: dict[str, MirrorName] = {
    "set_joint_drive_targets": "targets",
    "set_joint_drive_velocity_targets": "velocity_targets",
}
"""Methods of an Articulation that set drive targets."""

"""SAPIEN's own setters of state, which the GPU's simulation does not look at.

``actor._objs[0].set_pose(...)`` moves a body on a stock CPU env. In GPU simulation the state lives
on the GPU, and the call changes an object that nobody reads. Here SAPIEN's objects are the
simulation, so the call would work, and the task that was tried out would not be the task that trains.
Where rules are checked, these setters tell of it, at the author's line.

SAPIEN's classes are shared by all scenes of a process: the setters are replaced once, when the first
scene with rules is built, and do what they did for every object that belongs to none, before a
scene is complete, and when the core itself calls them.
"""

from __future__ import annotations

import sys
import weakref
from collections.abc import Callable
from functools import cache
from typing import Any

import sapien
import sapien.physx as physx

from workbench.core.strict_system import StrictCpuSystem

_MOTION = "Actor.set_linear_velocity() and Actor.set_angular_velocity()"
_ROOT = "the Articulation's setters (set_root_pose(), set_root_linear_velocity() ...)"
GUARDED: dict[type, dict[str, str]] = {
    sapien.Entity: {"pose": "Actor.set_pose()"},
    sapien.Component: {"pose": "Actor.set_pose()", "entity_pose": "Actor.set_pose()"},
    physx.PhysxRigidDynamicComponent: {
        "linear_velocity": _MOTION,
        "angular_velocity": _MOTION,
        "kinematic_target": "Actor.set_pose()",
    },
    physx.PhysxArticulation: {
        "qpos": "Articulation.set_qpos()",
        "qvel": "Articulation.set_qvel()",
        "qf": "Articulation.set_qf()",
        "pose": _ROOT,
        "root_pose": _ROOT,
        "root_linear_velocity": _ROOT,
        "root_angular_velocity": _ROOT,
    },
    physx.PhysxArticulationJoint: {
        "drive_target": "Articulation.set_joint_drive_targets()",
        "drive_velocity_target": "Articulation.set_joint_drive_velocity_targets()",
    },
}
"""Properties with a setter of the same name, ``set_...``, and what to use in their place."""
GUARDED_METHODS: dict[type, dict[str, str]] = {
    physx.PhysxRigidBodyComponent: {
        "add_force_at_point": "Actor.apply_force()",
        "add_force_torque": "Actor.apply_force()",
    },
}

_strict_systems: weakref.WeakSet[StrictCpuSystem] = weakref.WeakSet()
"""Asked for their scenes each time, since a restored snapshot gives an env another scene."""


def guard_scenes(system: StrictCpuSystem) -> None:
    """Let the setters of what is in the scenes of `system` raise, once it is laid out."""
    _install()
    _strict_systems.add(system)


@cache
def _install() -> None:
    for owner, names in GUARDED.items():
        for name, instead in names.items():
            stock: property = owner.__dict__[name]
            assert stock.fset is not None
            guarded = _guarded(stock.fset, f"{owner.__name__}.{name} = ...", instead)
            setattr(owner, name, property(stock.fget, guarded, doc=stock.__doc__))
            setter = f"set_{name}"
            if setter in owner.__dict__:
                method = _guarded(owner.__dict__[setter], f"{owner.__name__}.{setter}()", instead)
                setattr(owner, setter, method)
    for owner, names in GUARDED_METHODS.items():
        for name, instead in names.items():
            setattr(owner, name, _guarded(owner.__dict__[name], f"{owner.__name__}.{name}()", instead))


def _guarded(stock: Any, called: str, instead: str) -> Callable[..., Any]:
    stock = getattr(stock, "__func__", stock)  # pybind11's methods are wrapped in an instancemethod

    def call(self: Any, *args: Any, **kwargs: Any) -> Any:
        if _strict_systems and not sys._getframe(1).f_globals.get("__name__", "").startswith(
            "workbench.core."
        ):
            _refuse(self, called, instead)
        return stock(self, *args, **kwargs)

    call.__doc__, call.__wrapped__ = stock.__doc__, stock  # type: ignore[attr-defined]
    return call


def _refuse(owner: Any, called: str, instead: str) -> None:
    entity = _entity(owner)
    if entity is None or entity.scene is None:
        return
    for system in _strict_systems:
        env = next((i for i, scene in enumerate(system.scenes) if scene is entity.scene), None)
        if env is None or not system.laid_out:
            continue
        name = owner.name if isinstance(owner, physx.PhysxArticulation) else entity.name
        if system.being_reset is not None and not bool(system.being_reset[env]):
            system.rules.breaks(
                "other-env-written",
                f"{called} on '{name}' writes env {env}, which is not being reset (on the GPU it does nothing). Use "
                f"{instead} of ManiSkill's object, which sets those that are being reset.",
            )
        else:
            system.rules.breaks(
                "behind-the-tensors",
                f"{called} on '{name}' (env {env}) goes behind the tensors: on the GPU it does nothing. Use {instead} "
                "of ManiSkill's object, which sets all envs, or those that are being reset.",
            )


def _entity(owner: Any) -> Any:
    """The entity of a physical thing; None for cameras, lights and whatever else has a pose."""
    if isinstance(owner, physx.PhysxArticulation):
        return owner.links[0].entity
    if isinstance(owner, physx.PhysxArticulationJoint):
        return owner.child_link.entity
    if isinstance(owner, sapien.Entity):
        return owner if owner.find_component_by_type(physx.PhysxRigidBaseComponent) is not None else None
    return owner.entity if isinstance(owner, physx.PhysxRigidBaseComponent) else None

"""Wraps ManiSkill's and SAPIEN's state setters and getters with clear errors and rule checks."""

from __future__ import annotations

import sys
import weakref
from collections.abc import Callable
from functools import cache
from typing import Any

import sapien
import sapien.physx as physx
import torch
from mani_skill.utils import common
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.articulation import Articulation
from mani_skill.utils.structs.articulation_joint import ArticulationJoint
from mani_skill.utils.structs.base import PhysxRigidBodyComponentStruct, PhysxRigidDynamicComponentStruct
from mani_skill.utils.structs.link import Link
from mani_skill.utils.structs.pose import vectorize_pose

from workbench.core.error_notes import CoreRefusal, RefusedCall, RefusedValue
from workbench.core.simulation.cpu_system import batched_system
from workbench.core.simulation.mirrors import Group
from workbench.core.simulation.strict_system import StrictCpuSystem

Index = Callable[[Any], torch.Tensor]

STATE_PROPERTIES: tuple[tuple[type, str, Group], ...] = (
    (Actor, "pose", "bodies"),
    (PhysxRigidDynamicComponentStruct, "linear_velocity", "bodies"),
    (PhysxRigidDynamicComponentStruct, "angular_velocity", "bodies"),
    (Link, "pose", "links"),
    (PhysxRigidBodyComponentStruct, "linear_velocity", "links"),
    (PhysxRigidBodyComponentStruct, "angular_velocity", "links"),
    (Articulation, "root_linear_velocity", "links"),
    (Articulation, "root_angular_velocity", "links"),
    (Articulation, "qpos", "joints"),
    (Articulation, "qvel", "joints"),
    (Articulation, "qf", "forces"),
    (ArticulationJoint, "qpos", "joints"),
    (ArticulationJoint, "qvel", "joints"),
    (ArticulationJoint, "drive_target", "targets"),
    (ArticulationJoint, "drive_velocity_target", "targets"),
)
"""ManiSkill's properties of state, and the group of tensors that each is fetched and applied with."""

TARGET_SETTERS = ("set_joint_drive_targets", "set_joint_drive_velocity_targets")


@cache
def install_struct_access() -> None:
    """Wrap ManiSkill's setters and getters of state, once a process; a stock scene gets the stock code.

    A value of another batch size stops in torch ("shape mismatch: value tensor of shape [4, 7] cannot be broadcast to indexing
    result of shape [2, 7]"), a static actor in an assertion, its velocity in a KeyError. The wrappers raise from the author's
    call, name the object and the batch that is expected, and report each read and write to a `StrictCpuSystem`.
    """
    for owner, name, group in STATE_PROPERTIES:
        stock: property = owner.__dict__[name]
        getter = _checked_reads(stock.fget, name, group)  # type: ignore[arg-type]
        setter = None if stock.fset is None else _checked_writes(stock.fset, name, group)
        setattr(owner, name, property(getter, setter, doc=stock.__doc__))
    for name in TARGET_SETTERS:
        setattr(Articulation, name, _checked_writes(Articulation.__dict__[name], "drive targets", "targets"))


def _rows(struct: Any, group: Group) -> torch.Tensor:
    """Rows of `struct` in the group's tensor, one an env."""
    if group in ("bodies", "links"):
        body: Any = struct.root if isinstance(struct, Articulation) else struct
        return body._body_data_index
    return struct._data_index


def _checked_reads(stock: Callable[[Any], Any], name: str, group: Group) -> Callable[[Any], Any]:
    velocity = name.endswith("velocity")

    def get(self: Any) -> Any:
        system = self.scene.px
        if velocity and group == "bodies" and self.px_body_type == "static" and batched_system(self.scene):
            raise RefusedCall(f"'{self.name}' is static: it has no velocity on the GPU, nor here.")
        # Poses of static actors are not in the tensors.
        if type(system) is StrictCpuSystem and group != "targets" and system.laid_out:
            if not (group == "bodies" and self.px_body_type == "static"):
                system.about_to_read(self, group, _rows(self, group))
        return stock(self)

    return get


def _checked_writes(stock: Callable[..., None], name: str, group: Group) -> Callable[..., None]:
    # Authors may pass the value of `set_joint_drive_targets` as the keyword "targets".
    def put(self: Any, targets: Any, *args: Any, **kwargs: Any) -> None:
        system = batched_system(self.scene)
        if system is None:
            return stock(self, targets, *args, **kwargs)
        if group == "bodies" and self.px_body_type == "static":
            raise RefusedCall(
                f"'{self.name}' is static: on the GPU, and here, a static actor cannot be moved once the scene "
                "is built. Give it its initial_pose before build_static(), or build it with build_kinematic()."
            )
        if group == "targets" and not system.laid_out:
            raise RefusedCall(
                f"A drive target of '{getattr(self, 'articulation', self).name}' was set before the simulation is "
                "initialised: in _load_agent and _load_scene it has none yet, on the GPU or here. Set one that stays in "
                "_after_reconfigure(self, options), and one of each episode in _initialize_episode, with "
                "articulation.set_joint_drive_targets(targets, joints=[...])."
            )
        if type(system) is StrictCpuSystem and system.laid_out:
            system.about_to_write(self, group, _rows(self, group)[_mask(self)])
        try:
            stock(self, targets, *args, **kwargs)
        except CoreRefusal:
            raise
        except (RuntimeError, IndexError) as error:
            _explain(self, targets, name, error)
            if group == "targets" and isinstance(self, ArticulationJoint):
                _explain_single_joint(self, name, error)
            raise

    return put


def _mask(struct: Any) -> torch.Tensor:
    """(M,) which of the struct's objects a setter writes now."""
    return struct.scene._reset_mask[struct._scene_idxs.long()]


def _explain_single_joint(joint: ArticulationJoint, name: str, error: Exception) -> None:
    """Raise a clear error if `error` comes from ManiSkill's own index of a joint.

    ManiSkill 3.0.1 puts the rows of the envs that are reset together with the joints of all: no value fits.
    """
    wanted, every = int(_mask(joint).sum()), len(joint._objs)
    if not 1 < wanted < every:
        return
    setter = "set_joint_drive_targets" if name == "drive_target" else "set_joint_drive_velocity_targets"
    raise RefusedCall(
        f"joint.set_{name}() of '{joint.name}' takes no value where {wanted} of {every} envs are reset, on the GPU as here: "
        f"ManiSkill puts the rows of {wanted} envs together with the joints of {every}. Set it through the articulation "
        f"instead: joint.articulation.{setter}(targets, joints=[joint]) with targets of shape ({wanted}, 1)."
    ) from error


def _explain(struct: Any, value: Any, name: str, error: Exception) -> None:
    """Raise a clear error if `error` comes from the batch size of `value`."""
    wanted = int(_mask(struct).sum())
    value = vectorize_pose(value) if name == "pose" else common.to_tensor(value)
    if value.ndim < 2 or len(value) in (1, wanted):
        return
    reset = (
        "one for each env that is being reset, len(env_idx)"
        if wanted != len(struct._objs)
        else "one for each env that has it"
    )
    raise RefusedValue(
        f"The {name.replace('_', ' ')} of '{struct.name}' was set with a batch of {len(value)} (shape "
        f"{tuple(value.shape)}), but {wanted} {'row is' if wanted == 1 else 'rows are'} wanted: {reset}."
    ) from error


# --- SAPIEN's own setters ----------------------------------------------------------------------------


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
    physx.PhysxRigidBodyComponent: {
        "add_force_at_point": "Actor.apply_force()",
        "add_force_torque": "Actor.apply_force()",
    },
}
"""Properties (also their ``set_...``) and methods, and what to use instead."""

_strict_systems: weakref.WeakSet[StrictCpuSystem] = weakref.WeakSet()
"""Their scenes are read at each call, since a restored snapshot gives an env another scene."""


def guard_scenes(system: StrictCpuSystem) -> None:
    """Report SAPIEN's own setters of state in the scenes of `system`, once it is laid out.

    ``actor._objs[0].set_pose(...)`` moves a body on a stock CPU env and does nothing in GPU simulation. SAPIEN's classes are
    shared by all scenes of a process: the setters are replaced once, and do as before for objects of other scenes, before a
    scene is complete, and when the core calls them.
    """
    _install()
    _strict_systems.add(system)


@cache
def _install() -> None:
    for owner, names in GUARDED.items():
        for name, instead in names.items():
            stock = owner.__dict__[name]
            if isinstance(stock, property):
                guarded = _guarded(stock.fset, f"{owner.__name__}.{name} = ...", instead)
                setattr(owner, name, property(stock.fget, guarded, doc=stock.__doc__))
                name = f"set_{name}"
            if name in owner.__dict__:
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
            system.rules.report_breach(
                "other-env-written",
                f"{called} on '{name}' writes env {env}, which is not being reset (on the GPU it does nothing). Use "
                f"{instead} of ManiSkill's object, which sets those that are being reset.",
            )
        else:
            system.rules.report_breach(
                "behind-the-tensors",
                f"{called} on '{name}' (env {env}) goes behind the tensors: on the GPU it does nothing. Use {instead} "
                "of ManiSkill's object, which sets all envs, or those that are being reset.",
            )


def _entity(owner: Any) -> Any:
    """The entity of a physical body; None for cameras, lights and others."""
    if isinstance(owner, physx.PhysxArticulation):
        return owner.links[0].entity
    if isinstance(owner, physx.PhysxArticulationJoint):
        return owner.child_link.entity
    if isinstance(owner, sapien.Entity):
        return owner if owner.find_component_by_type(physx.PhysxRigidBaseComponent) is not None else None
    return owner.entity if isinstance(owner, physx.PhysxRigidBaseComponent) else None

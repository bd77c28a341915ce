"""Wraps ManiSkill's and SAPIEN's state setters and getters: they work as on a stock CPU env, and report to the rules."""

from __future__ import annotations

import copy
import sys
import weakref
from collections.abc import Callable
from functools import cache, wraps
from typing import Any

import numpy as np
import sapien
import sapien.physx as physx
import torch
from mani_skill.utils import common
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.articulation import Articulation
from mani_skill.utils.structs.articulation_joint import ArticulationJoint
from mani_skill.utils.structs.base import PhysxRigidBodyComponentStruct, PhysxRigidDynamicComponentStruct
from mani_skill.utils.structs.drive import Drive
from mani_skill.utils.structs.link import Link
from mani_skill.utils.structs.pose import vectorize_pose
from mani_skill.utils.structs.render_camera import RenderCamera
from numpy.typing import NDArray

from workbench.envs.broken_rule import OWN_CODE
from workbench.envs.error_notes import RefusedValue
from workbench.envs.simulation.cpu_system import BatchedCpuSystem, batched_system
from workbench.envs.simulation.state_properties import (
    STATE_PROPERTIES,
    TARGET_SETTERS,
    TARGETS_OF_ALL,
    StateProperty,
)
from workbench.envs.simulation.strict_system import StrictCpuSystem


@cache
def install_struct_access() -> None:
    """Wrap ManiSkill's setters and getters of state, once per process; a stock scene gets the stock code.

    ManiSkill has two implementations of each: one for a single CPU env, which calls SAPIEN's objects, and one for the GPU,
    which reads and writes tensors. Here the second one runs, and what it writes is also written to SAPIEN's objects; while
    the scene is built there are no tensors, and only SAPIEN's objects are read and written. `StrictCpuSystem` is notified of
    each call, and reports where a GPU behaves differently.
    """
    for each in STATE_PROPERTIES:
        stock: property = each.owner.__dict__[each.name]
        getter = _getter(stock.fget, each)  # type: ignore[arg-type]
        setter = None if each.write is None else _setter(stock.fset, each)  # type: ignore[arg-type]
        setattr(each.owner, each.name, property(getter, setter, doc=stock.__doc__))
    for name, of_joint in TARGETS_OF_ALL.items():
        stock = Articulation.__dict__[name]
        setattr(
            Articulation,
            name,
            property(_getter_of_targets(stock.fget, of_joint), doc=stock.__doc__),  # type: ignore[arg-type]
        )
    for name in TARGET_SETTERS:
        setattr(Articulation, name, _target_setter(Articulation.__dict__[name], name))
    for owner, names in FIXED_ONCE_BUILT.items():
        for name in names:
            stock = owner.__dict__[name]
            if isinstance(stock, property):
                setattr(owner, name, property(stock.fget, _of_chosen(stock.fset, name), doc=stock.__doc__))  # type: ignore[arg-type]
            else:
                setattr(owner, name, _of_chosen(stock, name))
    _install_cpu_only()


def _chosen(struct: Any) -> NDArray[np.int64]:
    """Indices of the struct's objects that a setter writes now."""
    return np.flatnonzero(struct.scene._reset_mask[struct._scene_idxs.long()].numpy())


def _is_removed(rows: torch.Tensor) -> bool:
    return bool((rows < 0).any())


def _is_static(struct: Any, each: StateProperty) -> bool:
    return each.group == "bodies" and struct.px_body_type == "static"


# --- reading -----------------------------------------------------------------------------------------


def _getter(stock: Callable[[Any], Any], each: StateProperty) -> Callable[[Any], Any]:
    velocity = each.name.endswith("velocity")

    @wraps(stock)
    def get(self: Any) -> Any:
        system = batched_system(self.scene)
        if system is None:
            return stock(self)
        if _is_static(self, each):
            if velocity:
                raise AttributeError(f"'{self.name}' is static: it has no velocity.")
            return each.read_all(self) if system.static_moves else stock(self)
        if not system.laid_out:
            _report_early(system, self, "read")
            return each.read_all(self)
        if system.layout_version > 1 and _is_removed(each.rows(self)):
            return each.read_all(self)
        if type(system) is StrictCpuSystem and each.group != "targets":
            system.about_to_read(self, each.group, each.rows(self).numpy())
        return stock(self)

    return get


def _getter_of_targets(stock: Callable[[Any], Any], of_joint: str) -> Callable[[Any], Any]:
    @wraps(stock)
    def get(self: Any) -> Any:
        system = batched_system(self.scene)
        if system is None or system.laid_out:
            return stock(self)
        return torch.stack([getattr(joint, of_joint) for joint in self.active_joints], dim=1)

    return get


def _report_early(system: BatchedCpuSystem, struct: Any, done: str) -> None:
    name = getattr(struct, "articulation", None) or struct
    system.report(
        "state-while-built",
        f"The state of '{name.name}' is {done} while the scene is built: on the GPU this fails, because "
        "there are no tensors of state yet. Do it in _after_reconfigure(self, options) for a value that "
        "stays, or in _initialize_episode for a value with which each episode begins.",
    )


# --- writing -----------------------------------------------------------------------------------------


def _setter(stock: Callable[..., None], each: StateProperty) -> Callable[..., None]:
    assert each.write is not None
    write = each.write

    @wraps(stock)
    def put(self: Any, value: Any) -> None:
        system = batched_system(self.scene)
        if system is None:
            return stock(self, value)
        chosen = _chosen(self)
        static = _is_static(self, each)
        removed = system.layout_version > 1 and not static and _is_removed(each.rows(self))
        if static or removed or not system.laid_out:
            if static and each.name != "pose":
                raise AttributeError(f"'{self.name}' is static: it has no velocity.")
            _put_directly(system, self, each, value, chosen)
            return
        rows = each.rows(self).numpy()[chosen].astype(np.int64)
        system.about_to_write(self, each.group, rows)
        mirror, at = system.mirror(each.mirror), each.at(self, rows, chosen)
        if isinstance(self, ArticulationJoint):
            # ManiSkill's setter would combine the rows of the envs being reset with the joints of all envs.
            mirror.now[at] = np.ravel(_rows(self, value, each.name, chosen))
        else:
            _stock_write(stock, self, value, each.name, chosen)
        if each.group == "targets":
            return system.note_targets(mirror, rows)
        values = mirror.now[at]

        def write_rows(whole: NDArray[np.bool_]) -> None:
            for i, row in zip(chosen[whole].tolist(), values[whole], strict=True):
                write(self, i, row)

        system.write_through(mirror, at, values, write_rows)

    return put


def _put_directly(
    system: BatchedCpuSystem, struct: Any, each: StateProperty, value: Any, chosen: NDArray[np.int64]
) -> None:
    """Write state that is in no tensor to SAPIEN's objects: static or removed actors, and everything while the scene is built."""
    assert each.write is not None
    if system.laid_out and _is_static(struct, each):
        system.refused_by_gpu(
            f"'{struct.name}' is a static actor and is moved: on the GPU this fails once the scene is built. "
            "Set its initial_pose before build_static(), or build it with build_kinematic()."
        )
        if system.held_back:
            return
    elif not system.laid_out:
        _report_early(system, struct, "set")
    system.static_moves += _is_static(struct, each)
    rows = _rows(struct, value, each.name, chosen)
    for i, row in zip(chosen.tolist(), rows, strict=True):
        each.write(struct, i, row)


def _target_setter(stock: Callable[..., None], name: str) -> Callable[..., None]:
    mirror = TARGET_SETTERS[name]
    of_joint = "drive_target" if mirror == "targets" else "drive_velocity_target"

    @wraps(stock)
    def put(self: Any, targets: Any, joints: Any = None, joint_indices: Any = None) -> None:
        system = batched_system(self.scene)
        if system is None:
            return stock(self, targets, joints, joint_indices)
        chosen = _chosen(self)
        if not system.laid_out:
            _report_early(system, self, "set")
            own = joints if joints is not None else [self.active_joints[int(i)] for i in joint_indices]
            rows = np.broadcast_to(_rows(self, targets, name, chosen), (len(chosen), len(own)))
            for i, row in zip(chosen.tolist(), rows, strict=True):
                for joint, target in zip(own, row, strict=True):
                    setattr(joint._objs[i], of_joint, np.ravel(target))
            return
        rows = self._data_index.numpy()[chosen].astype(np.int64)
        system.about_to_write(self, "targets", rows)
        _stock_write(
            lambda struct, value: stock(struct, value, joints, joint_indices),
            self,
            targets,
            "drive targets",
            chosen,
        )
        system.note_targets(system.mirror(mirror), rows)

    return put


def _stock_write(
    stock: Callable[[Any, Any], None], struct: Any, value: Any, name: str, chosen: NDArray[np.int64]
) -> None:
    system: Any = batched_system(struct.scene)
    system.is_writing = True
    try:
        stock(struct, value)
    except (RuntimeError, IndexError) as error:
        vector: Any = vectorize_pose(value) if name == "pose" else common.to_tensor(value)
        if vector.ndim < 2 or len(vector) in (1, len(chosen)):
            raise
        try:
            rows = _rows(struct, value, name, chosen)
        except ValueError as refused:
            raise refused from error
        stock(struct, torch.from_numpy(np.array(rows)))
    finally:
        system.is_writing = False


def _rows(struct: Any, value: Any, name: str, chosen: NDArray[np.int64]) -> NDArray[np.float32]:
    """(k, ...) float32: the rows that a setter writes to the struct's objects `chosen`.

    If a batch has the wrong size, stock ManiSkill on the CPU takes its first row. Here the first row is taken
    if the struct has one object. If the batch has a row for each object, its rows of `chosen` are taken. Both
    cases report `refused-by-gpu`.

    Raises:
        ValueError: the batch has any other size.
    """
    given: Any = vectorize_pose(value) if name == "pose" else common.to_tensor(value)
    numbers = np.asarray(given.detach().cpu(), np.float32)
    of_joint = isinstance(struct, ArticulationJoint)
    if of_joint:
        numbers = numbers.reshape(-1) if numbers.size != 1 else numbers.reshape(())
    wanted, every = len(chosen), len(struct._objs)
    if numbers.ndim < (1 if of_joint else 2):
        return np.broadcast_to(numbers, (wanted, *numbers.shape))
    if len(numbers) in (1, wanted):
        return np.broadcast_to(numbers, (wanted, *numbers.shape[1:]))
    system = batched_system(struct.scene)
    assert system is not None
    if every == 1 or len(numbers) == every:
        system.refused_by_gpu(
            f"The {name.replace('_', ' ')} of '{struct.name}' is set with {len(numbers)} rows, and {wanted} "
            f"{'is' if wanted == 1 else 'are'} wanted: on the GPU this fails. "
            + (
                "Here the first row is used."
                if every == 1
                else "Give len(env_idx) rows, one for each env of env_idx."
            )
        )
        return numbers[:1] if every == 1 else numbers[chosen]
    reset = (
        "one for each env that is being reset, len(env_idx)"
        if wanted != every
        else "one for each env that has it"
    )
    raise RefusedValue(
        f"The {name.replace('_', ' ')} of '{struct.name}' was set with a batch of {len(numbers)} (shape "
        f"{tuple(numbers.shape)}), but {wanted} {'row is' if wanted == 1 else 'rows are'} wanted: {reset}."
    )


# --- methods that a stock CPU env has at any time -------------------------------------------------------


FIXED_ONCE_BUILT: dict[type, tuple[str, ...]] = {
    PhysxRigidBodyComponentStruct: ("angular_damping", "disable_gravity", "linear_damping", "mass"),
    PhysxRigidDynamicComponentStruct: ("locked_motion_axes",),
    Actor: ("set_collision_group_bit", "set_collision_group"),
    Link: ("set_collision_group_bit", "set_collision_group"),
    ArticulationJoint: ("friction", "limits", "set_drive_properties"),
    Drive: (
        *("set_drive_property_x", "set_drive_property_y", "set_drive_property_z"),
        *("set_limit_x", "set_limit_y", "set_limit_z"),
    ),
}
"""Setters and methods of properties that are not state; the GPU refuses most of them once it runs."""
_WORK_ON_THE_GPU = {"friction", "set_drive_properties", "set_collision_group_bit", "set_collision_group"}


def _of_chosen(stock: Callable[..., Any], name: str) -> Callable[..., Any]:
    """Wrap a method of ManiSkill that changes all envs: in a partial reset it changes only the envs that are being
    reset."""

    @wraps(stock)
    def call(self: Any, *args: Any, **kwargs: Any) -> Any:
        system = batched_system(self.scene)
        if system is None or not system.laid_out:
            return stock(self, *args, **kwargs)
        if name not in _WORK_ON_THE_GPU:
            system.refused_by_gpu(
                f"{name} of '{getattr(self, 'name', None) or type(self).__name__}' is set after the scene "
                "was built: on the GPU this fails. Set it in _load_scene or _load_agent; with "
                "reconfiguration_freq=1 they run before each episode."
            )
        return None if system.held_back else stock(_some(self, _chosen(self)), *args, **kwargs)

    return call


def _some(struct: Any, chosen: NDArray[np.int64]) -> Any:
    """Copy of the struct with only the objects `chosen`; the struct itself if all are chosen."""
    if len(chosen) == len(struct._objs):
        return struct
    some = copy.copy(struct)
    some._objs = [struct._objs[i] for i in chosen]
    if hasattr(struct, "_bodies"):
        some._bodies = [struct._bodies[i] for i in chosen]
    for rows in ("_body_data_index", "_data_index"):
        vars(some).pop(rows, None)
    return some


def _install_cpu_only() -> None:
    """Install methods that ManiSkill has only for its single CPU env."""
    stock_type: Any = ArticulationJoint.__dict__["type"]
    stock_force, stock_model = Articulation.compute_passive_force, Articulation.create_pinocchio_model
    stock_remove = Actor.remove_from_scene

    @wraps(stock_type.fset)
    def set_type(self: Any, arg1: Any) -> None:
        system = batched_system(self.scene)
        if system is None:
            return stock_type.fset(self, arg1)
        if system.laid_out:
            system.refused_by_gpu(f"The type of joint '{self.name}' is set: on the GPU this fails.")
        for i in () if system.held_back else _chosen(self):
            self._objs[i].type = arg1

    @wraps(stock_force)
    def compute_passive_force(self: Any, *args: Any, **kwargs: Any) -> Any:
        system = batched_system(self.scene)
        if system is None:
            return stock_force(self, *args, **kwargs)
        system.refused_by_gpu(f"Passive forces of '{self.name}' are computed: on the GPU this fails.")
        forces = [articulation.compute_passive_force(*args, **kwargs) for articulation in self._objs]
        return forces[0] if len(forces) == 1 else np.stack(forces)

    @wraps(stock_model)
    def create_pinocchio_model(self: Any) -> Any:
        system = batched_system(self.scene)
        if system is None:
            return stock_model(self)
        system.refused_by_gpu(f"A pinocchio model of '{self.name}' is made: on the GPU this fails.")
        return self._objs[0].create_pinocchio_model()

    @wraps(stock_remove)
    def remove_from_scene(self: Any) -> None:
        system = batched_system(self.scene)
        if system is None:
            return stock_remove(self)
        if system.laid_out:
            system.refused_by_gpu(
                f"'{self.name}' is removed from the scene: on the GPU this fails. Move it out of sight."
            )
        for i in () if system.held_back else _chosen(self):
            self._objs[i].remove_from_scene()
        system.note_structure()

    ArticulationJoint.type = property(stock_type.fget, set_type, doc=stock_type.__doc__)  # type: ignore[method-assign,assignment]
    Articulation.compute_passive_force = compute_passive_force  # type: ignore[method-assign]
    Articulation.create_pinocchio_model = create_pinocchio_model  # type: ignore[method-assign]
    Actor.remove_from_scene = remove_from_scene  # type: ignore[method-assign]
    for name in _OF_CAMERAS:
        stock: Any = RenderCamera.__dict__[name]
        if isinstance(stock, property):
            setattr(
                RenderCamera,
                name,
                property(stock.fget, _of_chosen_cameras(stock.fset), doc=stock.__doc__),  # type: ignore[arg-type]
            )
        else:
            setattr(RenderCamera, name, _of_chosen_cameras(stock))
    for name in ("get_collision_meshes", "get_visual_meshes"):
        setattr(Articulation, name, _with_link_poses(Articulation.__dict__[name]))


_OF_CAMERAS = (
    *(
        "local_pose",
        "near",
        "far",
        "set_local_pose",
        "set_near",
        "set_far",
        "set_fovx",
        "set_fovy",
        "set_skew",
    ),
    *("set_focal_lengths", "set_perspective_parameters", "set_principal_point"),
)


def _of_chosen_cameras(stock: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a method of cameras to apply only to the envs that are being reset. Clears the matrices that
    ManiSkill caches."""

    @wraps(stock)
    def call(self: Any, *args: Any, **kwargs: Any) -> Any:
        if batched_system(self.scene) is None:
            return stock(self, *args, **kwargs)
        some = copy.copy(self)
        chosen = np.flatnonzero(self.scene._reset_mask.numpy())
        some._render_cameras = [self._render_cameras[i] for i in chosen]
        self._cached_local_pose = self._cached_extrinsic_matrix = self._cached_model_matrix = None
        return stock(some, *args, **kwargs)

    return call


def _with_link_poses(stock: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a method that reads link poses: while the scene is built, they are wrong until the root pose is
    set again."""

    @wraps(stock)
    def call(self: Any, *args: Any, **kwargs: Any) -> Any:
        system = batched_system(self.scene)
        if system is not None and not system.laid_out:
            for articulation in self._objs:
                articulation.pose = articulation.pose
        return stock(self, *args, **kwargs)

    return call


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
"""Properties (and their ``set_...``) and methods of SAPIEN, each with ManiSkill's method to use instead."""

_systems: weakref.WeakSet[BatchedCpuSystem] = weakref.WeakSet()
"""Systems of batched scenes. Each call of a guarded setter reads their scenes, since a restored snapshot
gives an env another scene."""


def guard_scenes(system: BatchedCpuSystem) -> None:
    """Watch SAPIEN's own setters of state in the scenes of `system`, once it is laid out.

    ``actor._objs[0].set_pose(...)`` moves a body on a stock CPU env and does nothing in GPU simulation. Here
    it moves the body, unless a partial reset is under way and the body's env is not being reset: a stock env
    that is not being reset would not run this code at all. All scenes of a process share SAPIEN's classes, so
    the setters are replaced once. They work as before for objects of other scenes, before a scene is
    complete, and when the core calls them.
    """
    _install()
    _systems.add(system)


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
        if not _systems or sys._getframe(1).f_globals.get("__name__", "").startswith(OWN_CODE):
            return stock(self, *args, **kwargs)
        system, env = _system_of(self)
        if system is None:
            return stock(self, *args, **kwargs)
        if not _may_write(system, env, self, called, instead) or system.held_back:
            return None
        system.note_direct_write(env)
        if _entity(self).find_component_by_type(physx.PhysxRigidStaticComponent) is not None:
            system.static_moves += 1
        return stock(self, *args, **kwargs)

    call.__doc__, call.__wrapped__ = stock.__doc__, stock  # type: ignore[attr-defined]
    return call


def _system_of(owner: Any) -> tuple[BatchedCpuSystem | None, int]:
    """The laid-out system and the env of a physical body; (None, 0) if it is in no such system."""
    entity = _entity(owner)
    if entity is not None and entity.scene is not None:
        for system in _systems:
            env = next((i for i, scene in enumerate(system.scenes) if scene is entity.scene), None)
            if env is not None and system.laid_out:
                return system, env
    return None, 0


def _may_write(system: BatchedCpuSystem, env: int, owner: Any, called: str, instead: str) -> bool:
    """Report a call of SAPIEN's own setter; False if other envs are being reset, and this env is not."""
    name = owner.name if isinstance(owner, physx.PhysxArticulation) else _entity(owner).name
    may_write = system.resetting is None or bool(system.resetting[env])
    is_left = "" if may_write else "; here the call is ignored, because this env is not being reset"
    system.report(
        "behind-the-tensors",
        f"{called} on '{name}' (env {env}) bypasses the tensors: on the GPU it does nothing{is_left}. Use {instead} "
        "of ManiSkill's object, which sets all envs, or those that are being reset.",
    )
    return may_write


def _entity(owner: Any) -> Any:
    """The entity of a physical body; None for cameras, lights and others."""
    if isinstance(owner, physx.PhysxArticulation):
        return owner.links[0].entity
    if isinstance(owner, physx.PhysxArticulationJoint):
        return owner.child_link.entity
    if isinstance(owner, sapien.Entity):
        return owner if owner.find_component_by_type(physx.PhysxRigidBaseComponent) is not None else None
    return owner.entity if isinstance(owner, physx.PhysxRigidBaseComponent) else None

"""N CPU physics systems behind the interface of one GPU system."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import sapien
import sapien.physx as physx
import torch
from numpy.typing import NDArray

from workbench.envs.broken_rule import NeedsOneEnv, frames_of_the_task, place_of
from workbench.envs.error_notes import RefusedCall, RefusedMember
from workbench.envs.simulation.contact_queries import ContactReader, CpuArray, ImpulseQuery
from workbench.envs.simulation.mirrors import DriveTargets, Group, Mirror, Mirrors
from workbench.envs.simulation.state_layout import StateLayout, check_layout, lay_out, link_poses_at
from workbench.envs.simulation.stepping import Stepper

_TOO_EARLY = (
    "The simulation is not initialised yet: on the GPU and here, there are no tensors of state in "
    "_load_agent and _load_scene. Use the tensors in _after_reconfigure or _initialize_episode."
)
TENSORS: Mapping[str, tuple[Group, ...]] = {
    "cuda_rigid_body_data": ("bodies", "links"),
    "cuda_rigid_dynamic_data": ("bodies", "links"),
    "cuda_articulation_link_data": ("bodies", "links"),
    "cuda_articulation_qpos": ("joints",),
    "cuda_articulation_qvel": ("joints",),
    "cuda_articulation_qf": ("forces",),
    "cuda_articulation_target_qpos": ("targets",),
    "cuda_articulation_target_qvel": ("targets",),
}
MOVING: tuple[Group, ...] = ("bodies", "links", "joints")
"""Groups that a step changes; targets and joint forces stay as they were set."""
_SHARED_MEMBERS = {"config", "get_config", "get_timestep", "scene_collision_id", "get_scene_collision_id"}
"""Members of a system that return the same for each env."""
_WRITING_MEMBERS = {"unpack"}
"""Members of a CPU system that change its state."""


def _applies(mirror: Callable[[Mirrors], Mirror]) -> Callable[..., None]:
    """A ``gpu_apply_*`` method for one mirror. It applies all numbers that differ from the last fetch, and
    ignores the index buffer."""

    def apply(self: BatchedCpuSystem, index_buffer: Any = None) -> None:
        self._apply(mirror(self._mirrors))

    return apply


def _tensor(name: str) -> property:
    def get(self: BatchedCpuSystem) -> CpuArray:
        if not self.laid_out:
            raise RefusedCall(_TOO_EARLY)
        return self.tensor(name)

    return property(get)


class BatchedCpuSystem:
    """N separate ``PhysxCpuSystem``s with CPU tensors, behind the interface of ManiSkill's ``scene.px`` on a GPU.

    ManiSkill's GPU code uses only ``scene.px``: it reads tensors (``cuda_rigid_body_data`` ...) after ``gpu_fetch_*`` and
    writes them before ``gpu_apply_*``. So every task runs here through the code path of the GPU, including partial resets and
    reset masks, and env i equals ManiSkill's single CPU env.

    * A fetch is ``PhysxCpuSystem.pack()`` and ``sapien.Scene.pack_poses()`` of each env (about 3 us) and one gather over all
      envs; a Python getter takes 2 us *per body*.
    * ManiSkill's setters write through (`write_through`), and its getters return the current state (`refresh`), as on a stock CPU
      env: a task that neither applies nor fetches behaves as on a stock CPU env.
    * An apply writes only numbers that differ from the last fetch and were not written through: a partial
      reset wakes no body of another env.
    * Link velocities, joint accelerations and joint forces are fetched only when they are read, which few tasks do.

    Shapes: R bodies (dynamic and kinematic actors, then links, env after env), A articulations,
    D the largest number of degrees of freedom. Poses are world poses in each env's own frame.
    """

    def __init__(self, scenes: Sequence[sapien.Scene], threads: int | None = None) -> None:
        self.scenes = list(scenes)
        self.systems: list[physx.PhysxCpuSystem] = [scene.physx_system for scene in scenes]  # pyright: ignore
        self.stepper = Stepper(self.systems, self.scenes, threads)
        self.contacts = ContactReader(self.systems)
        self._layout: StateLayout | None = None
        self._found: Mirrors | None = None
        self._packed: NDArray[np.float32] | None = None
        self._posed: NDArray[np.float32] | None = None
        self._pose_lengths: list[int] = []
        self._link_pose_at = np.zeros((0, 7), dtype=np.int64)
        self._behind: set[Group] = set()
        """Groups whose tensors are older than the simulation."""
        self.is_writing = False
        """Whether a setter of ManiSkill's is running."""
        self.held_back = False
        """Whether setters write only to the tensors, see `holding_back`."""
        self.resetting: torch.Tensor | None = None
        """(N,) bool during a partial reset: the envs being reset. Only these are stepped."""
        self.static_moves = 0
        """Number of poses that were set on static actors."""
        self._version = 0
        """Increases when the simulation may differ from the last fetch."""
        self._beginning: list[bytes] = []
        """Packed state of each env right after it was built."""
        self.layout_version = 0
        """Increases when rows are assigned to other bodies."""
        self._read_at: dict[str, int] = {}
        """`_version` at the last read of each value that is read on demand."""

    # `Actor.create_from_entities` and `Link.create` give a body a row in the tensors only if
    # isinstance(scene.px, PhysxGpuSystem). A real subclass would need CUDA.
    __class__ = property(lambda self: physx.PhysxGpuSystem)  # type: ignore[assignment]

    # --- members of sapien's systems ---------------------------------------------------------------

    @property
    def timestep(self) -> float:
        return self.systems[0].timestep

    @timestep.setter
    def timestep(self, value: float) -> None:
        for system in self.systems:
            system.timestep = value

    @property
    def rigid_dynamic_components(self) -> list[physx.PhysxRigidDynamicComponent]:
        return [c for system in self.systems for c in system.rigid_dynamic_components]

    @property
    def rigid_static_components(self) -> list[physx.PhysxRigidStaticComponent]:
        return [c for system in self.systems for c in system.rigid_static_components]

    @property
    def articulation_link_components(self) -> list[physx.PhysxArticulationLinkComponent]:
        return [c for system in self.systems for c in system.articulation_link_components]

    def get_scene_offset(self, scene: sapien.Scene) -> NDArray[np.float32]:
        """(3,) always zero: every env has its own origin."""
        return np.zeros(3, dtype=np.float32)

    def get_rigid_dynamic_components(self) -> list[physx.PhysxRigidDynamicComponent]:
        return self.rigid_dynamic_components

    def get_rigid_static_components(self) -> list[physx.PhysxRigidStaticComponent]:
        return self.rigid_static_components

    def get_articulation_link_components(self) -> list[physx.PhysxArticulationLinkComponent]:
        return self.articulation_link_components

    def set_timestep(self, timestep: float) -> None:
        self.timestep = timestep

    def set_scene_collision_id(self, id: int) -> None:
        for system in self.systems:
            system.set_scene_collision_id(id)

    def step(self) -> None:
        """Make one substep in every env; during a partial reset, only in the envs that are being reset."""
        self._apply_targets()
        if self.resetting is None:
            if self.stepper.step():
                self._stepped()
            return
        frozen, others = self.stepper.frozen, np.flatnonzero(~self.resetting.numpy())
        self.freeze_envs(frozen.union(others.tolist()))
        try:
            self.stepper.step()
            self.catch_up()
            self._stepped()
        finally:
            self.freeze_envs(frozen)

    def freeze_envs(self, envs: Collection[int]) -> None:
        """Stop stepping these envs in PhysX, and step all other envs again."""
        self.catch_up()
        self._apply_targets()
        self.stepper.forget()
        self.stepper.frozen = frozenset(envs)

    @contextmanager
    def holding_back(self) -> Iterator[None]:
        """Context in which setters write only to the tensors; the simulation changes when the tensors are applied."""
        self.held_back = True
        try:
            yield
        finally:
            self.held_back = False

    @contextmanager
    def merging(self, substeps: int) -> Iterator[None]:
        """Context in which `substeps` calls of `step` may be merged; a read of state does the pending
        substeps first."""
        with self.stepper.merging(substeps):
            yield
        self.catch_up()

    def catch_up(self) -> None:
        if self.stepper.owes:
            self.stepper.catch_up()
            self._stepped()

    def step_start(self) -> None:
        """Make one substep and wait for it."""
        self.step()

    def step_finish(self) -> None:
        """Do nothing: `step_start` has stepped."""

    def sync_poses_gpu_to_cpu(self) -> None:
        """Do nothing: SAPIEN's entities are the simulation here."""

    # --- building ----------------------------------------------------------------------------------

    def gpu_init(self) -> None:
        """Make the tensors for the scene's bodies; called once, when the scene is complete."""
        layout = self._layout = lay_out(self.systems)
        self.layout_version += 1
        self._packed = self._posed = None
        self._pose_lengths = []
        found = self._found = Mirrors(
            layout, self._pack, self._link_poses, self._setter, self.stepper.write_before_step
        )
        self._qacc = np.zeros_like(found.qpos.now)
        most_links = max((len(a.links) for a in layout.articulations), default=0)
        self._joint_forces = np.zeros((len(layout.articulations), most_links, 6), dtype=np.float32)
        self._force, self._torque = np.zeros((2, len(layout.entities), 3), dtype=np.float32)
        data = _array(found.bodies.now)
        self._tensors = {
            "cuda_rigid_body_data": data,
            "cuda_rigid_dynamic_data": data,
            "cuda_articulation_link_data": data,
            "cuda_articulation_qpos": _array(found.qpos.now),
            "cuda_articulation_qvel": _array(found.qvel.now),
            "cuda_articulation_qf": _array(found.qf.now),
            "cuda_articulation_target_qpos": _array(found.targets.now),
            "cuda_articulation_target_qvel": _array(found.velocity_targets.now),
        }
        self.cuda_rigid_body_force = _array(self._force)
        self.cuda_rigid_body_torque = _array(self._torque)
        self.cuda_rigid_dynamic_force = self.cuda_rigid_body_force
        self.cuda_rigid_dynamic_torque = self.cuda_rigid_body_torque
        check_layout(layout, self._pack(), self._link_poses)
        for mirror in found.all:
            mirror.fetch()
        for row, articulation in enumerate(layout.articulations):  # packs do not hold qf
            found.qf.now[row, : articulation.dof] = found.qf.seen[row, : articulation.dof] = articulation.qf
        self._behind.clear()

    cuda_rigid_body_data = _tensor("cuda_rigid_body_data")
    cuda_rigid_dynamic_data = _tensor("cuda_rigid_dynamic_data")
    cuda_articulation_link_data = _tensor("cuda_articulation_link_data")
    cuda_articulation_qpos = _tensor("cuda_articulation_qpos")
    cuda_articulation_qvel = _tensor("cuda_articulation_qvel")
    cuda_articulation_qf = _tensor("cuda_articulation_qf")
    cuda_articulation_target_qpos = _tensor("cuda_articulation_target_qpos")
    cuda_articulation_target_qvel = _tensor("cuda_articulation_target_qvel")

    def row_of(self, body: physx.PhysxRigidBodyComponent) -> int:
        """Row of a dynamic or kinematic body, or of a link, in the (R, 13) tensor; -1 if it was removed."""
        if id(body) not in self._laid_out.row_of and body.entity.scene is not None:
            self._lay_out_again()
        return self._laid_out.row_of.get(id(body), -1)

    def index_of(self, articulation: physx.PhysxArticulation) -> int:
        """Row of an articulation in the (A, D) tensors; -1 if it was removed."""
        if id(articulation) not in self._laid_out.index_of and articulation.links[0].entity.scene is not None:
            self._lay_out_again()
        return self._laid_out.index_of.get(id(articulation), -1)

    def _lay_out_again(self) -> None:
        """Lay out the scene again, after bodies were added or removed."""
        self.refused_by_gpu(
            "Bodies are built or removed after the scene was built: on the GPU this fails. Build them in "
            "_load_scene; with reconfiguration_freq=1 it runs before each episode."
        )
        self._apply_targets()
        self._moved(MOVING)
        self.gpu_init()
        self.keep_beginning()

    def keep_beginning(self) -> None:
        """Store the present state as the one that `heal` restores."""
        self._beginning = [*self.packs()]

    def heal(self, envs: Sequence[int]) -> None:
        """Restore bodies and articulations with NaN or infinity in these envs to their state after the build.

        PhysX never gets rid of a NaN, and a reset corrects only the state that the task sets.
        """
        numbers = self._pack()
        if np.isfinite(numbers).all():
            return
        starts = np.cumsum([0, *map(len, self._beginning)]) // numbers.itemsize
        for env in envs:
            now = numbers[starts[env] : starts[env + 1]].copy()
            built = np.frombuffer(self._beginning[env], np.float32)
            if np.isfinite(now).all() or not np.isfinite(built).all():
                continue
            for part in self._laid_out.parts[env]:
                if not np.isfinite(now[part]).all():
                    now[part] = built[part]
            self.systems[env].unpack(now.tobytes())
        held: tuple[Group, ...] = (*MOVING, "targets")
        self._moved(held)
        for group in held:
            self.refresh(group)

    def note_structure(self) -> None:
        """Note that entities were removed from a scene."""
        self._moved(MOVING)
        self._pose_lengths = []

    @property
    def laid_out(self) -> bool:
        """Whether the scene is complete. Before that, bodies have no rows."""
        return self._layout is not None

    @property
    def _laid_out(self) -> StateLayout:
        self.catch_up()
        if self._layout is None:
            raise RefusedCall(_TOO_EARLY)
        return self._layout

    @property
    def _mirrors(self) -> Mirrors:
        if self._found is None:
            raise RefusedCall(_TOO_EARLY)
        return self._found

    def __getattr__(self, name: str) -> Any:
        # The tensors exist from `gpu_init` on: explain an earlier access.
        if name.startswith("cuda_") and self.__dict__.get("_layout") is None:
            raise RefusedCall(_TOO_EARLY)
        if name in _SHARED_MEMBERS:
            return getattr(self.systems[0], name)
        if hasattr(physx.PhysxCpuSystem, name) and not name.startswith("_"):
            return self._of_one_env(name)
        if hasattr(physx.PhysxGpuSystem, name):
            raise RefusedMember(
                f"scene.px.{name} is a member of SAPIEN's GPU system that the batched CPU simulation does "
                "not have: here every env has its own physics, at its own origin."
            )
        raise AttributeError(f"the batched CPU system has no '{name}'")

    def _of_one_env(self, name: str) -> Any:
        """A member of the CPU system of the only env.

        Raises:
            NeedsOneEnv: there are several envs.
        """
        place = place_of(frames_of_the_task())
        if len(self.systems) > 1:
            raise NeedsOneEnv(
                f"scene.px.{name} exists in the CPU simulation of a single env only, and there are "
                f"{len(self.systems)} envs",
                _INSTEAD.get(name, ""),
                place,
            )
        self.report(
            "one-env-only", f"scene.px.{name} does not exist in GPU simulation.{_INSTEAD.get(name, '')}"
        )
        self.packs()  # does pending substeps, and writes pending targets
        member = getattr(self.systems[0], name)
        if name not in _WRITING_MEMBERS:
            return member

        def call(*args: Any, **kwargs: Any) -> Any:
            result = member(*args, **kwargs)
            self.note_change()
            return result

        return call

    # --- for the rules: see `StrictCpuSystem` -----------------------------------------------------------

    def report(self, rule: str, message: str) -> None:
        """Report that the task breaks a rule."""

    def refused_by_gpu(self, message: str) -> None:
        """Report that the task makes a call that GPU simulation refuses."""
        self.report("refused-by-gpu", message)

    def about_to_write(self, struct: Any, group: Group, rows: NDArray[np.int64]) -> None:
        """Note that a setter of `struct` will write `rows` of `group`'s tensor."""

    def about_to_read(self, struct: Any, group: Group, rows: NDArray[np.int64]) -> None:
        """Note that a getter of `struct` will read `rows` of `group`'s tensor."""

    def _setter(self, joint: Any, method: str) -> Callable[[float], None]:
        """The method that sets one kind of drive target of a joint."""
        return getattr(joint, method)

    # --- reading: gpu_fetch_* ----------------------------------------------------------------------

    def _follow_structure(self) -> None:
        self.catch_up()
        if len(self._pack()) != self._laid_out.size + 1:
            self._lay_out_again()

    def _fetch(self, group: Group) -> None:
        """Read `group` from the simulation; overwrites writes that were not applied."""
        self._follow_structure()
        if group == "targets":
            self._apply_targets()
        for mirror in self._mirrors.of[group]:
            mirror.fetch()
        self._behind.discard(group)

    def refresh(self, group: Group) -> None:
        """Read `group` from the simulation if its tensors are out of date; keeps writes that were not applied."""
        self.catch_up()
        if group in self._behind:
            self._follow_structure()
            self._behind.discard(group)
            for mirror in self._mirrors.of[group]:
                mirror.refresh()

    def tensor(self, name: str) -> CpuArray:
        """One of `TENSORS`, up to date with the simulation. While a setter of ManiSkill's runs, it is not
        updated."""
        for group in () if self.is_writing else TENSORS[name]:
            self.refresh(group)
        return self._tensors[name]

    def gpu_fetch_rigid_dynamic_data(self) -> None:
        self._fetch("bodies")

    def gpu_fetch_articulation_link_pose(self) -> None:
        self._fetch("links")

    def gpu_fetch_articulation_link_velocity(self) -> None:
        """Do nothing: `gpu_fetch_articulation_link_pose` fetches velocities of roots, `fetch_link_velocities`
        those of all other links."""

    def gpu_fetch_articulation_qpos(self) -> None:
        self._fetch("joints")

    def gpu_fetch_articulation_qvel(self) -> None:
        """Do nothing: fetched by `gpu_fetch_articulation_qpos`."""

    def gpu_fetch_articulation_qacc(self) -> None:
        """Do nothing: fetched when `cuda_articulation_qacc` is read."""

    def gpu_fetch_articulation_target_qpos(self) -> None:
        self._fetch("targets")

    def gpu_fetch_articulation_target_qvel(self) -> None:
        """Do nothing: fetched by `gpu_fetch_articulation_target_qpos`."""

    def gpu_fetch_articulation_link_incoming_joint_forces(self) -> None:
        """Do nothing: fetched when `cuda_articulation_link_incoming_joint_forces` is read."""

    def gpu_update_articulation_kinematics(self) -> None:
        """Do nothing: on the CPU, links follow when qpos or the root pose is set."""

    def _unread(self, what: str, things: Iterable[Any]) -> Iterable[Any]:
        """`things`; empty if `what` was read since the last change."""
        if self._read_at.get(what) == self._version:
            return ()
        self._read_at[what] = self._version
        return things

    @property
    def cuda_articulation_qacc(self) -> CpuArray:
        for i, articulation in self._unread("qacc", enumerate(self._laid_out.articulations)):
            self._qacc[i, : articulation.dof] = articulation.qacc
        return _array(self._qacc)

    @property
    def cuda_articulation_link_incoming_joint_forces(self) -> CpuArray:
        for i, articulation in self._unread("forces", enumerate(self._laid_out.articulations)):
            forces = articulation.get_link_incoming_joint_forces()
            self._joint_forces[i, : len(forces)] = forces
        return _array(self._joint_forces)

    def fetch_link_velocities(self) -> None:
        """Read velocities of all links into columns 7 to 12; on demand, since it takes two getters per link."""
        layout = self._laid_out
        # Velocities of roots were fetched with the poses, and may have been written since.
        now, seen = self._mirrors.links.now, self._mirrors.links.seen
        for row, link in self._unread("links", zip(layout.link_rows, layout.links, strict=True)):
            if not link.is_root:
                now[row, 7:10] = seen[row, 7:10] = link.linear_velocity
                now[row, 10:13] = seen[row, 10:13] = link.angular_velocity

    def _pack(self) -> NDArray[np.float32]:
        self.catch_up()
        if self._packed is None:
            joined = b"".join(self.stepper.packs())
            self._packed = np.empty(len(joined) // 4 + 1, dtype=np.float32)
            self._packed[:-1] = np.frombuffer(joined, dtype=np.float32)
            self._packed[-1] = 0.0
        return self._packed

    def _link_poses(self) -> NDArray[np.float32]:
        """(L, 7) poses of all links: position, quaternion wxyz."""
        layout = self._laid_out
        if self._posed is None:
            packs = self.stepper.pose_packs()
            lengths = [len(pack) // 4 for pack in packs]
            if lengths != self._pose_lengths:
                # Entities change after the layout: cameras are added, and a task may remove visual entities.
                self._link_pose_at = link_poses_at(layout, self.scenes)
                self._pose_lengths = lengths
            self._posed = np.frombuffer(b"".join(packs), dtype=np.float32)
        return self._posed[self._link_pose_at]

    def note_change(self) -> None:
        """Note that a call on one of `systems` or of their objects changed the state."""
        self._moved(MOVING)

    def note_direct_write(self, env: int) -> None:
        """Note that the task writes to one of SAPIEN's objects in this env."""
        self._moved(MOVING, {env})

    def _stepped(self) -> None:
        self.contacts.stepped(self.stepper.frozen)
        self._forget_packs(MOVING)

    def _moved(self, behind: Iterable[Group], envs: Iterable[int] | None = None) -> None:
        """After a write to the simulation of these envs (None: all), drop packed state and mark groups as out of date."""
        self.catch_up()
        self.stepper.forget(envs)
        self._forget_packs(behind)

    def _forget_packs(self, behind: Iterable[Group]) -> None:
        self._packed = self._posed = None
        self._version += 1
        self._behind.update(behind)
        self.contacts.invalidate()

    def replace(self, env: int, scene: sapien.Scene) -> None:
        """Replace the scene and system of this env; `scene` has the env's entities in the same order."""
        self.scenes[env] = scene
        self.systems[env] = scene.physx_system  # pyright: ignore
        self.stepper.renew(env)

    def articulation(self, index: int) -> Any:
        """The PhysxArticulation in this row of the (A, D) tensors."""
        return self._laid_out.articulations[index]

    def packs(self) -> list[bytes]:
        """``PhysxCpuSystem.pack()`` of every env's present state; does pending substeps and writes first."""
        if self._layout is not None:
            self._follow_structure()
        self.catch_up()
        self._apply_targets()
        return self.stepper.packs()

    # --- writing: ManiSkill's setters, and gpu_apply_* ------------------------------------------------

    def write_through(
        self,
        mirror: Mirror,
        at: tuple[NDArray[np.int64], Any],
        values: NDArray[np.float32],
        write: Callable[[NDArray[np.bool_]], None],
    ) -> None:
        """Write `values`, which a setter has written at index `at` of a mirror's tensor, to the simulation too.

        Args:
            write: writes through SAPIEN's objects; called with a mask of the rows to write.

        Raises:
            ValueError: raised by `Mirror.may_write`; the tensor is unchanged.
        """
        if self.held_back:
            return
        whole = np.ones(len(values), dtype=bool)
        if not np.isfinite(values).all():
            mirror.now[at] = mirror.seen[at]
            each = zip(at[0].tolist(), values, strict=True)
            whole = np.array([mirror.may_write(value, row) for row, value in each], dtype=bool)
        own = self._mirrors
        # The poses of the links change too, and PhysX rounds the root pose.
        follow: tuple[Group, ...] = ("links",) if mirror in (own.qpos, own.links) else ()
        self._moved(follow, {*mirror.envs[at[0]].tolist()})
        write(whole)
        at = (at[0][whole], at[1][whole] if isinstance(at[1], np.ndarray) else at[1])
        mirror.now[at] = mirror.seen[at] = values[whole]

    def note_targets(self, mirror: DriveTargets, rows: NDArray[np.int64]) -> None:
        """Note that a setter wrote drive targets of these articulations; they are applied before the next step."""
        mirror.note(rows)

    def mirror(self, name: str) -> Any:
        """The mirror of this name; see `Mirrors`."""
        return getattr(self._mirrors, name)

    def _apply_targets(self) -> None:
        """Apply the drive targets that setters wrote."""
        if self._found is not None and not self.held_back:
            for targets in (self._found.targets, self._found.velocity_targets):
                if targets.pending:
                    self._put(targets)

    def _apply(self, mirror: Mirror) -> None:
        """Write the numbers that differ from the last fetch to the simulation."""
        self._put(mirror)

    def _put(self, mirror: Mirror) -> None:
        if mirror.differs().any():
            own = self._mirrors
            follow: tuple[Group, ...] = ("links",) if mirror in (own.qpos, own.roots) else ()
            self._moved(follow, {*mirror.envs[mirror.rows[mirror.changed()]].tolist()})
            mirror.apply()
        elif isinstance(mirror, DriveTargets) and mirror.pending:
            mirror.apply()

    def apply_changes(self) -> None:
        """Apply the tensors that ``ManiSkillScene._gpu_apply_all`` applies, only where they differ from the
        last fetch."""
        own = self._mirrors
        for mirror in (
            own.bodies,
            own.qpos,
            own.qvel,
            own.qf,
            own.roots,
            own.root_velocities,
            *own.of["targets"],
        ):
            self._apply(mirror)

    gpu_apply_rigid_dynamic_data = _applies(lambda own: own.bodies)
    gpu_apply_articulation_root_pose = _applies(lambda own: own.roots)
    gpu_apply_articulation_root_velocity = _applies(lambda own: own.root_velocities)
    gpu_apply_articulation_qpos = _applies(lambda own: own.qpos)
    gpu_apply_articulation_qvel = _applies(lambda own: own.qvel)
    gpu_apply_articulation_qf = _applies(lambda own: own.qf)
    gpu_apply_articulation_target_position = _applies(lambda own: own.targets)
    gpu_apply_articulation_target_velocity = _applies(lambda own: own.velocity_targets)

    def gpu_apply_rigid_dynamic_force(self) -> None:
        self._apply_forces(self._force, "force")

    def gpu_apply_rigid_dynamic_torque(self) -> None:
        self._apply_forces(self._torque, "torque")

    def drop_writes(self) -> None:
        """Discard writes to the tensors that were not applied."""
        for mirror in () if self._found is None else self._found.all:
            mirror.drop()

    def _apply_forces(self, values: NDArray[np.float32], kind: str) -> None:
        layout, zero = self._laid_out, np.zeros(3, dtype=np.float32)
        rows = np.concatenate([layout.body_rows, layout.link_rows]).tolist()
        for row, body in zip(rows, [*layout.bodies, *layout.links], strict=True):
            if values[row].any():
                if not self._mirrors.bodies.may_write(values[row], row):
                    continue
                if kind == "force":
                    body.add_force_torque(values[row], zero)
                else:
                    body.add_force_torque(zero, values[row])
        # PhysX applies a force for one substep; a row that keeps its value would push again at the next apply.
        values[:] = 0.0

    # --- contacts ----------------------------------------------------------------------------------

    def gpu_create_contact_body_impulse_query(self, bodies: Sequence[Any]) -> ImpulseQuery:
        return self.contacts.create_body_query(bodies)

    def gpu_create_contact_pair_impulse_query(self, body_pairs: Sequence[Any]) -> ImpulseQuery:
        return self.contacts.create_pair_query(body_pairs)

    def gpu_query_contact_body_impulses(self, query: ImpulseQuery) -> None:
        self.catch_up()
        self.contacts.answer(query)

    gpu_query_contact_pair_impulses = gpu_query_contact_body_impulses


_INSTEAD = {
    "get_contacts": " Use scene.get_pairwise_contact_impulses(a, b) or actor.get_net_contact_impulses(), which give a row for "
    "each env."
}


def _array(values: NDArray[np.float32]) -> CpuArray:
    return CpuArray(torch.from_numpy(values))


def batched_system(scene: Any) -> BatchedCpuSystem | None:
    """The batched CPU system of a ManiSkillScene, or None for any other scene.

    isinstance does not work: a `BatchedCpuSystem` passes as a ``PhysxGpuSystem``.
    """
    return scene.px if issubclass(type(scene.px), BatchedCpuSystem) else None

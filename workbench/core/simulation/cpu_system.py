"""N CPU physics systems behind the interface of one GPU system."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import sapien
import sapien.physx as physx
import torch
from numpy.typing import NDArray

from workbench.core.error_notes import RefusedCall, RefusedMember
from workbench.core.simulation.contact_queries import ContactReader, CpuArray, ImpulseQuery
from workbench.core.simulation.drawn_poses import Places, bodies_elsewhere
from workbench.core.simulation.mirrors import Group, Mirror, Mirrors, refuse_nan
from workbench.core.simulation.state_layout import StateLayout, check_layout, lay_out
from workbench.core.simulation.stepping import Stepper

_TOO_EARLY = (
    "The simulation is not initialised yet: in _load_agent and _load_scene only initial poses "
    "may be set. Read and write state (poses, qpos, velocities) in _initialize_episode."
)


def _uncommon_member(name: str) -> Any:
    """Refuse a member that `BatchedCpuSystem` does not define.

    Raises:
        NotImplementedError: SAPIEN's GPU system has it.
        AttributeError: SAPIEN's does not have it either.
    """
    if hasattr(physx.PhysxGpuSystem, name):
        raise RefusedMember(
            f"{name} is a member of SAPIEN's GPU system that the batched CPU simulation does not have: here every env has "
            "its own physics, at its own origin. For what all of them share, use self.scene.px.systems[0]."
        )
    raise AttributeError(f"the batched CPU system has no '{name}'")


def _applies(mirror: Callable[[Mirrors], Mirror], keep_awake: bool = False) -> Callable[..., None]:
    """A ``gpu_apply_*`` of one mirror. Refuses SAPIEN's index buffer: only what differs from the last fetch is applied."""

    def apply(self: BatchedCpuSystem, index_buffer: Any = None) -> None:
        if index_buffer is not None:
            raise RefusedMember(
                "gpu_apply_... takes no index buffer in the batched CPU simulation: call it without, it applies the "
                "rows that were changed."
            )
        self._apply(mirror(self._mirrors), keep_awake)

    return apply


class BatchedCpuSystem:
    """What ManiSkill calls ``scene.px``, over N separate ``PhysxCpuSystem``s with CPU tensors.

    ManiSkill's GPU code talks to ``scene.px`` alone: it reads tensors (``cuda_rigid_body_data`` ...) after ``gpu_fetch_*`` and
    writes them before ``gpu_apply_*``. So every task runs here through the code path of the GPU, partial resets and reset masks
    included, and env i is what ManiSkill's single CPU env would be.

    * A fetch is ``PhysxCpuSystem.pack()`` and ``sapien.Scene.pack_poses()`` of each env (about 3 us) and one gather over all
      envs; a Python getter costs 2 us *a body*.
    * An apply writes only what differs from the last fetch: a partial reset wakes no body of another env.
    * Link velocities, joint accelerations and joint forces are fetched when they are read: few tasks do.

    Shapes: R bodies (dynamic and kinematic actors, then links, env after env), A articulations,
    D the largest number of degrees of freedom. Poses are world poses of each env's own frame.
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
        self._version = 0
        """Grows when the simulation may differ from what was fetched."""
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

    def get_contacts(self) -> list[physx.PhysxContact]:
        raise RefusedMember(
            "scene.get_contacts() does not exist in batched simulation (nor on the GPU). Use "
            "scene.get_pairwise_contact_impulses(a, b) or actor.get_net_contact_impulses()."
        )

    def step(self) -> None:
        """One substep of every env."""
        if self.stepper.step():
            self._stepped()

    def freeze_envs(self, envs: Collection[int]) -> None:
        """Stop stepping these envs in PhysX; an empty collection steps all again."""
        self._catch_up()
        self.stepper.forget()
        self.stepper.frozen = frozenset(envs)

    def keep_drives(self, envs: Sequence[int], flags: Sequence[NDArray[np.bool_]]) -> None:
        """Discard drive targets that were written for these envs while they were frozen.

        Args:
            flags: `drive_flags` from before.
        """
        rows = np.isin(self._mirrors.targets.envs, envs)
        for now, was in zip(self.drive_flags, flags, strict=True):
            now[rows] = was[rows]
        for targets in (self._mirrors.targets, self._mirrors.velocity_targets):
            targets.drop()
        self._fetch("targets")

    @contextmanager
    def merging(self, substeps: int) -> Iterator[None]:
        """Within this, `substeps` calls of `step` may be done together; a read of state does them at once."""
        with self.stepper.merging(substeps):
            yield
        self._catch_up()

    def _catch_up(self) -> None:
        if self.stepper.owes:
            self.stepper.catch_up()
            self._stepped()

    def step_start(self) -> None:
        """One substep; `step_finish` has nothing to wait for."""
        self.step()

    def step_finish(self) -> None:
        """Nothing to do: `step_start` stepped."""

    def sync_poses_gpu_to_cpu(self) -> None:
        """Nothing to do: SAPIEN's entities are the simulation here."""

    # --- building ----------------------------------------------------------------------------------

    def gpu_init(self) -> None:
        """Make the tensors over the scene's bodies; called once, when the scene is complete."""
        layout = self._layout = lay_out(self.systems, self.scenes)
        found = self._found = Mirrors(
            layout, self._pack, self._link_poses, self._setter, self.stepper.write_before_step
        )
        self._qacc = np.zeros_like(found.qpos.now)
        most_links = max((len(a.links) for a in layout.articulations), default=0)
        self._joint_forces = np.zeros((len(layout.articulations), most_links, 6), dtype=np.float32)
        self._force, self._torque = np.zeros((2, len(layout.entities), 3), dtype=np.float32)
        self.cuda_rigid_body_data = _array(found.bodies.now)
        self.cuda_rigid_dynamic_data = self.cuda_rigid_body_data
        self.cuda_articulation_link_data = self.cuda_rigid_body_data
        self.cuda_articulation_qpos = _array(found.qpos.now)
        self.cuda_articulation_qvel = _array(found.qvel.now)
        self.cuda_articulation_qf = _array(found.qf.now)
        self.cuda_articulation_target_qpos = _array(found.targets.now)
        self.cuda_articulation_target_qvel = _array(found.velocity_targets.now)
        self.cuda_rigid_body_force = _array(self._force)
        self.cuda_rigid_body_torque = _array(self._torque)
        self.cuda_rigid_dynamic_force = self.cuda_rigid_body_force
        self.cuda_rigid_dynamic_torque = self.cuda_rigid_body_torque
        check_layout(layout, self._pack(), self._link_poses)
        for mirror in found.all:
            mirror.fetch()

    def row_of(self, body: physx.PhysxRigidBodyComponent) -> int:
        """Row of a dynamic or kinematic body, or of a link, in the (R, 13) tensor."""
        return self._laid_out.row_of[id(body)]

    def index_of(self, articulation: physx.PhysxArticulation) -> int:
        """Row of an articulation in the (A, D) tensors."""
        return self._laid_out.index_of[id(articulation)]

    @property
    def laid_out(self) -> bool:
        """Whether the scene is complete; before that nothing has a row."""
        return self._layout is not None

    @property
    def _laid_out(self) -> StateLayout:
        self._catch_up()
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
        return _uncommon_member(name)

    def _setter(self, joint: Any, method: str) -> Callable[[float], None]:
        """The method that sets one kind of drive target of a joint."""
        return getattr(joint, method)

    # --- reading: gpu_fetch_* ----------------------------------------------------------------------

    def _fetch(self, group: Group) -> None:
        """Read `group` from the simulation, overwriting what was not applied."""
        for mirror in self._mirrors.of[group]:
            mirror.fetch()

    def gpu_fetch_rigid_dynamic_data(self) -> None:
        self._fetch("bodies")

    def gpu_fetch_articulation_link_pose(self) -> None:
        self._fetch("links")

    def gpu_fetch_articulation_link_velocity(self) -> None:
        """The root's comes with `gpu_fetch_articulation_link_pose`; see `fetch_link_velocities`."""

    def gpu_fetch_articulation_qpos(self) -> None:
        self._fetch("joints")

    def gpu_fetch_articulation_qvel(self) -> None:
        """Comes with `gpu_fetch_articulation_qpos`."""

    def gpu_fetch_articulation_qacc(self) -> None:
        """Fetched when `cuda_articulation_qacc` is read."""

    def gpu_fetch_articulation_target_qpos(self) -> None:
        self._fetch("targets")

    def gpu_fetch_articulation_target_qvel(self) -> None:
        """Comes with `gpu_fetch_articulation_target_qpos`."""

    def gpu_fetch_articulation_link_incoming_joint_forces(self) -> None:
        """Fetched when `cuda_articulation_link_incoming_joint_forces` is read."""

    def gpu_update_articulation_kinematics(self) -> None:
        """Nothing to do: on the CPU, links follow when qpos or the root pose is set."""

    def _unread(self, what: str, things: Iterable[Any]) -> Iterable[Any]:
        """`things`, or none if `what` was read since the last change."""
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
        """Read velocities of all links into columns 7 to 12; on demand, since it takes two getters a link."""
        layout = self._laid_out
        # Roots' velocities came with the poses, and may have been written since.
        now, seen = self._mirrors.links.now, self._mirrors.links.seen
        for row, link in self._unread("links", zip(layout.link_rows, layout.links, strict=True)):
            if not link.is_root:
                now[row, 7:10] = seen[row, 7:10] = link.linear_velocity
                now[row, 10:13] = seen[row, 10:13] = link.angular_velocity

    def _pack(self) -> NDArray[np.float32]:
        self._catch_up()
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
                # Cameras are added after the scene is laid out: each makes its env's pack longer.
                starts = np.cumsum([0, *lengths[:-1]])
                rows = layout.link_rows
                self._link_pose_at = layout.pose_at[rows] + starts[layout.env_of_row[rows]][:, None]
                self._pose_lengths = lengths
            self._posed = np.frombuffer(b"".join(packs), dtype=np.float32)
        return self._posed[self._link_pose_at]

    def note_change(self) -> None:
        """Drop packed state after a write to the simulation, here or by a call on one of `systems`."""
        self._catch_up()
        self.stepper.forget()
        self._moved()

    def _stepped(self) -> None:
        self.contacts.stepped(self.stepper.frozen)
        self._moved()

    def _moved(self) -> None:
        self._packed = self._posed = None
        self._version += 1
        self.contacts.invalidate()

    def elsewhere(self, envs: Sequence[int]) -> dict[int, Places]:
        """By env, bodies that the tensor has elsewhere than SAPIEN, and where; see `bodies_elsewhere`."""
        self._catch_up()
        if self._layout is None:
            return {}
        return bodies_elsewhere(self.scenes, self._layout, self._mirrors.bodies.now, envs)

    def replace(self, env: int, scene: sapien.Scene) -> None:
        """Use another scene and system for this env, with its entities in the same order."""
        self.scenes[env] = scene
        self.systems[env] = scene.physx_system  # pyright: ignore
        self.stepper.renew(env)

    def articulation(self, index: int) -> Any:
        """The PhysxArticulation in this row of the (A, D) tensors."""
        return self._laid_out.articulations[index]

    def packs(self) -> list[bytes]:
        """``PhysxCpuSystem.pack()`` of every env, now."""
        self._catch_up()
        return self.stepper.packs()

    @property
    def drive_flags(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(A,), (A,) whether position and velocity targets were ever set; see `DriveTargets`."""
        return self._mirrors.targets.driven, self._mirrors.velocity_targets.driven

    # --- writing: gpu_apply_* ----------------------------------------------------------------------

    def _apply(self, mirror: Mirror, keep_awake: bool = False) -> None:
        """Write to the simulation what differs from the last fetch."""
        changed = mirror.differs().any()
        if changed:
            self.note_change()
        if changed or keep_awake:
            mirror.apply(keep_awake)

    def apply_changes(self) -> None:
        """Apply what ``ManiSkillScene._gpu_apply_all`` applies, but only what differs."""
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
    gpu_apply_articulation_target_position = _applies(lambda own: own.targets, keep_awake=True)
    gpu_apply_articulation_target_velocity = _applies(lambda own: own.velocity_targets, keep_awake=True)

    def gpu_apply_rigid_dynamic_force(self) -> None:
        self._apply_forces(self._force, "force")

    def gpu_apply_rigid_dynamic_torque(self) -> None:
        self._apply_forces(self._torque, "torque")

    def drop_writes(self) -> None:
        """Discard what was written to the tensors and not applied."""
        for mirror in () if self._found is None else self._found.all:
            mirror.drop()

    def _apply_forces(self, values: NDArray[np.float32], kind: str) -> None:
        layout, zero = self._laid_out, np.zeros(3, dtype=np.float32)
        rows = np.concatenate([layout.body_rows, layout.link_rows]).tolist()
        for row, body in zip(rows, [*layout.bodies, *layout.links], strict=True):
            if values[row].any():
                refuse_nan(values[row], layout.names[row], int(layout.env_of_row[row]))
                if kind == "force":
                    body.add_force_torque(values[row], zero)
                else:
                    body.add_force_torque(zero, values[row])
        # PhysX takes a force for one substep; a row that stays would push again at the next apply.
        values[:] = 0.0

    # --- contacts ----------------------------------------------------------------------------------

    def gpu_create_contact_body_impulse_query(self, bodies: Sequence[Any]) -> ImpulseQuery:
        return self.contacts.create_body_query(bodies)

    def gpu_create_contact_pair_impulse_query(self, body_pairs: Sequence[Any]) -> ImpulseQuery:
        return self.contacts.create_pair_query(body_pairs)

    def gpu_query_contact_body_impulses(self, query: ImpulseQuery) -> None:
        self._catch_up()
        self.contacts.answer(query)

    gpu_query_contact_pair_impulses = gpu_query_contact_body_impulses


def _array(values: NDArray[np.float32]) -> CpuArray:
    return CpuArray(torch.from_numpy(values))


def batched_system(scene: Any) -> BatchedCpuSystem | None:
    """The batched CPU system of a ManiSkillScene, or None for any other scene.

    Not by isinstance, for which `BatchedCpuSystem` is a ``PhysxGpuSystem``.
    """
    return scene.px if issubclass(type(scene.px), BatchedCpuSystem) else None

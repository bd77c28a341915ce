"""A batched CPU system that reports what would be lost or overwritten on the GPU."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import sapien
import torch
from numpy.typing import NDArray

from workbench.core.broken_rule import BrokenRules, Frame, Place, frames_of_the_task
from workbench.core.simulation.contact_queries import CpuArray
from workbench.core.simulation.cpu_system import BatchedCpuSystem
from workbench.core.simulation.mirrors import Floats, Group, Mirror

TENSORS: dict[str, tuple[Group, ...]] = {
    "cuda_rigid_body_data": ("bodies", "links"),
    "cuda_rigid_dynamic_data": ("bodies", "links"),
    "cuda_articulation_link_data": ("bodies", "links"),
    "cuda_articulation_qpos": ("joints",),
    "cuda_articulation_qvel": ("joints",),
    "cuda_articulation_qf": ("forces",),
    "cuda_articulation_target_qpos": ("targets",),
    "cuda_articulation_target_qvel": ("targets",),
}
_OWN_CODE = ("workbench.core.", "mani_skill.")


@dataclass(frozen=True)
class _Write:
    """A write to rows of a group that may still be applied."""

    group: Group
    rows: NDArray[np.int64] | None
    """Rows of the group's tensor; None if the whole tensor was handed out."""
    frames: tuple[Frame, ...]
    """Innermost first."""


class Writes:
    """Writes that were neither applied nor fetched over, each with the frames that led to it.

    A lost write shows at the next fetch, and is reported at the line that wrote. A task may also take a whole tensor and
    write to it unseen: then the line that took it is reported.
    """

    def __init__(self) -> None:
        self._kept: list[_Write] = []

    def __bool__(self) -> bool:
        return bool(self._kept)

    def note(self, group: Group, rows: NDArray[np.int64]) -> None:
        """Note that the present call writes these rows."""
        self._kept.append(_Write(group, rows, frames_of_the_task()))

    def note_handed_out(self, tensor: str) -> None:
        """Note the code that reads a whole tensor through the calling property, unless it is the core's own."""
        reader = sys._getframe(2)
        if not reader.f_globals.get("__name__", "").startswith(_OWN_CODE):
            frames = frames_of_the_task(reader)
            self._kept.extend(_Write(group, None, frames) for group in TENSORS[tensor])

    def forget(self, group: Group) -> None:
        """Drop the writes of a group that was applied or fetched."""
        if self._kept:
            self._kept = [write for write in self._kept if write.group != group]

    def frames(self, group: Group, rows: NDArray[np.int64]) -> tuple[Frame, ...]:
        """Frames of the last write to one of these rows, or read of the whole tensor; empty if unknown."""
        for write in reversed(self._kept):
            if write.group == group and write.rows is not None and np.isin(rows, write.rows).any():
                return write.frames
        for write in reversed(self._kept):
            if write.group == group and write.rows is None:
                return write.frames
        return ()


ENVS_NAMED = THINGS_NAMED = 8
_MOVING: tuple[Group, ...] = ("bodies", "links", "joints")
"""What a step moves; targets and joint forces stay as they were set."""


class StrictCpuSystem(BatchedCpuSystem):
    """A `BatchedCpuSystem` that reports breaches of the rules of GPU simulation.

    On the GPU ``gpu_fetch_*`` overwrites the tensors and ``gpu_apply_*`` the simulation, for all envs and without a message. So a
    pose that was set and not applied is lost at the next fetch, an apply after a step without a fetch puts every body of
    every env back, and a read between the two gives the past. `BatchedCpuSystem` does the first and the last as the GPU
    does; this class reports all three, and changes no bit where a rule only warns. It compares values, not calls: a pose set
    to what it was is no fault.
    """

    rules: BrokenRules
    """Receives breaches; belongs to the env, so that it outlives a scene."""
    being_reset: torch.Tensor | None = None
    """(N,) bool while ``_initialize_episode`` runs for some envs and not for others."""
    stepped_in_reset = False
    hook_of_reset: Place | None = None
    """Where the task defines ``_initialize_episode``."""

    def __init__(self, scenes: Sequence[sapien.Scene], *args: Any, **kwargs: Any) -> None:
        self._writes = Writes()
        self._stale: set[Group] = set()
        self.reported_elsewhere: set[str] = set()
        """Names already reported for other envs in the present partial reset."""
        self._applying = 0
        self._outdated: set[int] = set()
        """Articulations whose links in the tensor are older than a write of qpos or root pose."""
        self._not_updated: set[int] = set()
        """Articulations applied since PhysX last computed link poses."""
        super().__init__(scenes, *args, **kwargs)

    def gpu_init(self) -> None:
        super().gpu_init()
        self._stale.clear()

    def _setter(self, joint: Any, method: str) -> Callable[[float], None]:
        # The core's own call, for every joint in every control step: without the guard of `accessors`.
        function = getattr(type(joint), method)
        return partial(getattr(function, "__wrapped__", function), joint)

    # --- called by ManiSkill's setters and getters (see accessors) ------------------------------------

    def about_to_write(self, struct: Any, group: Group, index: torch.Tensor) -> None:
        """A setter of `struct` will write rows `index` of `group`'s tensor."""
        self._writes.note(group, index.numpy().astype(np.int64))
        if self.being_reset is not None:
            envs = struct._scene_idxs.long()
            others = struct.scene._reset_mask[envs] & ~self.being_reset[envs]
            if bool(others.any()):
                self.reported_elsewhere.add(struct.name)
                self.rules.report_breach(
                    "other-env-written",
                    f"'{struct.name}' is written in {envs_named(envs[others])}, which "
                    "are not being reset: in _initialize_episode only the envs of env_idx may be changed.",
                )

    def about_to_read(self, struct: Any, group: Group, index: torch.Tensor) -> None:
        """A getter of `struct` will read rows `index` of `group`'s tensor."""
        self._catch_up()
        # An Articulation answers for its root, which is never old.
        if group == "links" and (self._outdated or self._writes) and hasattr(struct, "is_root"):
            if not bool(struct.is_root.all()):
                self._refuse_old_links(struct)
        if group not in self._stale:
            return
        if any(m.behind()[np.searchsorted(m.rows, index.numpy())].any() for m in self._mirrors.of[group]):
            self.rules.report_breach(
                "read-before-fetch",
                f"The state of '{struct.name}' is read after the simulation moved on and before it was fetched: "
                "on the GPU, and here, this gives the state before the step. Call self.scene._gpu_fetch_all() "
                "first (under `if self.gpu_sim_enabled:`).",
            )

    def _refuse_old_links(self, link: Any) -> None:
        old = self._outdated.union(
            self._mirrors.qpos.changed().tolist(), self._mirrors.roots.changed().tolist()
        )
        old &= {self.index_of(body.articulation) for body in link._bodies} if old else set()
        if old:
            name = self._mirrors.qpos.names[min(old)]
            self.rules.report_breach(
                "link-before-update",
                f"The pose of link '{link.name}' is read after the qpos or pose of '{name}' was set: on the GPU, "
                "and here, it is still where it was. Call self.scene._gpu_apply_all(), "
                "self.scene.px.gpu_update_articulation_kinematics() and self.scene._gpu_fetch_all() before.",
            )

    # --- fetches -------------------------------------------------------------------------------------

    def _fetch(self, group: Group) -> None:
        for mirror in self._mirrors.of[group]:
            self._refuse_loss(mirror)
        super()._fetch(group)
        self._stale.discard(group)
        self._writes.forget(group)
        if group == "links":
            self._outdated &= self._not_updated

    def gpu_update_articulation_kinematics(self) -> None:
        super().gpu_update_articulation_kinematics()
        self._not_updated.clear()

    def _refuse_loss(self, mirror: Mirror) -> None:
        """Break the rule if a fetch will overwrite what was set."""
        lost = mirror.written()
        if not lost.any():
            return
        group, what = mirror.group, mirror.what
        if group in ("bodies", "links"):
            what = "pose" if lost[:, :7].any() else "velocity"
        roots = self._laid_out.root_rows
        if "stop" in (self.rules.degree("not-applied"), self.rules.degree("link-pose-set")):
            # As on the GPU: else the reset that follows would apply the write after all.
            mirror.drop()
        for name, mine in _by_name(mirror.rows[lost.any(axis=1)], mirror.names):
            where, frames = envs_named(mirror.envs[mine]), self._writes.frames(group, mine)
            seen_by = ", pictures do, here and on the GPU" if what == "pose" else ""
            if group == "links" and what == "pose" and not np.isin(mine, roots).any():
                self.rules.report_breach(
                    "link-pose-set",
                    f"The pose of link '{name}' was set in {where}: physics never sees it{seen_by}. "
                    "Links follow their articulation: set its qpos or its root pose.",
                    frames,
                )
            else:
                self.rules.report_breach(
                    "not-applied",
                    f"The {what} of '{name}' in {where} was set and not applied: physics never sees it{seen_by}, and "
                    "the next fetch overwrites it. To have it seen, call self.scene._gpu_apply_all() and "
                    "self.scene._gpu_fetch_all() after the write (under `if self.gpu_sim_enabled:`).",
                    frames,
                )

    # --- applies -------------------------------------------------------------------------------------

    def _apply(self, mirror: Mirror, keep_awake: bool = False) -> None:
        self._catch_up()
        if mirror.group in self._stale and mirror is not self._mirrors.root_velocities:
            # qpos and qvel are fetched together: an apply of one reports both.
            self._refuse_stale_apply(self._mirrors.of["joints"] if mirror.group == "joints" else [mirror])
        if mirror is self._mirrors.roots or mirror is self._mirrors.qpos:
            changed = mirror.changed().tolist()
            self._outdated.update(changed)
            self._not_updated.update(changed)
        self._applying += 1
        try:
            super()._apply(mirror, keep_awake)
        finally:
            self._applying -= 1
        self._writes.forget(mirror.group)

    def _refuse_stale_apply(self, mirrors: Sequence[Mirror]) -> None:
        undone = [
            m.names[row] for m in mirrors for row in m.rows[(m.behind() & ~m.differs()).any(axis=1)][:1]
        ]
        if undone:
            self.rules.report_breach(
                "apply-before-fetch",
                f"State is applied after the simulation moved on and before it was fetched: on the GPU this puts "
                f"'{undone[0]}', and everything else that moved, back to before the step, in all envs. "
                "Here only what was written is applied. Call self.scene._gpu_fetch_all() before you write.",
            )

    # --- steps and direct access -----------------------------------------------------------------------

    def step(self) -> None:
        if self.laid_out and len(hit := self._mirrors.qf.changed()):
            name, envs = self._mirrors.qf.names[hit[0]], self._mirrors.qf.envs[hit]
            if self.rules.degree("not-applied") == "stop":
                self._mirrors.qf.drop()
            self.rules.report_breach(
                "not-applied",
                f"The joint forces (qf) of '{name}' in {envs_named(envs)} were set and not applied: on the GPU, and here, "
                "the step does not see them. Call self.scene.px.gpu_apply_articulation_qf() after the write.",
                self._writes.frames("forces", hit),
            )
        if self.being_reset is not None:
            self.stepped_in_reset = True
            others = np.flatnonzero(~self.being_reset.numpy())
            self.rules.report_breach(
                "stepped-in-reset",
                f"The simulation is stepped in _initialize_episode while {envs_named(others)} are not being reset: "
                "their episodes advance as well. (With one env, as --num-envs 1 opens it, there are no others.)",
            )
        super().step()

    def _moved(self) -> None:
        super()._moved()
        if not self._applying:
            self._stale.update(_MOVING)
            self._not_updated.clear()

    # --- partial resets --------------------------------------------------------------------------------

    def refuse_unapplied_writes(self, reset: torch.Tensor) -> None:
        """Break the rule if a write to an env that is not in the mask `reset` (N,) was never applied."""
        for mirror in self._mirrors.all:
            if mirror.group == "targets":
                continue
            written = mirror.written().any(axis=1)
            rows = mirror.rows[written & ~reset.numpy()[mirror.envs[mirror.rows]]]
            if len(rows) and self.rules.degree("applied-by-reset") == "stop":
                mirror.now[rows] = mirror.seen[rows]
            for name, mine in _by_name(rows, mirror.names):
                self.rules.report_breach(
                    "applied-by-reset",
                    f"The {mirror.what} of '{name}' in {envs_named(mirror.envs[mine])} was set outside _initialize_episode and "
                    "not applied: on the GPU, and here, the reset of other envs applies it now. Call "
                    "self.scene._gpu_apply_all() and self.scene._gpu_fetch_all() after the write (under "
                    "`if self.gpu_sim_enabled:`).",
                    self._writes.frames(mirror.group, mine),
                )

    def copy_of_state(self) -> list[Floats]:
        """Copies of all tensors that tasks read and write."""
        return [mirror.now[mirror.at].copy() for mirror in self._mirrors.all]

    def refuse_changes_elsewhere(self, before: list[Floats], reset: torch.Tensor) -> None:
        """Break the rule if an env that is not in the mask `reset` (N,) differs from `before`."""
        for mirror, was in zip(self._mirrors.all, before, strict=True):
            if self.stepped_in_reset or mirror.group == "forces":
                continue
            differs = mirror.now[mirror.at] != was
            if mirror is self._mirrors.links:
                # Velocities of links are fetched on demand, which is no change (except a root's).
                differs[~np.isin(mirror.rows, self._laid_out.root_rows), 7:] = False
            changed = mirror.rows[differs.any(axis=1)]
            changed = changed[~reset.numpy()[mirror.envs[changed]]]
            for name, mine in _by_name(changed, mirror.names):
                if name in self.reported_elsewhere:
                    continue
                self.rules.report_breach(
                    "other-env-written",
                    f"_initialize_episode changed the {mirror.what} of '{name}' in {envs_named(mirror.envs[mine])}, which are "
                    "not being reset: only the envs of env_idx may be changed.",
                    self._writes.frames(mirror.group, mine) or None,
                    self.hook_of_reset,
                )


def _tensor_property(name: str) -> property:
    def get(self: StrictCpuSystem) -> CpuArray:
        value = self.__dict__.get(name)
        if value is None:
            return self.__getattr__(name)
        self._writes.note_handed_out(name)
        return value

    def put(self: StrictCpuSystem, value: CpuArray) -> None:
        self.__dict__[name] = value

    return property(get, put)


for _name in TENSORS:
    setattr(StrictCpuSystem, _name, _tensor_property(_name))


def _by_name(rows: NDArray[np.int64], names: list[str]) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """Rows by name, for at most `THINGS_NAMED` names."""
    found: dict[str, list[int]] = {}
    for row in rows.tolist():
        found.setdefault(names[row], []).append(row)
    for name in list(found)[:THINGS_NAMED]:
        yield name, np.array(found[name], dtype=np.int64)


def envs_named(envs: Any) -> str:
    """``env 3``, or ``envs 0, 1, 2``, at most eight of them."""
    numbers = sorted({int(env) for env in envs})
    named = ", ".join(str(env) for env in numbers[:ENVS_NAMED])
    more = f" and {len(numbers) - ENVS_NAMED} more" if len(numbers) > ENVS_NAMED else ""
    return f"env{'s' if len(numbers) > 1 else ''} {named}{more}"

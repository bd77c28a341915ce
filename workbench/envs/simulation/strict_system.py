"""A batched CPU system that reports where GPU simulation behaves differently."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from types import FrameType
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.envs.broken_rule import OWN_CODE, BrokenRules, Frame, Place, frames_of_the_task
from workbench.envs.simulation.contact_queries import CpuArray
from workbench.envs.simulation.cpu_system import MOVING, TENSORS, BatchedCpuSystem
from workbench.envs.simulation.mirrors import Floats, Group, Mirror, differ

_OWN_CODE = (*OWN_CODE, "mani_skill.")


@dataclass(frozen=True)
class _Write:
    """A write to rows of a group that is not applied yet."""

    group: Group
    rows: NDArray[np.int64] | None
    """Rows of the group's tensor; None if the whole tensor was handed out."""
    frames: tuple[Frame, ...]
    """Innermost first."""


class Writes:
    """Writes that the task neither applied nor overwrote by a fetch, each with the frames that led to it.

    A write that a GPU loses is noticed at the next fetch, and reported at the line of the write. A task may
    also take a whole tensor and write to it without a setter; then the line that took the tensor is reported.
    """

    def __init__(self) -> None:
        self._kept: list[_Write] = []

    def __bool__(self) -> bool:
        return bool(self._kept)

    def note(self, group: Group, rows: NDArray[np.int64]) -> None:
        """Note that the present call writes these rows."""
        self._kept.append(_Write(group, rows, frames_of_the_task()))

    def note_handed_out(self, tensor: str, reader: FrameType) -> bool:
        """Note the code that reads a whole tensor. Returns False, and notes nothing, for code of the core or
        ManiSkill."""
        if reader.f_globals.get("__name__", "").startswith(_OWN_CODE):
            return False
        frames = frames_of_the_task(reader)
        self._kept.extend(_Write(group, None, frames) for group in TENSORS[tensor])
        return True

    def forget(self, group: Group) -> None:
        """Drop the writes of a group that was applied or fetched."""
        if self._kept:
            self._kept = [write for write in self._kept if write.group != group]

    def frames(self, group: Group, rows: NDArray[np.int64]) -> tuple[Frame, ...]:
        """Frames of the last write to one of these rows, else of the last read of the whole tensor; empty if
        unknown."""
        for write in reversed(self._kept):
            if write.group == group and write.rows is not None and np.isin(rows, write.rows).any():
                return write.frames
        for write in reversed(self._kept):
            if write.group == group and write.rows is None:
                return write.frames
        return ()


MAX_NAMED_ENVS = MAX_NAMED_BODIES = 8


class StrictCpuSystem(BatchedCpuSystem):
    """A `BatchedCpuSystem` that reports breaches of the rules of GPU simulation.

    On the GPU a setter writes to a tensor. ``gpu_apply_*`` copies the tensor to the simulation and
    ``gpu_fetch_*`` copies the simulation to the tensor, for all envs and without a message. So a pose that
    was set and not applied is lost at the next fetch; an apply after a step, without a fetch between, moves
    every body of every env back; and a read before the fetch returns old state. `BatchedCpuSystem` does what
    a stock CPU env does. This class tracks the values that a GPU would have, reports where they differ, and
    changes no bit. It compares values, not calls: setting a pose to its present value is not a breach.
    """

    rules: BrokenRules
    """Receives the breaches. One object for the env, which keeps it when the scene is built again."""
    hook_of_reset: Place | None = None
    """Where the task defines ``_initialize_episode``."""

    def __init__(self, scenes: Sequence[sapien.Scene], *args: Any, **kwargs: Any) -> None:
        self._writes = Writes()
        self._held: dict[int, Floats] = {}
        """Values that a GPU's simulation would have, for each tensor that was written or handed out since its
        last apply or fetch; by the ``id`` of the tensor's array."""
        self._stale: set[Group] = set()
        """Groups that moved since they were fetched."""
        self._moved_unfetched: dict[Group, str] = {}
        """For each group that was refreshed since it became stale, the name of a body that had moved."""
        self._frames_of_step: tuple[Frame, ...] = ()
        """Frames of the last step that the task itself made; empty if ManiSkill made it."""
        self.being_reset: torch.Tensor | None = None
        """(N,) bool while ``_initialize_episode`` runs for some envs only."""
        self.reported_elsewhere: set[str] = set()
        """Names of bodies for which this partial reset has already reported a write in envs that are not
        being reset."""
        self._outdated: set[int] = set()
        """Indices of articulations whose link poses in a GPU's tensor would be older than a write of qpos or
        root pose."""
        self._not_updated: set[int] = set()
        """Indices of articulations whose qpos or root pose was applied, and whose link poses a GPU would not
        have computed since then."""
        super().__init__(scenes, *args, **kwargs)

    def gpu_init(self) -> None:
        super().gpu_init()
        self._writes = Writes()
        for kept in (self._held, self._stale, self._moved_unfetched, self._outdated, self._not_updated):
            kept.clear()

    def _setter(self, joint: Any, method: str) -> Callable[[float], None]:
        # The core calls the method for every joint in every control step, so skip the guard of `accessors`.
        function = getattr(type(joint), method)
        return partial(getattr(function, "__wrapped__", function), joint)

    # --- called by ManiSkill's setters and getters (see accessors) ------------------------------------

    def about_to_write(self, struct: Any, group: Group, rows: NDArray[np.int64]) -> None:
        """Check that a setter of `struct` may write `rows` of `group`'s tensor, and note the write."""
        self._hold(group)
        self._writes.note(group, rows)
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

    def about_to_read(self, struct: Any, group: Group, rows: NDArray[np.int64]) -> None:
        """Check that a getter of `struct` may read `rows` of `group`'s tensor."""
        self.catch_up()
        # Skip an Articulation: it reads its root, which is never out of date.
        if group == "links" and (self._outdated or self._writes) and hasattr(struct, "is_root"):
            if not bool(struct.is_root.all()):
                self._refuse_old_links(struct)
        if group not in self._stale:
            return
        if any(m.behind()[np.searchsorted(m.rows, rows)].any() for m in self._mirrors.of[group]):
            self.rules.report_breach(
                "read-before-fetch",
                f"The state of '{struct.name}' is read after the simulation moved on and before it was fetched: "
                "on the GPU this gives the state before the step. Call self.scene._gpu_fetch_all() first (under "
                "`if self.gpu_sim_enabled:`).",
            )

    def _refuse_old_links(self, link: Any) -> None:
        own = self._mirrors
        old = self._outdated.union(
            np.flatnonzero(self._unapplied(own.qpos).any(axis=1)).tolist(),
            np.flatnonzero(self._unapplied(own.roots).any(axis=1)).tolist(),
        )
        old &= {self.index_of(body.articulation) for body in link._bodies} if old else set()
        if old:
            name = own.qpos.names[min(old)]
            self.rules.report_breach(
                "link-before-update",
                f"The pose of link '{link.name}' is read after the qpos or pose of '{name}' was set: on the "
                "GPU the link still has its old pose. Before the read, call self.scene._gpu_apply_all(), "
                "self.scene.px.gpu_update_articulation_kinematics() and self.scene._gpu_fetch_all() (under "
                "`if self.gpu_sim_enabled:`).",
            )

    def report(self, rule: str, message: str) -> None:
        self.rules.report_breach(rule, message)

    # --- what a GPU would hold ---------------------------------------------------------------------------

    def _hold(self, group: Group) -> None:
        """Copy a group's tensors before a write: these are the values that a GPU's simulation would have."""
        for mirror in self._mirrors.of[group]:
            if id(mirror.now) not in self._held:
                self._held[id(mirror.now)] = mirror.now.copy()

    def _unapplied(self, mirror: Mirror) -> NDArray[np.bool_]:
        """(K, W) True where a number was written and, on a GPU, would not be in the simulation yet."""
        held = self._held.get(id(mirror.now))
        differs = mirror.differs()
        return differs if held is None else differs | differ(mirror.now[mirror.at], held[mirror.at])

    def tensor(self, name: str) -> CpuArray:
        tensor = super().tensor(name)
        if self._writes.note_handed_out(name, sys._getframe(2)):
            for group in TENSORS[name]:
                self._hold(group)
        return tensor

    def refresh(self, group: Group) -> None:
        self.catch_up()
        if group not in self._behind:
            return
        self._follow_structure()
        before = [(mirror, mirror.now.copy()) for mirror in self._mirrors.of[group]]
        super().refresh(group)
        for mirror, was in before:
            held = self._held.get(id(mirror.now))
            if held is not None:  # a GPU would hold the new value of a number that was not written
                held[...] = np.where(differ(was, held), held, mirror.now)
            if group in self._stale and group not in self._moved_unfetched:
                moved = differ(mirror.now[mirror.at], was[mirror.at]).any(axis=1)
                if moved.any():
                    self._moved_unfetched[group] = mirror.names[mirror.rows[int(np.argmax(moved))]]

    # --- fetches -------------------------------------------------------------------------------------

    def _fetch(self, group: Group) -> None:
        self._follow_structure()
        try:
            for mirror in self._mirrors.of[group]:
                self._refuse_loss(mirror)
        finally:
            super()._fetch(group)
            self._settled(group)
            self._stale.discard(group)
            self._moved_unfetched.pop(group, None)
            if group == "links":
                self._outdated &= self._not_updated

    def _settled(self, group: Group) -> None:
        """Note that the group was fetched."""
        self._writes.forget(group)
        if not self._writes:
            self._held.clear()
        for mirror in self._mirrors.of[group] if self._held else ():
            if (held := self._held.get(id(mirror.now))) is not None:
                held[mirror.at] = mirror.now[mirror.at]

    def drop_writes(self) -> None:
        super().drop_writes()
        self._writes = Writes()
        self._held.clear()

    def gpu_update_articulation_kinematics(self) -> None:
        super().gpu_update_articulation_kinematics()
        self._not_updated.clear()

    def _refuse_loss(self, mirror: Mirror) -> None:
        """Report a breach if a fetch on a GPU would overwrite values that were set."""
        lost = self._unapplied(mirror)
        if not lost.any():
            return
        group, what = mirror.group, mirror.what
        if group in ("bodies", "links"):
            what = "pose" if lost[:, :7].any() else "velocity"
        roots = self._laid_out.root_rows
        for name, mine in _by_name(mirror.rows[lost.any(axis=1)], mirror.names):
            where, frames = envs_named(mirror.envs[mine]), self._writes.frames(group, mine)
            seen_by = ", pictures do" if what == "pose" else ""
            if group == "links" and what == "pose" and not np.isin(mine, roots).any():
                self.rules.report_breach(
                    "link-pose-set",
                    f"The pose of link '{name}' was set in {where}: on the GPU physics never sees it{seen_by}, and here it "
                    "stays until the next step. Links follow their articulation: set its qpos or its root pose.",
                    frames,
                )
            else:
                self.rules.report_breach(
                    "not-applied",
                    f"The {what} of '{name}' in {where} was set and not applied: on the GPU physics never sees it{seen_by}, "
                    "and the next fetch overwrites it. Call self.scene._gpu_apply_all() and self.scene._gpu_fetch_all() "
                    "after the write (under `if self.gpu_sim_enabled:`).",
                    frames,
                )

    # --- applies -------------------------------------------------------------------------------------

    def _apply(self, mirror: Mirror) -> None:
        self.catch_up()
        if mirror.group in self._stale and mirror is not self._mirrors.root_velocities:
            # qpos and qvel are fetched together, so an apply of one checks both.
            self._refuse_stale_apply(self._mirrors.of["joints"] if mirror.group == "joints" else [mirror])
        if mirror is self._mirrors.roots or mirror is self._mirrors.qpos:
            changed = np.flatnonzero(self._unapplied(mirror).any(axis=1)).tolist()
            self._outdated.update(changed)
            self._not_updated.update(changed)
        super()._apply(mirror)
        held = self._held.get(id(mirror.now))
        if held is not None:
            held[mirror.at] = mirror.now[mirror.at]
        self._writes.forget(mirror.group)

    def _refuse_stale_apply(self, mirrors: Sequence[Mirror]) -> None:
        group = mirrors[0].group
        undone = self._moved_unfetched.get(group) or next(
            (m.names[row] for m in mirrors for row in m.rows[(m.behind() & ~m.differs()).any(axis=1)]), None
        )
        if undone is not None:
            self.rules.report_breach(
                "apply-before-fetch",
                f"State is applied after the simulation moved on and before it was fetched: on the GPU this puts "
                f"'{undone}', and everything else that moved, back to before the step, in all envs. "
                "Here only what was written is applied. Call self.scene._gpu_fetch_all() before you write.",
                self._frames_of_step,
            )

    # --- steps and direct access -----------------------------------------------------------------------

    def step(self) -> None:
        if self.laid_out and (unapplied := self._unapplied(self._mirrors.qf)).any():
            self._refuse_unapplied_forces(np.flatnonzero(unapplied.any(axis=1)))
        caller = sys._getframe(2)
        self._frames_of_step = () if caller.f_code is _STEP_ACTION else frames_of_the_task()
        if self.resetting is not None:
            others = np.flatnonzero(~self.resetting.numpy())
            self.rules.report_breach(
                "stepped-in-reset",
                f"The simulation is stepped in a reset while {envs_named(others)} are not being reset: on the GPU their "
                "episodes advance as well. (With --num-envs 1 there are no other envs.)",
            )
        super().step()

    def _refuse_unapplied_forces(self, hit: NDArray[np.int64]) -> None:
        qf = self._mirrors.qf
        self.rules.report_breach(
            "not-applied",
            f"The joint forces (qf) of '{qf.names[hit[0]]}' in {envs_named(qf.envs[hit])} were set and not applied: on the "
            "GPU the step does not see them. Call self.scene.px.gpu_apply_articulation_qf() after the write (under "
            "`if self.gpu_sim_enabled:`).",
            self._writes.frames("forces", hit),
        )

    def _stepped(self) -> None:
        super()._stepped()
        self._stale.update(MOVING)
        self._not_updated.clear()

    def note_change(self) -> None:
        super().note_change()
        self._stale.update(MOVING)
        self._not_updated.clear()

    # --- partial resets --------------------------------------------------------------------------------

    def refuse_unapplied_writes(self, reset: torch.Tensor) -> None:
        """Report a breach if a write to an env where the mask `reset` (N,) is False was never applied."""
        for mirror in self._mirrors.all:
            if mirror.group == "targets":
                continue
            written = self._unapplied(mirror).any(axis=1)
            rows = mirror.rows[written & ~reset.numpy()[mirror.envs[mirror.rows]]]
            for name, mine in _by_name(rows, mirror.names):
                self.rules.report_breach(
                    "applied-by-reset",
                    f"The {mirror.what} of '{name}' in {envs_named(mirror.envs[mine])} was set outside _initialize_episode and "
                    "not applied: on the GPU it is applied only when other envs are reset. Call "
                    "self.scene._gpu_apply_all() and self.scene._gpu_fetch_all() after the write (under "
                    "`if self.gpu_sim_enabled:`).",
                    self._writes.frames(mirror.group, mine),
                )

    def copy_of_state(self) -> tuple[int, list[Floats]]:
        """The version of the layout, and copies of all tensors that tasks read and write."""
        return self.layout_version, [mirror.now[mirror.at].copy() for mirror in self._mirrors.all]

    def refuse_changes_elsewhere(self, before: tuple[int, list[Floats]], reset: torch.Tensor) -> None:
        """Report a breach if the state of an env where the mask `reset` (N,) is False differs from
        `before`."""
        version, states = before
        if version != self.layout_version:
            return  # the rows now belong to other bodies
        for mirror, was in zip(self._mirrors.all, states, strict=True):
            if mirror.group == "forces":
                continue
            differs = differ(mirror.now[mirror.at], was)
            if mirror is self._mirrors.links:
                # Ignore velocities of links other than roots: they are fetched on demand, which is not a change.
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


_STEP_ACTION = BaseEnv._step_action.__code__


def _by_name(rows: NDArray[np.int64], names: list[str]) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """Rows by name, for at most `MAX_NAMED_BODIES` names."""
    found: dict[str, list[int]] = {}
    for row in rows.tolist():
        found.setdefault(names[row], []).append(row)
    for name in list(found)[:MAX_NAMED_BODIES]:
        yield name, np.array(found[name], dtype=np.int64)


def envs_named(envs: Any) -> str:
    """``env 3``, or ``envs 0, 1, 2``; after eight numbers, only the count of further envs."""
    numbers = sorted({int(env) for env in envs})
    named = ", ".join(str(env) for env in numbers[:MAX_NAMED_ENVS])
    more = f" and {len(numbers) - MAX_NAMED_ENVS} more" if len(numbers) > MAX_NAMED_ENVS else ""
    return f"env{'s' if len(numbers) > 1 else ''} {named}{more}"

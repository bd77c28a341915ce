"""A batched CPU system that notices what would be lost, or overwritten, on the GPU.

On the GPU the tensors are a copy of the simulation: ``gpu_fetch_*`` writes them over with what the
simulation holds, ``gpu_apply_*`` writes the simulation over with what they hold, both for all envs and
both without a word. So a pose that was set and not applied is gone after the next fetch, an apply after a
step without a fetch puts every body of every env back to where it was, and a read between the two
gives the past. `BatchedCpuSystem` does the first and the last as the GPU does, and is kinder about the
second; this one tells of all three. Where the rule only warns, what it does is what that one does, bit for bit.

It compares values and not calls, so that what changes nothing is no fault: a pose set to what it was, an
apply of bodies that have not moved. Where the setters of ManiSkill's structs were called from
is kept until the write is applied (`who_wrote`): the fault is told at the line that wrote, though it shows
only at the fetch.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import sapien
import torch
from numpy.typing import NDArray

from workbench.core.broken_rule import BrokenRules, Place
from workbench.core.contacts import CpuArray
from workbench.core.cpu_system import BatchedCpuSystem
from workbench.core.drive_targets import Setters
from workbench.core.gpu_members import applies_everything
from workbench.core.who_wrote import TENSORS, Group, Writes

ENVS_NAMED = THINGS_NAMED = 8
_MOVING: tuple[Group, ...] = ("bodies", "links", "joints")
"""What a step moves; targets and joint forces stay what they were set to."""
_MOVED = 1e-4
"""Metres, radians, per second. PhysX rounds the root pose of an articulation when it is set, by about 1e-7."""
_IN_ENV = re.compile(r"^scene-\d+[-_]")


class StrictCpuSystem(BatchedCpuSystem):
    """See the module's text."""

    rules: BrokenRules
    """What a broken rule is told to; of the env, so that it outlives a scene."""
    being_reset: torch.Tensor | None = None
    """(N,) bool while ``_initialize_episode`` runs for some envs and not for others."""
    stepped_in_reset = False
    hook_of_reset: Place | None = None
    """Where the task defines ``_initialize_episode``."""

    def __init__(self, scenes: Sequence[sapien.Scene], *args: Any, **kwargs: Any) -> None:
        self._writes = Writes()
        self._stale: set[Group] = set()
        self.told_elsewhere: set[str] = set()
        """Of other envs, in the partial reset under way: the names of what was told already."""
        self._applying = 0
        self._outdated: set[int] = set()
        """Articulations whose links in the tensor are those of before a write of qpos or root pose."""
        self._not_updated: set[int] = set()
        """Articulations applied since PhysX last computed where links are."""
        super().__init__(scenes, *args, **kwargs)

    def gpu_init(self) -> None:
        super().gpu_init()
        layout = self._laid_out
        env_of = {id(scene): env for env, scene in enumerate(self.scenes)}
        owners = [*zip(layout.body_rows, layout.bodies, strict=True)]
        owners += [*zip(layout.link_rows, layout.links, strict=True)]
        self._name_of_row = [""] * layout.row_count
        self._env_of_row = np.zeros(layout.row_count, dtype=np.int64)
        for row, body in owners:
            self._name_of_row[row] = _IN_ENV.sub("", body.entity.name)
            self._env_of_row[row] = env_of[id(body.entity.scene)]
        self._articulation_names = [_IN_ENV.sub("", a.name) for a in layout.articulations]
        self._articulation_envs = self._env_of_row[layout.root_rows]
        self._root_in_links = np.searchsorted(layout.link_rows, layout.root_rows)
        self._stale.clear()
        self._writes.forget_all()

    def _setters(self, method: str) -> Setters:
        # Called for every joint in every control step, and the core's own: past the guard of behind_tensors.
        articulations = self._laid_out.articulations
        return [[_unguarded(joint, method) for joint in a.active_joints] for a in articulations]

    # --- what ManiSkill's setters and getters tell (see struct_access) -------------------------------

    def about_to_write(self, struct: Any, group: Group, index: torch.Tensor) -> None:
        """A setter of `struct` will write rows `index` of `group`'s tensor."""
        self._writes.note(group, index.numpy().astype(np.int64))
        if self.being_reset is not None:
            envs = struct._scene_idxs.long()
            others = struct.scene._reset_mask[envs] & ~self.being_reset[envs]
            if bool(others.any()):
                self.told_elsewhere.add(struct.name)
                self.rules.breaks(
                    "other-env-written",
                    f"'{struct.name}' is written in {envs_named(envs[others])}, which "
                    "are not being reset: in _initialize_episode only the envs of env_idx may be changed.",
                )

    def about_to_read(self, struct: Any, group: Group, index: torch.Tensor) -> None:
        """A getter of `struct` will read rows `index` of `group`'s tensor."""
        self._catch_up()
        if group == "links" and (self._outdated or self._writes) and not bool(struct.is_root.all()):
            self._refuse_old_links(struct)
        if group not in self._stale:
            return
        rows = index.numpy()
        now, truth = self._tensor_and_truth(group)
        at = np.searchsorted(self._laid_out.body_rows, rows) if group == "bodies" else rows
        at = np.searchsorted(self._laid_out.link_rows, rows) if group == "links" else at
        if (np.abs(now[at] - truth[at]) > _MOVED).any():
            self.rules.breaks(
                "read-before-fetch",
                f"The state of '{struct.name}' is read after the simulation moved on and before it was fetched: "
                "on the GPU, and here, this gives the state before the step. Call self.scene._gpu_fetch_all() "
                "first (under `if self.gpu_sim_enabled:`).",
            )

    def _refuse_old_links(self, link: Any) -> None:
        layout = self._laid_out
        old = set(self._outdated)
        old.update(np.flatnonzero((self._qpos != self._qpos_seen).any(axis=1)).tolist())
        roots = self._data[layout.root_rows, :7] != self._data_seen[layout.root_rows, :7]
        old.update(np.flatnonzero(roots.any(axis=1)).tolist())
        owners = {layout.index_of[id(body.articulation)] for body in link._bodies} if old else set()
        if old & owners:
            name = self._articulation_names[min(old & owners)]
            self.rules.breaks(
                "link-before-update",
                f"The pose of link '{link.name}' is read after the qpos or pose of '{name}' was set: on the GPU, "
                "and here, it is still where it was. Call self.scene._gpu_apply_all(), "
                "self.scene.px.gpu_update_articulation_kinematics() and self.scene._gpu_fetch_all() before.",
            )

    # --- fetches -------------------------------------------------------------------------------------

    def gpu_fetch_rigid_dynamic_data(self) -> None:
        layout = self._laid_out
        self._refuse_loss("bodies", self._data, self._data_seen, layout.body_rows)
        super().gpu_fetch_rigid_dynamic_data()
        self._fetched("bodies")

    def gpu_fetch_articulation_link_pose(self) -> None:
        layout = self._laid_out
        self._refuse_loss("links", self._data, self._data_seen, layout.link_rows)
        super().gpu_fetch_articulation_link_pose()
        self._fetched("links")
        self._outdated &= self._not_updated

    def gpu_fetch_articulation_qpos(self) -> None:
        self._refuse_loss("joints", self._qpos, self._qpos_seen, what="qpos")
        self._refuse_loss("joints", self._qvel, self._qvel_seen, what="qvel")
        super().gpu_fetch_articulation_qpos()
        self._fetched("joints")

    def gpu_fetch_articulation_target_qpos(self) -> None:
        self._refuse_loss("targets", self._targets.now, self._targets.seen, what="drive targets")
        self._refuse_loss(
            "targets", self._velocity_targets.now, self._velocity_targets.seen, what="drive velocity targets"
        )
        super().gpu_fetch_articulation_target_qpos()
        self._fetched("targets")

    def gpu_update_articulation_kinematics(self) -> None:
        super().gpu_update_articulation_kinematics()
        self._not_updated.clear()

    def _fetched(self, group: Group) -> None:
        self._stale.discard(group)
        self._writes.forget(group)

    def _refuse_loss(
        self,
        group: Group,
        now: NDArray[np.float32],
        seen: NDArray[np.float32],
        rows: NDArray[np.int64] | None = None,
        what: str = "",
    ) -> None:
        """Break the rule if `now` holds what was set since `seen` and the fetch will write over."""
        lost = now != seen if rows is None else now[rows] != seen[rows]
        if not lost.any():
            return
        if rows is None:
            rows = np.arange(len(now))
            names, envs = self._articulation_names, self._articulation_envs
        else:
            names, envs = self._name_of_row, self._env_of_row
        # A NaN differs from itself, and is the simulation's, not a write.
        lost &= ~(np.isnan(now[rows]) & np.isnan(seen[rows]))
        hit = lost.any(axis=1)
        if not hit.any():
            return
        what = what or ("pose" if lost[:, :7].any() else "velocity")
        lost_rows = rows[hit]
        roots = self._laid_out.root_rows
        if "stop" in (self.rules.degree("not-applied"), self.rules.degree("link-pose-set")):
            # As on the GPU: without this the write would be applied after all, by the reset that follows.
            now[rows] = seen[rows]
        for name, mine in _by_name(lost_rows, names):
            where, frames = envs_named(envs[mine]), self._writes.frames(group, mine)
            seen_by = ", pictures do, here and on the GPU" if what == "pose" else ""
            if group == "links" and what == "pose" and not np.isin(mine, roots).any():
                self.rules.breaks(
                    "link-pose-set",
                    f"The pose of link '{name}' was set in {where}: physics never sees it{seen_by}. "
                    "Links follow their articulation: set its qpos or its root pose.",
                    frames,
                )
            else:
                self.rules.breaks(
                    "not-applied",
                    f"The {what} of '{name}' in {where} was set and not applied: physics never sees it{seen_by}, and "
                    "the next fetch writes it over. To have it seen, call self.scene._gpu_apply_all() and "
                    "self.scene._gpu_fetch_all() after the write (under `if self.gpu_sim_enabled:`).",
                    frames,
                )

    # --- applies -------------------------------------------------------------------------------------

    @applies_everything
    def gpu_apply_rigid_dynamic_data(self) -> None:
        self._refuse_stale_apply("bodies")
        with self._own_writes("bodies"):
            super().gpu_apply_rigid_dynamic_data()

    @applies_everything
    def gpu_apply_articulation_root_pose(self) -> None:
        self._refuse_stale_apply("links")
        layout = self._laid_out
        self._note_kinematics(self._data[layout.root_rows, :7], self._data_seen[layout.root_rows, :7])
        with self._own_writes("links"):
            super().gpu_apply_articulation_root_pose()

    @applies_everything
    def gpu_apply_articulation_root_velocity(self) -> None:
        with self._own_writes("links"):
            super().gpu_apply_articulation_root_velocity()

    @applies_everything
    def gpu_apply_articulation_qpos(self) -> None:
        self._refuse_stale_apply("joints")
        self._note_kinematics(self._qpos, self._qpos_seen)
        with self._own_writes("joints"):
            super().gpu_apply_articulation_qpos()

    @applies_everything
    def gpu_apply_articulation_qvel(self) -> None:
        self._refuse_stale_apply("joints")
        with self._own_writes("joints"):
            super().gpu_apply_articulation_qvel()

    @applies_everything
    def gpu_apply_articulation_qf(self) -> None:
        with self._own_writes("forces"):
            super().gpu_apply_articulation_qf()

    @applies_everything
    def gpu_apply_articulation_target_position(self) -> None:
        with self._own_writes("targets"):
            super().gpu_apply_articulation_target_position()

    @applies_everything
    def gpu_apply_articulation_target_velocity(self) -> None:
        with self._own_writes("targets"):
            super().gpu_apply_articulation_target_velocity()

    def apply_changes(self) -> None:
        with self._own_writes("targets"):
            super().apply_changes()

    @contextmanager
    def _own_writes(self, group: Group) -> Iterator[None]:
        self._applying += 1
        try:
            yield
        finally:
            self._applying -= 1
        self._writes.forget(group)

    def _note_kinematics(self, now: NDArray[np.float32], seen: NDArray[np.float32]) -> None:
        changed = np.flatnonzero((now != seen).any(axis=1)).tolist()
        self._outdated.update(changed)
        self._not_updated.update(changed)

    def _refuse_stale_apply(self, group: Group) -> None:
        self._catch_up()
        if group not in self._stale:
            return
        now, truth = self._tensor_and_truth(group)
        layout, names = self._laid_out, self._name_of_row
        if group == "joints":
            rows, seen, names = np.arange(len(now)), self._qpos_seen, self._articulation_names
            seen = np.concatenate([self._qpos_seen, self._qvel_seen], axis=1)
        elif group == "links":
            # Only roots are applied.
            now, truth, rows = now[self._root_in_links], truth[self._root_in_links], layout.root_rows
            seen = self._data_seen[rows, :7]
        else:
            rows, seen = layout.body_rows, self._data_seen[layout.body_rows]
        undone = ((np.abs(now - truth) > _MOVED) & (now == seen)).any(axis=1)
        if undone.any():
            self.rules.breaks(
                "apply-before-fetch",
                f"State is applied after the simulation moved on and before it was fetched: on the GPU this puts "
                f"'{names[rows[undone][0]]}', and whatever else moved, back to before the step, in all envs. "
                "Here only what was written is applied. Call self.scene._gpu_fetch_all() before you write.",
            )

    # --- steps and direct access -----------------------------------------------------------------------

    def step(self) -> None:
        if self._layout is not None and (self._qf != self._qf_seen).any():
            hit = np.flatnonzero((self._qf != self._qf_seen).any(axis=1))
            name, envs = self._articulation_names[hit[0]], self._articulation_envs[hit]
            if self.rules.degree("not-applied") == "stop":
                self._qf[:] = self._qf_seen
            self.rules.breaks(
                "not-applied",
                f"The joint forces (qf) of '{name}' in {envs_named(envs)} were set and not applied: on the GPU, and here, "
                "the step does not see them. Call self.scene.px.gpu_apply_articulation_qf() after the write.",
                self._writes.frames("forces", hit),
            )
        if self.being_reset is not None:
            self.stepped_in_reset = True
            others = np.flatnonzero(~self.being_reset.numpy())
            self.rules.breaks(
                "stepped-in-reset",
                f"The simulation is stepped in _initialize_episode while {envs_named(others)} are not being reset: "
                "their episodes are moved on as well. (With one env, as --num-envs 1 opens it, there are no others.)",
            )
        super().step()

    def _moved(self) -> None:
        super()._moved()
        if not self._applying:
            self._stale.update(_MOVING)
            self._not_updated.clear()

    def _tensor_and_truth(self, group: Group) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """What the tensors hold of bodies, links' poses, or qpos and qvel, and what the simulation holds."""
        layout = self._laid_out
        if group == "bodies":
            return self._data[layout.body_rows], self._pack()[layout.body_at]
        if group == "links":
            return self._data[layout.link_rows, :7], self._link_poses()
        packed = self._pack()
        truth = [packed[layout.qpos_at], packed[layout.qvel_at]]
        return np.concatenate([self._qpos, self._qvel], axis=1), np.concatenate(truth, axis=1)

    # --- partial resets --------------------------------------------------------------------------------

    def refuse_standing_writes(self, reset: torch.Tensor) -> None:
        """Break the rule if a write to an env that is not in the mask `reset` (N,) was never applied."""
        layout = self._laid_out
        tensors: tuple[tuple[str, Group, NDArray[np.float32], NDArray[np.float32]], ...] = (
            ("state", "bodies", self._data, self._data_seen),
            ("qpos", "joints", self._qpos, self._qpos_seen),
            ("qvel", "joints", self._qvel, self._qvel_seen),
            ("joint forces (qf)", "forces", self._qf, self._qf_seen),
        )
        for what, group, now, seen in tensors:
            rigid = now is self._data
            env_of_row = self._env_of_row if rigid else self._articulation_envs
            names = self._name_of_row if rigid else self._articulation_names
            written = (now != seen) & ~(np.isnan(now) & np.isnan(seen))
            rows = np.flatnonzero(written.any(axis=1) & ~reset.numpy()[env_of_row])
            if len(rows) == 0:
                continue
            if self.rules.degree("applied-by-reset") == "stop":
                now[rows] = seen[rows]
            for name, mine in _by_name(rows, names):
                found: Group = "links" if rigid and mine[0] in layout.link_rows else group
                self.rules.breaks(
                    "applied-by-reset",
                    f"The {what} of '{name}' in {envs_named(env_of_row[mine])} was set outside _initialize_episode and "
                    "not applied: on the GPU, and here, the reset of other envs applies it now. Call "
                    "self.scene._gpu_apply_all() and self.scene._gpu_fetch_all() after the write (under "
                    "`if self.gpu_sim_enabled:`).",
                    self._writes.frames(found, mine),
                )

    def copy_of_state(self) -> dict[str, NDArray[np.float32]]:
        """The tensors as they are."""
        return {
            "state": self._data.copy(),
            "qpos": self._qpos.copy(),
            "qvel": self._qvel.copy(),
            "drive targets": self._targets.now.copy(),
            "drive velocity targets": self._velocity_targets.now.copy(),
        }

    def refuse_changes_elsewhere(self, before: dict[str, NDArray[np.float32]], reset: torch.Tensor) -> None:
        """Break the rule if an env that is not in the mask `reset` (N,) differs from `before`."""
        if self.stepped_in_reset:
            return
        for what, now in self.copy_of_state().items():
            rigid = what == "state"
            env_of_row = self._env_of_row if rigid else self._articulation_envs
            names = self._name_of_row if rigid else self._articulation_names
            elsewhere = ~reset.numpy()[env_of_row]
            changed = np.flatnonzero((now != before[what]).any(axis=1) & elsewhere)
            # A link's velocity is fetched when it is asked for, which is no change.
            if rigid:
                poses = (now[:, :7] != before[what][:, :7]).any(axis=1)
                links = np.isin(changed, np.setdiff1d(self._laid_out.link_rows, self._laid_out.root_rows))
                changed = changed[~links | poses[changed]]
            groups: tuple[Group, ...] = ("bodies", "links") if rigid else ("joints", "targets")
            for name, mine in _by_name(changed, names):
                if name in self.told_elsewhere:
                    continue
                frames = [self._writes.frames(group, mine) for group in groups]
                self.rules.breaks(
                    "other-env-written",
                    f"_initialize_episode changed the {what} of '{name}' in {envs_named(env_of_row[mine])}, which are "
                    "not being reset: only the envs of env_idx may be changed.",
                    next((found for found in frames if found), None),
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


def _unguarded(owner: Any, method: str) -> Callable[[float], None]:
    function = getattr(type(owner), method)
    return partial(getattr(function, "__wrapped__", function), owner)


def _by_name(rows: NDArray[np.int64], names: list[str]) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """The rows of each thing, at most `THINGS_NAMED` of them."""
    found: dict[str, list[int]] = {}
    for row in rows:
        found.setdefault(names[row], []).append(int(row))
    for name in list(found)[:THINGS_NAMED]:
        yield name, np.array(found[name], dtype=np.int64)


def envs_named(envs: Any) -> str:
    """``env 3``, or ``envs 0, 1, 2``, at most eight of them."""
    numbers = sorted({int(env) for env in envs})
    named = ", ".join(str(env) for env in numbers[:ENVS_NAMED])
    more = f" and {len(numbers) - ENVS_NAMED} more" if len(numbers) > ENVS_NAMED else ""
    return f"env{'s' if len(numbers) > 1 else ''} {named}{more}"

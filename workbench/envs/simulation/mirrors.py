"""Tensors that tasks write to, each with the simulation's last known values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import numpy as np
import sapien
from numpy.typing import NDArray

from workbench.envs.error_notes import RefusedValue
from workbench.envs.simulation.state_layout import BODY, StateLayout

Group = Literal["bodies", "links", "joints", "targets", "forces"]
"""Name of a group of tensors that are fetched and applied together."""
GROUPS: tuple[Group, ...] = get_args(Group)
Floats = NDArray[np.float32]
Source = tuple[Any, Callable[[], Floats]]
"""Index into a tensor, and the function that reads those numbers from the simulation."""
_MOVED_TOLERANCE = 1e-4
"""Tolerance in metres and radians, and in m/s and rad/s. PhysX rounds an articulation's root pose by about
1e-7 when it is set."""


class Mirror:
    """K rows of a tensor (R, W), or some of their columns, with the simulation's last known values."""

    def __init__(
        self,
        group: Group,
        what: str,
        whole: tuple[Floats, Floats],
        names: list[str],
        envs: NDArray[np.int64],
        rows: NDArray[np.int64] | None = None,
        columns: slice = slice(None),
        sources: Sequence[Source] = (),
        owners: Sequence[Any] = (),
        put: Callable[[Any, Floats, NDArray[np.bool_]], None] = lambda owner, row, differs: None,
    ) -> None:
        """
        Args:
            what: name of the values in messages.
            whole: (R, W) the tensor, and the last known values of the simulation.
            names, envs: (R,) body name and env of each row.
            rows: (K,) rows of this mirror; None for all.
            sources: what a fetch reads; `behind` compares the tensor with the first source.
            owners: (K,) SAPIEN's objects, for `put`.
            put: called with an owner, its row (W,) and a mask of the numbers to set.
        """
        self.group: Group = group
        self.what, self.envs = what, envs
        self.names = names
        self.now, self.seen = whole
        self.rows = np.arange(len(self.now)) if rows is None else rows
        self.at: Any = columns if rows is None else (rows, columns)
        self.sources, self._owners, self._put = sources, owners, put
        self.sound: Callable[[int], bool] = lambda env: True
        """Function that returns whether all known state of an env is finite."""

    def differs(self) -> NDArray[np.bool_]:
        """(K, W) True where a number was written and neither applied nor overwritten by a fetch."""
        return differ(self.now[self.at], self.seen[self.at])

    def changed(self) -> NDArray[np.int64]:
        """Indices, among the K rows, of the rows with a number that `differs`."""
        return np.flatnonzero(self.differs().any(axis=1))

    def fetch(self) -> None:
        """Read the simulation's values."""
        for at, read in self.sources:
            self.now[at] = self.seen[at] = read()

    def refresh(self) -> None:
        """Read the simulation's values; keeps numbers that were written and not applied."""
        for at, read in self.sources:
            written = differ(self.now[at], self.seen[at])
            self.seen[at] = read()
            self.now[at] = np.where(written, self.now[at], self.seen[at])

    def drop(self) -> None:
        """Discard numbers that were written and not applied."""
        self.now[self.at] = self.seen[self.at]

    def behind(self) -> NDArray[np.bool_]:
        """(K, W), or fewer columns: True where the simulation moved since the last fetch."""
        at, read = self.sources[0]
        return np.abs(self.now[at] - read()) > _MOVED_TOLERANCE

    def apply(self) -> None:
        """Write the numbers that differ to the simulation.

        Raises:
            ValueError: raised by `may_write`.
        """
        now, seen, differs = self.now[self.at], self.seen[self.at], self.differs()
        for i in np.flatnonzero(differs.any(axis=1)).tolist():
            if self.may_write(now[i][differs[i]], int(self.rows[i])):
                self._put(self._owners[i], now[i], differs[i])
            else:
                now[i] = seen[i]
        self.seen[self.at] = self.now[self.at] = now

    def may_write(self, values: Floats, row: int) -> bool:
        """Whether to write these numbers of a row to the simulation.

        PhysX does not check them: a NaN pose spreads to every body that it touches and may crash the process.
        If the env's state already contains a NaN, all numbers computed from it are NaN: such numbers are
        skipped until a reset repairs the env.

        Raises:
            ValueError: a number is NaN or infinite, and all known state of the env is finite. Writes that
                were not applied are discarded; otherwise every later apply would raise again.
        """
        if np.isfinite(values).all():
            return True
        env = int(self.envs[row])
        if self.sound(env):
            self.drop()
            raise RefusedValue(
                f"{self.names[row]} of env {env}: the state to be set contains NaN or infinity: {values}"
            )
        return False


def differ(a: Floats, b: Floats) -> NDArray[np.bool_]:
    """Mask of the numbers in which two arrays differ; NaN equals NaN, which the simulation itself may hold."""
    differs = a != b
    if differs.any():
        differs &= ~(np.isnan(a) & np.isnan(b))
    return differs


class DriveTargets(Mirror):
    """Position or velocity targets of the joints of every articulation.

    Setting a target wakes a sleeping articulation even if the value stays, and ManiSkill's CPU controllers
    set targets at every control step. So targets that were set since the last apply are written even if they
    have not changed; otherwise a robot at rest would fall asleep here but not in stock ManiSkill. For 64
    Pandas these are 1200 calls per control step, so the thread that steps an env makes them, just before the
    step.
    """

    def __init__(
        self,
        *mirror: Any,
        sources: Sequence[Source],
        setters: Sequence[Sequence[Callable[[float], None]]],
        later: Callable[[Callable[[int], None]], None],
    ) -> None:
        """
        Args:
            setters: for each articulation and active joint, the function that sets the target in PhysX.
            later: called with a function that writes the targets of one env; it must call that function
                before the env's next step.
        """
        super().__init__("targets", *mirror, sources=sources)
        self._set = np.zeros(len(self.now), dtype=bool)
        """(A,) whether targets were set since the last apply."""
        self.pending = False
        """Whether any targets were set since the last apply."""
        self._setters, self._later = setters, later
        self._of_env = {int(env): np.flatnonzero(self.envs == env).tolist() for env in np.unique(self.envs)}

    def note(self, rows: NDArray[np.int64]) -> None:
        """Note that these rows were set."""
        self._set[rows] = self.pending = True

    def drop(self) -> None:
        super().drop()
        self._set[:] = self.pending = False

    def apply(self) -> None:
        """Schedule a write of the targets that were set.

        Raises:
            ValueError: raised by `may_write`.
        """
        chosen = np.flatnonzero(self._set | self.differs().any(axis=1)).tolist()
        if not np.isfinite(self.now).all():
            kept = [i for i in chosen if self.may_write(self.now[i], i)]
            left = sorted(set(chosen).difference(kept))
            self.now[left], chosen = self.seen[left], kept
        self._set[:] = self.pending = False
        if not chosen:
            return
        self.seen[:] = self.now
        values, written = self.now.tolist(), set(chosen)

        def write(env: int) -> None:
            for i in self._of_env.get(env, ()):
                if i in written:
                    for set_target, value in zip(self._setters[i], values[i], strict=False):
                        set_target(value)

        self._later(write)


class Mirrors:
    """The mirrors of all tensors of a scene."""

    def __init__(
        self,
        layout: StateLayout,
        pack: Callable[[], Floats],
        link_poses: Callable[[], Floats],
        setter: Callable[[Any, str], Callable[[float], None]],
        later: Callable[[Callable[[int], None]], None],
    ) -> None:
        """
        Args:
            pack: returns the present packs of all envs, then a zero; see `StateLayout`.
            link_poses: returns the poses (L, 7) of all links.
            setter: returns SAPIEN's method of this name that sets a drive target of a joint.
            later: see `DriveTargets`.
        """
        data, joints = _twin((len(layout.entities), BODY)), layout.qpos_at.shape
        rigid = data, layout.names, layout.env_of_row
        jointed = layout.articulation_names, layout.env_of_row[layout.root_rows]
        roots, robots = layout.root_rows, layout.articulations
        poses, velocities = slice(0, 7), slice(7, None)
        root_in_links = np.searchsorted(layout.link_rows, roots)

        def packed(at: NDArray[np.int64], where: Any = slice(None)) -> tuple[Source]:
            return ((where, lambda: pack()[at]),)

        def of_joints(group: Group, what: str, sources: Sequence[Source], put: str) -> Mirror:
            def put_row(articulation: Any, row: Floats, differs: Any) -> None:
                getattr(articulation, put)(row[: articulation.dof])

            return Mirror(group, what, _twin(joints), *jointed, sources=sources, owners=robots, put=put_row)

        def of_targets(what: str, at: NDArray[np.int64], put: str) -> DriveTargets:
            setters = [[setter(joint, put) for joint in robot.active_joints] for robot in robots]
            return DriveTargets(
                what, _twin(joints), *jointed, sources=packed(at), setters=setters, later=later
            )

        bodies = layout.body_rows, slice(None), packed(layout.body_at, layout.body_rows)
        self.bodies = Mirror("bodies", "state", *rigid, *bodies, layout.bodies, _put_body)
        of_roots = (((roots, poses), lambda: link_poses()[root_in_links]),)
        self.roots = Mirror("links", "state", *rigid, roots, poses, of_roots, robots, _put_root_pose)
        moving = packed(layout.root_at[:, 7:], (roots, velocities))
        self.root_velocities = Mirror(
            "links", "state", *rigid, roots, velocities, moving, robots, _put_root_velocity
        )
        links = ((layout.link_rows, poses), link_poses), *moving
        self.links = Mirror("links", "state", *rigid, layout.link_rows, sources=links)
        self.qpos = of_joints("joints", "qpos", packed(layout.qpos_at), "set_qpos")
        self.qvel = of_joints("joints", "qvel", packed(layout.qvel_at), "set_qvel")
        self.qf = of_joints("forces", "joint forces (qf)", (), "set_qf")
        self.targets = of_targets("drive targets", layout.target_qpos_at, "set_drive_target")
        self.velocity_targets = of_targets(
            "drive velocity targets", layout.target_qvel_at, "set_drive_velocity_target"
        )
        self.all: tuple[Mirror, ...] = (
            *(self.bodies, self.links, self.qpos, self.qvel, self.qf),
            *(self.targets, self.velocity_targets),
        )
        """Mirrors that together contain each number once; `links` includes `roots` and `root_velocities`."""
        self.of = {group: [mirror for mirror in self.all if mirror.group == group] for group in GROUPS}
        """Mirrors of each group."""
        for mirror in (*self.all, self.roots, self.root_velocities):
            mirror.sound = self._is_sound

    def _is_sound(self, env: int) -> bool:
        held = ((each.seen, each.envs) for each in (self.bodies, self.qpos, self.qvel))
        return all(np.isfinite(seen[envs == env]).all() for seen, envs in held)


def _twin(shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    return np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)


def _put_body(body: Any, row: Floats, differs: NDArray[np.bool_]) -> None:
    if differs[:7].any():
        body.entity.pose = pose_of_row(row)
    if differs[7:].any() and not body.kinematic:
        body.linear_velocity = row[7:10]
        body.angular_velocity = row[10:13]


def _put_root_pose(articulation: Any, row: Floats, differs: NDArray[np.bool_]) -> None:
    articulation.links[0].pose = pose_of_row(row)


def _put_root_velocity(articulation: Any, row: Floats, differs: NDArray[np.bool_]) -> None:
    articulation.set_root_linear_velocity(row[:3])
    articulation.set_root_angular_velocity(row[3:])


def pose_of_row(row: Floats) -> sapien.Pose:
    return sapien.Pose(row[:3], row[3:7])  # type: ignore[arg-type]  # the stubs want a literal shape

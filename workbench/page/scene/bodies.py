"""Draws the bodies of the envs in the 3-D view: built once per scene, moved once per frame."""

from __future__ import annotations

import time
from collections.abc import Hashable
from dataclasses import dataclass
from functools import partial

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.envs.scene.mesh_levels import from_afar
from workbench.envs.scene.shapes import SceneGeometry, fingerprint
from workbench.envs.scene.simplify import reduce_mesh
from workbench.page.scene.env_grid import EnvLayout, InView, place_of_plane, plane_normal
from workbench.page.scene.glb import VisualGroup, as_glb, face_limit, group_visuals, lightened
from workbench.page.scene.visible_motion import Eye, SentPoses, eyes_of
from workbench.page.widgets.parts import Clock

NAMES = ("/envs", "/floor")
"""Roots of the nodes in viser's tree."""
REMOVAL_DELAY_SECONDS = 0.7
"""Time for which old shapes stay when finer or coarser ones replace them. Without this delay the view would
be empty until the page has read the new shapes."""


@dataclass(frozen=True)
class DrawStyle:
    """Drawing style of a scene."""

    triangles: int = 200_000
    """Approximate maximum number of triangles; shapes with many triangles are simplified to fit."""
    dark: bool = True
    """Whether the page's theme is dark; the light theme lightens a dark floor."""
    error: float = 0.0
    """Simplification tolerance of shapes in metres."""


class SceneView:
    """The batched nodes of one scene under ``/envs``.

    One viser node per body is too slow in a browser from a hundred bodies on (measured: 1 frame a second at
    3,840); one batched node per shape is not (30 a second). In each frame a node gets two arrays: world
    positions (those in the envs' frames plus the envs' grid offsets) and quaternions. World poses, not parent
    frames: viser's batches bypass its scene graph, and a parent that moves in the same frame makes the
    batches shake.

    If one env is shown, only that env is sent: a batch's arrays may change their length. Bodies that an env
    lacks (NaN) are left out the same way. The number of triangles limits a browser, so the shapes are finer
    when fewer envs are shown. Motion below a pixel is not sent (`visible_motion`).
    """

    def __init__(self, server: viser.ViserServer, clock: Clock = time.monotonic) -> None:
        self._server, self._clock = server, clock
        self._rows: _Rows | None = None
        self._drawn: dict[tuple[Hashable, ...], _DrawnGroup] = {}
        self._geometry: SceneGeometry | None = None
        self._leaving: list[_DrawnGroup] = []
        self._leave_at = 0.0
        self._number = 0
        look = {"cell_size": 0.5, "section_size": 1.0}
        colours = {"cell_color": (150, 150, 150), "section_color": (120, 120, 120)}
        add = partial(server.scene.add_grid, "/floor", **look, **colours)
        self._grid = InView(add, "width", "height", "position")

    def build(
        self,
        geometry: SceneGeometry,
        layout: EnvLayout,
        poses: NDArray[np.float32],
        only_env: int | None = None,
        looks: DrawStyle = DrawStyle(),
    ) -> None:
        """Show this scene instead of the previous one; groups that look the same as before stay, and are not
        sent again.

        Args:
            geometry: Geometry of the scene.
            layout: The grid of the envs.
            poses: (N, B, 7) in env frames.
            only_env: Show this env alone; None shows all.
            looks: Style of the drawing.
        """
        shown_envs = geometry.num_envs if only_env is None else 1
        limit = face_limit(geometry.visuals, shown_envs, geometry.num_envs, looks.triangles)
        self._remove_leaving()
        before, self._drawn, self._rows = self._drawn, {}, None
        for group in group_visuals(geometry):
            shape = fingerprint(group.visuals)
            first = group.visuals[0]
            normals = [plane_normal(visual, geometry, poses) for visual in group.visuals]
            once = None if normals[0] is None else place_of_plane(normals[0], first, poses, layout)
            if any(normal is None for normal in normals):
                once = None
            lighter = once is not None and not looks.dark
            drawn_as = _DrawnAs(limit, looks.error if _is_simpler(group, looks.error) else 0.0, lighter)
            key = (shape, drawn_as, sum(shape == known for known, *_ in self._drawn))
            drawn = before.pop(key, None)
            if drawn is None:
                self._number += 1
                drawn = _DrawnGroup(self._server, self._number, group, drawn_as)
            drawn.set_instances(group, once)
            self._drawn[key] = drawn
        same = geometry is self._geometry
        for drawn in before.values():
            # Two floors of different brightness in one place would flicker.
            if same and not drawn.is_plane:
                self._leaving.append(drawn)
            else:
                drawn.handle.remove()
        self._geometry, self._leave_at = geometry, self._clock() + REMOVAL_DELAY_SECONDS
        if layout.has_floor:
            self._grid.draw()
        else:
            low, high = layout.box_of_all()
            wide, deep = float(high[0] - low[0]) + 4.0, float(high[1] - low[1]) + 4.0
            self._grid.draw(wide, deep, (0.0, 0.0, layout.floor_height))
        self.move(poses, layout, only_env)

    def move(self, poses: NDArray[np.float32], layout: EnvLayout, only_env: int | None) -> None:
        """Move every body to its pose. Call it also while nothing moves, so that bodies at rest get their exact poses.

        Args:
            poses: (N, B, 7) in env frames.
            layout: The grid of the envs.
            only_env: Show this env alone, at the origin; None shows all, on the grid.
        """
        if self._leaving and self._clock() >= self._leave_at:
            self._remove_leaving()
        if self._rows is None or not self._rows.is_for(layout, only_env):
            self._rows = _Rows((*self._drawn.values(), *self._leaving), layout, only_env)
        self._rows.move(poses, eyes_of(self._server), self._clock())

    def _remove_leaving(self) -> None:
        for group in self._leaving:
            group.handle.remove()
        if self._leaving:
            self._leaving, self._rows = [], None

    def hide(self) -> None:
        """Hide all bodies until the next `build`. They stay in the browser, so `build` does not send again those that
        look the same."""
        if self._rows is not None:
            self._remove_leaving()
            self._rows = None
            for group in self._drawn.values():
                group.handle.visible = False

    def clear(self) -> None:
        self._remove_leaving()
        for group in self._drawn.values():
            group.handle.remove()
        self._drawn.clear()
        self._rows = None
        self._grid.draw()

    @property
    def handles(self) -> tuple[viser.BatchedGlbHandle, ...]:
        return tuple(group.handle for group in self._drawn.values())


def _is_simpler(group: VisualGroup, error: float) -> bool:
    return any(len(from_afar(visual.mesh, error).faces) < len(visual.mesh.faces) for visual in group.visuals)


@dataclass(frozen=True)
class _DrawnAs:
    limit: int
    """Maximum number of triangles of a visual."""
    error: float
    """Simplification tolerance in metres."""
    lighter: bool
    """Whether dark materials are lightened (a floor in the light theme)."""


class _DrawnGroup:
    def __init__(
        self, server: viser.ViserServer, number: int, group: VisualGroup, drawn_as: _DrawnAs
    ) -> None:
        parts = [
            (reduce_mesh(from_afar(visual.mesh, drawn_as.error), drawn_as.limit), visual.material)
            for visual in group.visuals
        ]
        if drawn_as.lighter:
            parts = [(mesh, lightened(material)) for mesh, material in parts]
        glb = as_glb(parts)
        # Begin with one instance far below the ground; the first call of `draw` follows in the same batch.
        self.handle = server.scene.add_batched_glb(
            f"/envs/{number:03d} {group.name.replace('/', ' ')}",
            glb,
            batched_wxyzs=np.array([[1, 0, 0, 0]], np.float32),
            batched_positions=np.array([[0, 0, -1000]], np.float32),
            # Off: viser's levels of detail leave holes in open meshes and switch visibly.
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        self.set_instances(group, None)

    def set_instances(self, group: VisualGroup, once: NDArray[np.float32] | None) -> None:
        """Set the (env, body) pairs for which the group is drawn; a floor or wall is drawn once, offset by `once` (3,)."""
        self._group, self._once = group, once
        corners = [np.abs(visual.mesh.vertices).max(axis=0) for visual in group.visuals]
        self.reach = float(max(np.linalg.norm(corner) for corner in corners))
        """Radius in metres of a sphere around the body's frame that contains the group."""

    @property
    def is_plane(self) -> bool:
        return self._once is not None

    def rows(
        self, layout: EnvLayout, only_env: int | None
    ) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
        """Envs (K,) and bodies (K,) of the drawn instances, and offsets of their positions (K, 3)."""
        envs, bodies = self._group.envs, self._group.bodies
        if self._once is not None:
            envs, bodies = envs[:1], bodies[:1]
            return envs, bodies, self._once[None] if only_env is None else np.zeros((1, 3), np.float32)
        if only_env is None:
            return envs, bodies, layout.offsets[envs]
        mine = envs == only_env
        return envs[mine], bodies[mine], np.zeros((int(mine.sum()), 3), np.float32)

    def draw(self, instances: NDArray[np.float32]) -> None:
        """Draw the group at these poses (K, 7); rows of absent bodies are NaN."""
        there = np.isfinite(instances).all(axis=1)
        if not there.all():
            instances = instances[there]
        self.handle.visible = bool(len(instances))
        if len(instances):
            # Equal arrays are not sent again (viser compares), so bodies at rest cost no bytes.
            self.handle.batched_positions = np.ascontiguousarray(instances[:, :3])
            self.handle.batched_wxyzs = np.ascontiguousarray(instances[:, 3:])


class _Rows:
    """All instances of all groups in one array, since a NumPy call costs more than its work on one group."""

    def __init__(self, groups: tuple[_DrawnGroup, ...], layout: EnvLayout, only_env: int | None) -> None:
        self._layout, self._only_env = layout, only_env
        parts = [group.rows(layout, only_env) for group in groups]
        ends = np.cumsum([0, *(len(envs) for envs, _, _ in parts)])
        self._groups = [(group, slice(a, b)) for group, a, b in zip(groups, ends[:-1], ends[1:], strict=True)]
        nothing = np.zeros(0, np.int32)
        self._envs = np.concatenate([nothing, *(envs for envs, _, _ in parts)])
        self._bodies = np.concatenate([nothing, *(bodies for _, bodies, _ in parts)])
        self._offsets = np.concatenate([np.zeros((0, 3), np.float32), *(offset for _, _, offset in parts)])
        self._sent = SentPoses(np.repeat([np.float32(group.reach) for group in groups], np.diff(ends)))

    def is_for(self, layout: EnvLayout, only_env: int | None) -> bool:
        return self._layout is layout and self._only_env == only_env

    def move(self, poses: NDArray[np.float32], eyes: tuple[Eye, ...], now: float) -> None:
        instances = poses[self._envs, self._bodies]
        instances[:, :3] += self._offsets
        sent, changed = self._sent.update(instances, eyes, now)
        for group, rows in self._groups:
            if changed[rows].any() or rows.start == rows.stop:
                group.draw(sent[rows])

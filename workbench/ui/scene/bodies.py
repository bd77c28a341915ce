"""Draws the bodies of the envs in the 3-D view: built once a scene, moved once a frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.core.scene.shapes import SceneGeometry, fingerprint
from workbench.core.scene.simplify import reduce_mesh
from workbench.ui.scene.env_grid import EnvLayout, InView, place_of_plane, plane_normal
from workbench.ui.scene.glb import VisualGroup, as_glb, face_limit, group_visuals, lightened

NAMES = ("/envs", "/floor")
"""Roots of its nodes in viser's tree."""


@dataclass(frozen=True)
class Looks:
    """How a scene is drawn."""

    triangles: int = 200_000
    """Approximate limit; rich shapes are simplified to fit."""
    dark: bool = True
    """The page's theme: in the light one a dark floor is lighter than the task's."""


class SceneView:
    """The batched nodes of one scene under ``/envs``.

    One viser node a body is too slow in a browser from a hundred bodies on (measured: 1 frame a second at 3,840), one
    batched node a shape is not (30 a second). A frame is two arrays a node: world positions and quaternions, each env's
    own pose plus its grid offset. World poses, not parent frames: viser's batches bypass its scene graph, and a parent
    that moves in the same frame makes them shake.

    Showing one env sends one env: a batch's arrays may change their length. Bodies that an env lacks (NaN) are left out
    the same way. Triangles limit a browser, so fewer envs are drawn with finer shapes.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._drawn: dict[tuple[str, int, bool, int], _DrawnGroup] = {}
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
        looks: Looks = Looks(),
    ) -> None:
        """Show this scene instead of the last; groups that look the same stay and are not sent again.

        Args:
            geometry: Of the scene.
            layout: The grid of the envs.
            poses: (N, B, 7) in env frames.
            only_env: Show this env alone; None shows all.
            looks: How it is drawn.
        """
        shown_envs = geometry.num_envs if only_env is None else 1
        limit = face_limit(geometry.visuals, shown_envs, geometry.num_envs, looks.triangles)
        before, self._drawn = self._drawn, {}
        for group in group_visuals(geometry):
            shape = fingerprint(group.visuals)
            first = group.visuals[0]
            normals = [plane_normal(visual, geometry, poses) for visual in group.visuals]
            once = None if normals[0] is None else place_of_plane(normals[0], first, poses, layout)
            if any(normal is None for normal in normals):
                once = None
            lighter = once is not None and not looks.dark
            key = (shape, limit, lighter, sum(shape == known for known, *_ in self._drawn))
            drawn = before.pop(key, None)
            if drawn is None:
                self._number += 1
                drawn = _DrawnGroup(self._server, self._number, group, limit, lighter)
            drawn.set_instances(group, once)
            self._drawn[key] = drawn
        for drawn in before.values():
            drawn.handle.remove()
        if layout.has_floor:
            self._grid.draw()
        else:
            low, high = layout.box_of_all()
            wide, deep = float(high[0] - low[0]) + 4.0, float(high[1] - low[1]) + 4.0
            self._grid.draw(wide, deep, (0.0, 0.0, layout.floor_height))
        self.move(poses, layout, only_env)

    def move(self, poses: NDArray[np.float32], layout: EnvLayout, only_env: int | None) -> None:
        """Move every body to its pose.

        Args:
            poses: (N, B, 7) in env frames.
            layout: The grid of the envs.
            only_env: Show this env alone, at the origin; None shows all, on the grid.
        """
        for group in self._drawn.values():
            group.move(poses, layout, only_env)

    def clear(self) -> None:
        for group in self._drawn.values():
            group.handle.remove()
        self._drawn.clear()
        self._grid.draw()

    @property
    def handles(self) -> tuple[viser.BatchedGlbHandle, ...]:
        return tuple(group.handle for group in self._drawn.values())


class _DrawnGroup:
    def __init__(
        self, server: viser.ViserServer, number: int, group: VisualGroup, limit: int, lighter: bool
    ) -> None:
        parts = [(reduce_mesh(visual.mesh, limit), visual.material) for visual in group.visuals]
        glb = as_glb([(mesh, lightened(material)) for mesh, material in parts] if lighter else parts)
        # One instance far below the ground; the first move follows in the same batch.
        self.handle = server.scene.add_batched_glb(
            f"/envs/{number:03d} {group.name.replace('/', ' ')}",
            glb,
            batched_wxyzs=np.array([[1, 0, 0, 0]], np.float32),
            batched_positions=np.array([[0, 0, -1000]], np.float32),
            # viser's levels of detail leave holes in open meshes and switch visibly.
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        self.set_instances(group, None)

    def set_instances(self, group: VisualGroup, once: NDArray[np.float32] | None) -> None:
        """Set the (env, body) pairs that it is drawn for; a floor or wall is drawn once, moved by `once` (3,)."""
        self._group, self._once = group, once

    def move(self, poses: NDArray[np.float32], layout: EnvLayout, only_env: int | None) -> None:
        envs, bodies = self._group.envs, self._group.bodies
        if self._once is not None:
            envs, bodies = envs[:1], bodies[:1]
            instances = poses[envs, bodies]
            positions = instances[:, :3] + (self._once if only_env is None else 0)
        elif only_env is None:
            instances = poses[envs, bodies]
            positions = instances[:, :3] + layout.offsets[envs]
        else:
            mine = envs == only_env
            instances = poses[envs[mine], bodies[mine]]
            positions = instances[:, :3]
        there = np.isfinite(instances).all(axis=1)
        if not there.all():
            instances, positions = instances[there], positions[there]
        self.handle.visible = bool(len(positions))
        if len(positions):
            # Equal arrays are not sent again (viser compares), so bodies at rest cost no bytes.
            self.handle.batched_positions = np.ascontiguousarray(positions)
            self.handle.batched_wxyzs = np.ascontiguousarray(instances[:, 3:])

"""The body under a click in the 3-D view, and the mark of the selected body."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray
from viser.transforms import SO3

from workbench.envs.scene.shapes import Mesh, SceneGeometry
from workbench.page.scene.env_grid import COLOUR, box_corners, line_set, plane_normal, view_label

_EDGES = np.array([(i, i | bit) for bit in (1, 2, 4) for i in range(8) if not i & bit])
"""(12, 2) corners of a box (as `box_corners` numbers them) at the ends of each edge."""


def body_under_ray(
    geometry: SceneGeometry, poses: NDArray[np.float32], env: int, origin: NDArray, direction: NDArray
) -> int | None:
    """Index of the body of this env whose surface a ray hits first; None if it hits a floor or backdrop first, or nothing.

    Args:
        poses: (N, B, 7) as in `SceneGeometry`.
        origin: (3,) in the env's own frame, metres.
        direction: (3,) in the env's own frame, of any length.
    """
    nearest, found = np.inf, None
    if not (np.isfinite(origin).all() and np.isfinite(direction).all()):
        return None
    for visual in geometry.visuals:
        if not len(visual.mesh.faces):
            continue
        for body in visual.bodies[visual.envs == env].tolist():
            pose = poses[env, body].astype(np.float64)
            if not np.isfinite(pose).all():
                continue
            back = SO3(pose[3:]).inverse()
            at = _first_hit(visual.mesh, back.apply(origin - pose[:3]), back.apply(direction), nearest)
            if at < nearest:
                nearest, found = at, None if plane_normal(visual, geometry, poses) is not None else body
    return found


def _first_hit(mesh: Mesh, origin: NDArray, direction: NDArray, most: float) -> float:
    """Where a ray first hits a triangle, in lengths of `direction`; infinite if it hits none before `most`.

    Möller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection (1997), for all triangles at once.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)]) - origin) / direction
        if np.nanmax(ends.min(axis=0)) > min(np.nanmin(ends.max(axis=0)), most):
            return np.inf
        first, second, third = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
        along, across = second - first, third - first
        normal = np.cross(direction, across)
        size = np.einsum("ij,ij->i", along, normal)
        away = origin - first
        u = np.einsum("ij,ij->i", away, normal) / size
        turned = np.cross(away, along)
        v = turned @ direction / size
        at = np.einsum("ij,ij->i", across, turned) / size
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (at > 0)
    return float(at[hit].min(initial=np.inf))


def box_of_body(geometry: SceneGeometry, env: int, body: int) -> NDArray[np.float32] | None:
    """(2, 3) lowest and highest corner of a body of this env in the body's frame; None if nothing of it is visible."""
    meshes = [
        visual.mesh.vertices
        for visual in geometry.visuals
        if len(visual.mesh.vertices) and ((visual.envs == env) & (visual.bodies == body)).any()
    ]
    if not meshes:
        return None
    points = np.concatenate(meshes)
    return np.stack([points.min(axis=0), points.max(axis=0)])


HOVER_COLOUR = (255, 196, 61)


class BodyMark:
    """The mark of a body: the edges of its box, and its name.

    Args:
        name: name of the mark's nodes in the view.
        colour: RGB of the edges.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str = "/selected_body",
        colour: tuple[int, int, int] = COLOUR,
    ) -> None:
        self._edges = line_set(server, f"{name}/box", colour, 2.5)
        self._label = view_label(server, f"{name}/label", "bottom-left")
        self._box_of: tuple[SceneGeometry, int, int] | None = None
        self._box: NDArray[np.float32] | None = None

    def draw(
        self, geometry: SceneGeometry, poses: NDArray[np.float32], env: int, name: str, offset: NDArray
    ) -> None:
        """Mark the body with this name, or no body if the env lacks it.

        Args:
            poses: (N, B, 7) as in `SceneGeometry`.
            offset: (3,) position of the env in the view, metres.
        """
        body = geometry.body_names.index(name) if name in geometry.body_names else -1
        pose = poses[env, body].astype(np.float64)
        if (of := (geometry, env, body)) != self._box_of:
            self._box_of, self._box = of, None if body < 0 else box_of_body(geometry, env, body)
        if body < 0 or self._box is None or not np.isfinite(pose).all():
            self.clear()
            return
        corners = SO3(pose[3:]).apply(box_corners(*self._box)) + pose[:3] + offset
        self._edges.draw(corners[_EDGES].astype(np.float32))
        self._label.draw(name, corners[corners[:, 2].argmax()])

    def clear(self) -> None:
        """Mark no body."""
        self._edges.draw()
        self._label.draw()

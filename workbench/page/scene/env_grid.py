"""The grid of envs in the 3-D view: offset of each env, the env under a ray, and the mark of the selected env."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray
from viser.transforms import SO3

from workbench.envs.scene.shapes import SceneGeometry, Visual

MIN_FLOOR_METRES = 8.0
"""Minimum width of a floor: a flat static body wider than this in both directions is a floor. ManiSkill's ground is 40 to
100 m wide, the largest table 2.4 m."""
MAX_FLOOR_THICKNESS_METRES = 0.05
MIN_FLOOR_UP = 0.9
"""Minimum upward component of a floor's normal; below it a plane is a wall."""
WIDTH_TO_DEPTH = 1.4
"""Ratio of width to depth of the grid: a view is wider than tall, and depth is foreshortened."""
MARGIN_METRES = 0.35
"""Distance between two envs at rest; a robot that reaches out needs some of it."""
ACTING_MARGIN_METRES = np.float32(0.08)
"""Margin around the frames of links and bodies."""


@dataclass(frozen=True, eq=False)
class EnvLayout:
    """The bounding box of one env and the offset of each env, in metres, z up. Compared by identity.

    All envs are at the origin of their own frames. A pose in the page is the env's own pose plus its offset on a grid. The
    grid's spacing comes from the contents of one env (table and robot, without floor or backdrop). Floors are wide enough
    for the whole grid and drawn once: sixteen overlapping floors would flicker and cost sixteen times the triangles.
    """

    offsets: NDArray[np.float32]
    """(N, 3) offset added to an env's own coordinates."""
    low: NDArray[np.float32]
    """(3,) lowest corner of one env's contents without the floor, in the env's frame."""
    high: NDArray[np.float32]
    """(3,) highest corner of one env's contents without the floor, in the env's frame."""
    floor_height: float
    """Height (z) of the floor; without a floor, of the env's lowest point."""
    has_floor: bool

    def box_of_all(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Lowest and highest corner of the whole grid."""
        return self.low + self.offsets.min(axis=0), self.high + self.offsets.max(axis=0)


def box_corners(low: ArrayLike, high: ArrayLike) -> NDArray:
    """(8, 3) corners of a box; the bits of a corner's index pick the low or high end of x, y and z."""
    picks = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
    return np.where(picks == 0, low, high)


def plane_normal(visual: Visual, geometry: SceneGeometry, poses: NDArray) -> NDArray[np.floating] | None:
    """The normal (3,), in the env's frame, of a flat, very wide body that is static or kinematic (floor or
    backdrop); None for any other body."""
    if any(geometry.body_kinds[b] not in ("static", "kinematic") for b in np.unique(visual.bodies)):
        return None
    extent = np.ptp(visual.mesh.vertices, axis=0)
    thin = int(extent.argmin())
    if extent[thin] > MAX_FLOOR_THICKNESS_METRES or np.sort(extent)[1] < MIN_FLOOR_METRES:
        return None
    pose = poses[visual.envs[0], visual.bodies[0]].astype(np.float64)
    return SO3(pose[3:]).apply(np.eye(3)[thin]) if np.isfinite(pose).all() else None


def place_of_plane(normal: NDArray, visual: Visual, poses: NDArray, layout: EnvLayout) -> NDArray[np.float32]:
    """(3,) offset of a plane drawn once for the whole grid.

    A floor lies under the middle; a wall is moved behind the last env on its side, so that it does not cut
    through the envs.
    """
    normal = np.asarray(normal, np.float64)
    if abs(normal[2]) > MIN_FLOOR_UP:
        return np.zeros(3, np.float32)
    point = poses[visual.envs[0], visual.bodies[0], :3]
    outwards = normal if (point - (layout.low + layout.high) / 2) @ normal >= 0 else -normal
    return (outwards * (layout.offsets @ outwards).max()).astype(np.float32)


def lay_out(geometry: SceneGeometry, poses: NDArray[np.float32]) -> EnvLayout:
    """The grid for these envs.

    Args:
        geometry: The scene.
        poses: (N, B, 7), normally right after a reset; rows of absent bodies are NaN.
    """
    lows, highs = [np.zeros((0, 3))], [np.zeros((0, 3))]
    floors = []
    for visual in geometry.visuals:
        if not len(visual.mesh.vertices):
            continue
        corners = _corners_in_env(visual, poses)
        if not len(corners):
            continue
        normal = plane_normal(visual, geometry, poses)
        if normal is not None:
            if abs(normal[2]) > MIN_FLOOR_UP:
                floors.append(float(corners[..., 2].max()))
        else:
            lows.append(corners.min(axis=1))
            highs.append(corners.max(axis=1))
    low, high = np.concatenate(lows), np.concatenate(highs)
    if len(low):
        low, high = low.min(axis=0), high.max(axis=0)
    else:
        low, high = np.full(3, -0.5), np.full(3, 0.5)
    floor = max(floors) if floors else float(low[2])
    return EnvLayout(
        offsets=grid_offsets(geometry.num_envs, high[:2] - low[:2] + MARGIN_METRES),
        low=low.astype(np.float32),
        high=high.astype(np.float32),
        floor_height=floor,
        has_floor=bool(floors),
    )


def acting_box(
    geometry: SceneGeometry, poses: NDArray[np.float32], layout: EnvLayout
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lowest and highest corner, in the env's frame, of robots and movable bodies.

    Static and kinematic bodies are left out, and positions are clipped to the env's box. Without robots and
    movable bodies, returns the env's box.

    Args:
        poses: (K, B, 7) of one env at K moments, or of K envs.
    """
    acting = [row for row, kind in enumerate(geometry.body_kinds) if kind in ("link", "dynamic")]
    places = poses[:, acting, :3].reshape(-1, 3)
    places = places[np.isfinite(places).all(axis=1)]
    places = np.clip(places, layout.low, layout.high)
    if not len(places):
        return layout.low, layout.high
    # The positions are origins of frames; bodies extend beyond them.
    return places.min(axis=0) - ACTING_MARGIN_METRES, places.max(axis=0) + ACTING_MARGIN_METRES


def grid_offsets(num_envs: int, spacing: NDArray) -> NDArray[np.float32]:
    """(N, 3) offsets of a grid around the origin, env 0 in front on the left as seen from +x.

    Rows run along y and are filled from +x (nearest to the initial viewpoint) backwards. Their number makes the grid about
    `WIDTH_TO_DEPTH` times as wide as deep.
    """
    width, depth = float(spacing[1]), float(spacing[0])
    columns = max(1, min(num_envs, round((num_envs * WIDTH_TO_DEPTH * depth / width) ** 0.5)))
    rows = -(-num_envs // columns)
    row, column = np.divmod(np.arange(num_envs), columns)
    x = ((rows - 1) / 2 - row) * depth
    y = (column - (columns - 1) / 2) * width
    return np.stack([x, y, np.zeros(num_envs)], axis=1).astype(np.float32)


def env_under_ray(layout: EnvLayout, origin: NDArray, direction: NDArray) -> int | None:
    """The env whose box a ray hits first, or None.

    A slab test with one box per env; clickable meshes would make the browser rebuild a search tree over all triangles in
    every frame.
    """
    origin, direction = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    if not (np.isfinite(origin).all() and np.isfinite(direction).all()):
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        near = (layout.low + layout.offsets - origin) / direction
        far = (layout.high + layout.offsets - origin) / direction
    enters = np.nanmax(np.minimum(near, far), axis=1)
    leaves = np.nanmin(np.maximum(near, far), axis=1)
    hit = (enters <= leaves) & (leaves >= 0)
    if not hit.any():
        return None
    return int(np.where(hit, enters, np.inf).argmin())


def _corners_in_env(visual: Visual, poses: NDArray) -> NDArray:
    """(K', 8, 3) corners of each instance's box in its env's frame, without absent instances."""
    low, high = visual.mesh.vertices.min(axis=0), visual.mesh.vertices.max(axis=0)
    corners = box_corners(low, high)
    instances = poses[visual.envs, visual.bodies].astype(np.float64)
    instances = instances[np.isfinite(instances).all(axis=1)]
    return SO3(instances[:, None, 3:]).apply(corners[None]) + instances[:, None, :3]


# --- Mark of the selected env: a frame and its number ------------------------------------------


COLOUR = (34, 139, 230)


class InView:
    """A node of the 3-D view that can be added, changed and removed.

    Args:
        add: viser's function that adds the node, called with the values of `names`.
        names: names of the properties that change.
    """

    def __init__(self, add: Callable[..., Any], *names: str) -> None:
        self._add, self._names = add, names
        self.handle: Any = None
        """Handle of viser's node while it is shown."""

    def draw(self, *values: Any) -> None:
        """Show the node with these values; without values, remove it."""
        if not values:
            if self.handle is not None:
                self.handle.remove()
            self.handle = None
        elif self.handle is None:
            self.handle = self._add(**dict(zip(self._names, values, strict=True)))
        else:
            for name, value in zip(self._names, values, strict=True):
                setattr(self.handle, name, value)


def line_set(
    server: viser.ViserServer | viser.ClientHandle, name: str, colour: tuple[int, int, int], thickness: float
) -> InView:
    """Line segments (K, 2, 3), in metres in the view, `thickness` pixels wide."""
    more = {"colors": colour, "thickness": thickness, "thickness_units": "screen"}
    return InView(partial(server.scene.add_line_segments, name, **more), "points")


def view_label(server: viser.ViserServer, name: str, anchor: Literal["top-center", "bottom-left"]) -> InView:
    """A text at a point (3,) of the view, in metres; `anchor` is the part of the text at that point."""
    return InView(partial(server.scene.add_label, name, anchor=anchor), "text", "position")


class SelectionMark:
    """The mark of the selected env: a frame around its bodies at table height, so that it covers nothing, and a label."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._frame = line_set(server, "/selected/frame", COLOUR, 3.0)
        self._label = view_label(server, "/selected/label", "top-center")
        self._drawn: tuple[EnvLayout, int, str] | None = None

    def draw(self, layout: EnvLayout, env: int, shown: bool, name: str | None = None) -> None:
        """Mark this env and label it with `name`, by default its number. Without `shown` (the env is alone in
        the view), remove the mark."""
        name = f"env {env}" if name is None else name
        if not shown:
            self.clear()
            return
        wanted = (layout, env, name)
        if wanted == self._drawn:
            return
        self._drawn = wanted
        offset = layout.offsets[env]
        corner_low = layout.low[:2] + offset[:2] - MARGIN_METRES * 0.4
        corner_high = layout.high[:2] + offset[:2] + MARGIN_METRES * 0.4
        (x0, y0), (x1, y1) = corner_low, corner_high
        # On the floor the tables in front would hide the frame, so it lies a centimetre above the table top (z = 0 in
        # ManiSkill); in the same plane the two would flicker.
        z = max(layout.floor_height, min(0.0, float(layout.high[2]))) + 0.01
        corners = np.array([(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)], np.float32)
        edges = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
        label_at = np.array([x1, (y0 + y1) / 2, z])
        self._frame.draw(edges)
        self._label.draw(name, label_at)

    def clear(self) -> None:
        self._drawn = None
        self._frame.draw()
        self._label.draw()

"""Where env i of the batch stands in the page's 3-D view.

Every env has its own world frame and all of them sit on top of each other at its origin; a person
wants to see them side by side. So each env is given an offset on a grid whose spacing comes from
what stands in one env (its table and robot, not its endless floor or backdrop), and a pose in the page is the
env's own pose plus that offset. Floors are wide enough for the whole grid and are drawn once:
sixteen overlapping floors would flicker where they meet and cost sixteen times the triangles.

Plain arrays and pure functions: nothing here knows of a browser.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from viser.transforms import SO3

from workbench.core.geometry import SceneGeometry, Visual

FLOOR_WIDTH = 8.0
"""Metres. A flat static thing wider than this in both directions is a floor: ManiSkill's ground is
40 to 100 m wide, the largest table 2.4 m."""
FLOOR_THICKNESS = 0.05
LEVEL = 0.9
"""Upward part of the normal from which on a plane is a floor and not a wall."""
WIDER = 1.4
"""A view is wider than it is tall, and depth is foreshortened in it."""
MARGIN = 0.35
"""Metres between two envs at rest; a robot that reaches out uses some of it."""
ACTING_MARGIN = np.float32(0.08)
"""Metres round the frames of robots' links and of things."""


@dataclass(frozen=True)
class EnvLayout:
    """One env's box and where each of them stands, in metres, z up."""

    offsets: NDArray[np.float32]
    """(N, 3) added to an env's own coordinates."""
    low: NDArray[np.float32]
    """(3,) lowest corner of what stands in one env, floor left out, in the env's frame."""
    high: NDArray[np.float32]
    """(3,)"""
    floor_height: float
    """z on which the envs stand: the floor's, or the lowest point of the env."""
    has_floor: bool

    def box_of_all(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Lowest and highest corner of the whole grid."""
        return self.low + self.offsets.min(axis=0), self.high + self.offsets.max(axis=0)


def box_corners(low: ArrayLike, high: ArrayLike) -> NDArray:
    """(8, 3) corners of a box; the bits of a corner's number say at which end of x, y and z it is."""
    picks = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
    return np.where(picks == 0, low, high)


def plane_normal(visual: Visual, geometry: SceneGeometry, poses: NDArray) -> NDArray[np.floating] | None:
    """The normal (3,), in the env's frame, of a flat, very wide thing that never moves; else None.

    Floors and the walls that tasks put up as a backdrop: they are wide enough for the whole grid.
    """
    if any(geometry.body_kinds[b] not in ("static", "kinematic") for b in np.unique(visual.bodies)):
        return None
    extent = np.ptp(visual.mesh.vertices, axis=0)
    thin = int(extent.argmin())
    if extent[thin] > FLOOR_THICKNESS or np.sort(extent)[1] < FLOOR_WIDTH:
        return None
    worn = poses[visual.envs[0], visual.bodies[0]].astype(np.float64)
    return SO3(worn[3:]).apply(np.eye(3)[thin]) if np.isfinite(worn).all() else None


def place_of_plane(normal: NDArray, visual: Visual, poses: NDArray, layout: EnvLayout) -> NDArray[np.float32]:
    """(3,) added to a plane that is drawn once, so that it serves the whole grid.

    A floor lies under the middle; a wall goes behind the last env on its side, or it would cut through
    the envs in between.
    """
    normal = np.asarray(normal, np.float64)
    if abs(normal[2]) > LEVEL:
        return np.zeros(3, np.float32)
    point = poses[visual.envs[0], visual.bodies[0], :3]
    outwards = normal if (point - (layout.low + layout.high) / 2) @ normal >= 0 else -normal
    return (outwards * (layout.offsets @ outwards).max()).astype(np.float32)


def lay_out(geometry: SceneGeometry, poses: NDArray[np.float32]) -> EnvLayout:
    """The grid for these envs.

    Args:
        geometry: The scene.
        poses: (N, B, 7) of a moment, normally right after a reset; rows of absent bodies are NaN.
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
            if abs(normal[2]) > LEVEL:
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
        offsets=grid_offsets(geometry.num_envs, high[:2] - low[:2] + MARGIN),
        low=low.astype(np.float32),
        high=high.astype(np.float32),
        floor_height=floor,
        has_floor=bool(floors),
    )


def acting_box(
    geometry: SceneGeometry, poses: NDArray[np.float32], layout: EnvLayout
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lowest and highest corner, in the env's frame, of what acts: robots, and bodies that can be moved.

    The table and the walls round them are left out, and so is what flies out of the env. All of the env where nothing
    acts.

    Args:
        poses: (K, B, 7): of one env at some moments, or of several envs.
    """
    acting = [row for row, kind in enumerate(geometry.body_kinds) if kind in ("link", "dynamic")]
    places = poses[:, acting, :3].reshape(-1, 3)
    places = places[np.isfinite(places).all(axis=1)]
    places = np.clip(places, layout.low, layout.high)
    if not len(places):
        return layout.low, layout.high
    # What is known is where their frames are, and they are larger than that.
    return places.min(axis=0) - ACTING_MARGIN, places.max(axis=0) + ACTING_MARGIN


def grid_offsets(num_envs: int, spacing: NDArray) -> NDArray[np.float32]:
    """(N, 3) offsets of a grid about the origin, env 0 in front on the left as seen from +x.

    Rows run along y and are filled from +x (nearest to where the camera starts) backwards. Their
    number is chosen so that the whole is `WIDER` times as wide as deep, as nearly as whole rows allow.
    """
    width, depth = float(spacing[1]), float(spacing[0])
    columns = max(1, min(num_envs, round((num_envs * WIDER * depth / width) ** 0.5)))
    rows = -(-num_envs // columns)
    row, column = np.divmod(np.arange(num_envs), columns)
    x = ((rows - 1) / 2 - row) * depth
    y = (column - (columns - 1) / 2) * width
    return np.stack([x, y, np.zeros(num_envs)], axis=1).astype(np.float32)


def env_under_ray(layout: EnvLayout, origin: NDArray, direction: NDArray) -> int | None:
    """The env whose box a ray of the view meets first, or None.

    A ray against one box an env (the slab test) answers a click without a search tree over every
    triangle in the browser, which clickable meshes would have to rebuild at every frame.
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
    """(K', 8, 3) corners of each instance's box in its env's frame; absent instances left out."""
    low, high = visual.mesh.vertices.min(axis=0), visual.mesh.vertices.max(axis=0)
    corners = box_corners(low, high)
    worn = poses[visual.envs, visual.bodies].astype(np.float64)
    worn = worn[np.isfinite(worn).all(axis=1)]
    return SO3(worn[:, None, 3:]).apply(corners[None]) + worn[:, None, :3]

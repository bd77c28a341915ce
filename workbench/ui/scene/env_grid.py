"""Where env i of the batch stands in the page's 3-D view.

Every env has its own world frame and all of them sit on top of each other at its origin; a person
wants to see them side by side. So each env is given an offset on a grid whose spacing comes from
what stands in one env (its table and robot, not its endless floor or backdrop), and a pose in the page is the
env's own pose plus that offset. Floors are wide enough for the whole grid and are drawn once:
sixteen overlapping floors would flicker where they meet and cost sixteen times the triangles.

Plain arrays and pure functions: nothing here knows of a browser.

Level and round the bodies, never over them, so that nothing of the task is covered.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray
from viser.transforms import SO3

from workbench.core.scene.shapes import SceneGeometry, Visual

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


# --- Which env is selected, said in the view: a frame round it and its number -----------------


COLOUR = (34, 139, 230)


class InView:
    """Something in the 3-D view that comes, changes and goes.

    Args:
        add: of viser's scene; makes it of the values of `names`.
        names: of what changes of it.
    """

    def __init__(self, add: Callable[..., Any], *names: str) -> None:
        self._add, self._names = add, names
        self.handle: Any = None
        """Of viser's, while it is shown."""

    def draw(self, *values: Any) -> None:
        """Show it with these values; none of them takes it away."""
        if not values:
            if self.handle is not None:
                self.handle.remove()
            self.handle = None
        elif self.handle is None:
            self.handle = self._add(**dict(zip(self._names, values, strict=True)))
        else:
            for name, value in zip(self._names, values, strict=True):
                setattr(self.handle, name, value)


def line_set(server: viser.ViserServer, name: str, colour: tuple[int, int, int], thickness: float) -> InView:
    """Line segments (K, 2, 3), metres in the view, `thickness` pixels wide."""
    more = {"colors": colour, "thickness": thickness, "thickness_units": "screen"}
    return InView(partial(server.scene.add_line_segments, name, **more), "points")


def view_label(server: viser.ViserServer, name: str, anchor: Literal["top-center", "bottom-left"]) -> InView:
    """A text, and (3,) metres in the view where it is; `anchor` says which part of it is there."""
    return InView(partial(server.scene.add_label, name, anchor=anchor), "text", "position")


class SelectionMark:
    def __init__(self, server: viser.ViserServer) -> None:
        self._frame = line_set(server, "/selected/frame", COLOUR, 3.0)
        self._label = view_label(server, "/selected/label", "top-center")
        self._drawn: tuple[int, int, str] | None = None

    def draw(self, layout: EnvLayout, env: int, shown: bool, name: str | None = None) -> None:
        """Mark this env; not `shown` when it is alone in the view and needs no mark. `name` is said instead of its number."""
        name = f"env {env}" if name is None else name
        if not shown:
            self.clear()
            return
        wanted = (id(layout), env, name)
        if wanted == self._drawn:
            return
        self._drawn = wanted
        offset = layout.offsets[env]
        corner_low = layout.low[:2] + offset[:2] - MARGIN * 0.4
        corner_high = layout.high[:2] + offset[:2] + MARGIN * 0.4
        (x0, y0), (x1, y1) = corner_low, corner_high
        # A frame on the floor under a table is hidden by the tables in front, so it goes where things
        # happen: ManiSkill puts table tops at z = 0. A centimetre above, or the two flicker.
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

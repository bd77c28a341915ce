"""Draws the paths of a body in the rollouts of a plan as lines in the 3-D view: the best bright, the others faint."""

from __future__ import annotations

from functools import partial

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.page.scene.env_grid import InView

BEST, CHOSEN = (10, 255, 25), (255, 0, 110)
"""Colours of the best and the chosen path. Linear, not sRGB: viser's page draws the colours of single lines much
lighter than other colours."""
GOOD, BAD = (10, 60, 200), (70, 75, 85)
"""Colours of the other paths, from the second best to the worst."""
MAX_SEGMENTS = 12
"""Maximum number of segments of a path: half a second of a hand's path is smooth."""
LINE_PIXELS = 2.5
"""Width of the lines."""


class RolloutTraces:
    """The paths of all rollouts as one node of line segments, so that a plan is one message of a few
    kilobytes."""

    def __init__(self, server: viser.ViserServer) -> None:
        more = {"thickness": LINE_PIXELS, "thickness_units": "screen"}
        add = partial(server.scene.add_line_segments, "/rollouts", **more)
        self._server = server
        self._lines = InView(add, "points", "colors")
        self._drawn: tuple[object, int, bytes] | None = None

    def draw(self, paths: NDArray[np.float32] | None, offset: NDArray[np.float32], chosen: int = 0) -> None:
        """Draw these paths, or nothing.

        Args:
            paths: (P, T, 3) best first, metres in the env's frame.
            offset: (3,) offset of the env on the grid.
            chosen: index of the chosen path; 0 is the best.
        """
        if paths is None or paths.shape[0] == 0 or paths.shape[1] < 2:
            if self._drawn is not None:
                self._lines.draw()
            self._drawn = None
            return
        wanted = id(paths), chosen, offset.tobytes()
        if self._drawn is not None and self._drawn[1:] == wanted[1:] and self._drawn[0] is paths:
            return
        points, colours = segments(paths, chosen)
        self._drawn = paths, chosen, offset.tobytes()
        with self._server.atomic():
            if self._lines.handle is not None and self._lines.handle.points.shape != points.shape:
                self._lines.draw()
            self._lines.draw(points + offset, colours)


def segments(paths: NDArray[np.float32], chosen: int = 0) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Points and colours (S, 2, 3) of the segments, the bright ones last; segments that are not finite are left out."""
    kept = np.unique(np.linspace(0, paths.shape[1] - 1, min(MAX_SEGMENTS + 1, paths.shape[1])).astype(int))
    sampled = paths[:, kept]
    share = np.linspace(0, 1, len(sampled))[:, None]
    colours = np.array(GOOD) * (1 - share) + np.array(BAD) * share
    colours[0] = BEST
    if 0 < chosen < len(sampled):
        colours[chosen] = CHOSEN
    lines = np.stack([sampled[:, :-1], sampled[:, 1:]], axis=2)
    each = np.broadcast_to(colours[:, None, None, :], lines.shape)
    order = np.argsort([place not in (0, chosen) for place in range(len(sampled))], kind="stable")[::-1]
    points, shades = lines[order].reshape(-1, 2, 3), each[order].reshape(-1, 2, 3)
    there = np.isfinite(points).all(axis=(1, 2))
    return points[there].astype(np.float32), shades[there].astype(np.uint8)

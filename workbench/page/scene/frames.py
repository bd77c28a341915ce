"""Coordinate frames of an env and its bodies in the 3-D view: x red, y green, z blue."""

from __future__ import annotations

from functools import partial

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.envs.scene.shapes import SceneGeometry
from workbench.page.scene.env_grid import InView

AXIS_METRES, RADIUS_METRES = 0.1, 0.003


class BodyFrames:
    """Axes at the origin of one env, at its visible bodies except links and fixed bodies, and at the selected
    body."""

    def __init__(self, server: viser.ViserServer) -> None:
        add = partial(
            server.scene.add_batched_axes, "/frames", axes_length=AXIS_METRES, axes_radius=RADIUS_METRES
        )
        self._axes = InView(add, "batched_wxyzs", "batched_positions")
        self._count = 0

    def draw(
        self, geometry: SceneGeometry, poses: NDArray[np.float32], env: int, selected: str, offset: NDArray
    ) -> None:
        """Draw the frames of this env.

        Args:
            poses: (N, B, 7) as in `SceneGeometry`.
            selected: name of the selected body; empty for none.
            offset: (3,) position of the env in the view, metres.
        """
        bodies = zip(geometry.body_names, geometry.body_kinds, geometry.body_hidden, strict=True)
        rows = [
            row
            for row, (name, kind, hidden) in enumerate(bodies)
            if name == selected or (kind in ("dynamic", "kinematic") and not hidden)
        ]
        shown = poses[env, rows]
        shown = shown[np.isfinite(shown).all(axis=1)]  # NaN: this env lacks the body
        origin = np.array([[0, 0, 0, 1, 0, 0, 0]], np.float32)
        shown = np.concatenate([origin, shown])
        if len(shown) != self._count:
            self.clear()  # viser's two arrays are set one after the other, and must have equal lengths
        self._count = len(shown)
        self._axes.draw(shown[:, 3:], shown[:, :3] + np.asarray(offset, np.float32))

    def clear(self) -> None:
        """Draw no frames."""
        self._axes.draw()

"""Which env is selected, said in the view: a frame round it and its number.

Level and round the bodies, never over them, so that nothing of the task is covered.
"""

from __future__ import annotations

from functools import partial
from typing import Literal

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.ui.env_layout import MARGIN, EnvLayout

COLOUR = (34, 139, 230)


class LineSet:
    """Line segments in the 3-D view, `thickness` pixels wide, that come, change and go."""

    def __init__(
        self, server: viser.ViserServer, name: str, colour: tuple[int, int, int], thickness: float
    ) -> None:
        self._server, self._name, self._colour, self._thickness = server, name, colour, thickness
        self._handle: viser.LineSegmentsHandle | None = None

    def draw(self, points: NDArray | None) -> None:
        """Draw these (K, 2, 3), metres in the view; None takes them away."""
        if points is None:
            if self._handle is not None:
                self._handle.remove()
                self._handle = None
        elif self._handle is None:
            self._handle = self._server.scene.add_line_segments(
                self._name,
                np.asarray(points, np.float32),
                self._colour,
                thickness=self._thickness,
                thickness_units="screen",
            )
        else:
            self._handle.points = np.asarray(points, np.float32)


class ViewLabel:
    """A text in the 3-D view that comes, changes and goes; `anchor` says which part of it is at its place."""

    def __init__(
        self, server: viser.ViserServer, name: str, anchor: Literal["top-center", "bottom-left"]
    ) -> None:
        self._add = partial(server.scene.add_label, name, anchor=anchor)
        self._handle: viser.LabelHandle | None = None

    def draw(self, text: str | None, place: NDArray | None = None) -> None:
        """Write this at (3,), metres in the view; None takes it away."""
        if text is None or place is None:
            if self._handle is not None:
                self._handle.remove()
                self._handle = None
        elif self._handle is None:
            self._handle = self._add(text, position=place)
        else:
            self._handle.text, self._handle.position = text, place


class SelectionMark:
    def __init__(self, server: viser.ViserServer) -> None:
        self._frame = LineSet(server, "/selected/frame", COLOUR, 3.0)
        self._label = ViewLabel(server, "/selected/label", "top-center")
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
        self._frame.draw(None)
        self._label.draw(None)

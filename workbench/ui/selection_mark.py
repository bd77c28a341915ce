"""Which env is selected, said in the view: a frame round it and its number.

Level and round the bodies, never over them, so that nothing of the task is covered.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np
import viser

from workbench.ui.env_layout import MARGIN, EnvLayout

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

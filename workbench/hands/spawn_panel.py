"""The range in which resets put the selected body: a box over the table with handles at its sides, and number fields."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, get_args

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.hands.commands import SetSpawnSide, Side, WriteSpawn
from workbench.hands.spawn import SpawnBox, SpawnDragged
from workbench.hands.spawn_source import AXES, why_no_range
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.machine.loop import post
from workbench.page.scene.env_grid import line_set
from workbench.page.widgets.fields import Field
from workbench.page.widgets.notices import refusals_shown
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Tool, tools_html

Floats = NDArray[np.floating[Any]]
SIDES: tuple[Side, ...] = get_args(Side)
GIZMO_PIXELS = 60.0
COLOUR = (255, 146, 43)


@dataclass(frozen=True)
class _Drag:
    """A drag of a side on one page."""

    client: int
    side: Side
    offset: Floats
    """(3,) position of the env in the view."""


class SpawnPanel:
    """Fields, tools and handles for the spawn range, in the present container."""

    def __init__(self, server: viser.ViserServer, session: LiveSession) -> None:
        self._server, self._session = server, session
        self._note = server.gui.add_html("", visible=False)
        self._fields = [
            Field(
                server,
                f"{axis} from, to",
                SetSpawnSide,
                "to",
                [0.0, 0.0],
                given=[{"side": f"{axis}_min"}, {"side": f"{axis}_max"}],
                hint="In the env's frame, metres.",
                step=0.01,
            )
            for axis in AXES
        ]
        self._tools = server.gui.add_html("", visible=False)
        self._lines = line_set(server, "/hands/spawn_box", COLOUR, 3.0)
        self._gizmos = {side: self._add(side) for side in SIDES}
        self._offset: Floats = np.zeros(3)
        self._drag: _Drag | None = None
        self.show(SpawnBox(), "")

    def show(self, box: SpawnBox, body: str) -> None:
        """Show the range in the panel, if it is the range of this body."""
        shows = box.stage != "none" and box.body == body
        is_measured = shows and any(box.measured)
        for field, axis, sides in zip(self._fields, box.wanted, box.sides, strict=True):
            field.visible = is_measured
            field.show([round(side, 4) for side in sides], off=axis is None or box.stage != "measured")
        self._note.visible, self._tools.visible = shows, is_measured
        self._note.content = render("note", text=_note(box))
        off = box.stage != "measured" or box.wanted == box.measured
        write = Tool("Write the range into the file", WriteSpawn(), WriteSpawn.help(), off=off)
        self._tools.content = tools_html([write])

    def draw_in_view(self, view: SessionView, body: str, height: float, offset: Floats) -> None:
        """Draw the box, and the handles of the sides that can be dragged.

        Args:
            body: the selected body; empty for none.
            height: z of the body in the env's frame, in metres.
            offset: (3,) position of the selected env in the view.
        """
        box = view.of(SpawnBox)
        self._offset = np.asarray(offset, np.float64)
        shows = bool(body) and box.body == body and any(box.measured)
        (left, right), (near, far) = box.sides
        middle_x, middle_y = (left + right) / 2, (near + far) / 2
        if shows:
            corners = np.array([[left, near], [right, near], [right, far], [left, far]])
            ring = np.column_stack([corners, np.full(4, height)]) + offset
            self._lines.draw(np.stack([ring, np.roll(ring, -1, axis=0)], axis=1).astype(np.float32))
        else:
            self._lines.draw()
        at = {
            "x_min": (left, middle_y),
            "x_max": (right, middle_y),
            "y_min": (middle_x, near),
            "y_max": (middle_x, far),
        }
        for side, gizmo in self._gizmos.items():
            gizmo.visible = shows and box.wanted[AXES.index(side[0])] is not None
            # During a drag viser moves the handles: writing their position would pull them from the pointer.
            if self._drag is None or self._drag.side != side:
                gizmo.position = tuple((np.array([*at[side], height]) + offset).tolist())

    def _add(self, side: Side) -> viser.TransformControlsHandle:
        gizmo = self._server.scene.add_transform_controls(
            f"/hands/spawn/{side}",
            GIZMO_PIXELS,
            fixed=True,
            depth_test=False,
            visible=False,
            active_axes=(side[0] == "x", side[0] == "y", False),
            disable_rotations=True,
            disable_sliders=True,
        )

        # Async, since viser runs callbacks that are not async in its thread pool, in any order.
        async def on_update(event: viser.TransformControlsEvent) -> None:
            post(partial(self._dragged, side, event.client, event.phase, np.array(event.target.position)))

        gizmo.on_update(on_update)
        return gizmo

    def _dragged(self, side: Side, client: viser.ClientHandle | None, phase: str, position: Floats) -> None:
        if client is not None:
            with refusals_shown(client, then=self.let_go):
                self.drag(client.client_id, side, phase, position)

    def drag(self, client: int, side: Side, phase: str, position: Floats) -> None:
        """Handle a drag of a side's handle.

        Args:
            client: id of the page.
            phase: ``start``, ``update`` or ``end``.
            position: (3,) of the handle in the view.

        Raises:
            Refused: the side cannot be moved now.
        """
        if self._drag is None:
            self._drag = _Drag(client, side, self._offset)
        drag = self._drag
        if (drag.client, drag.side) != (client, side):
            return
        if phase == "end":
            self._drag = None
        axis = AXES.index(side[0])
        self._session.dispatch(SpawnDragged(side, float(position[axis] - drag.offset[axis])))

    def end_lost_drag(self) -> None:
        """End the drag if its page has closed or the handle is hidden: neither reports an end."""
        drag = self._drag
        if drag is None:
            return
        if drag.client not in self._server.get_clients() or not self._gizmos[drag.side].visible:
            self.let_go()

    def let_go(self) -> None:
        """End the drag; the side stays where it is."""
        self._drag = None


def _note(box: SpawnBox) -> str:
    if box.stage == "failed":
        return f"The resets failed: {box.why}"
    if box.stage == "measuring":
        return "Resetting in the background ..."
    unknown = [name for name, of in zip(AXES, box.measured, strict=True) if of is None]
    reasons = [f"{why_no_range(name, box.body)}." for name in unknown]
    if len(unknown) == len(AXES):
        return " ".join(reasons)
    return " ".join(["Resets put it between these sides. Drag them, or enter numbers.", *reasons])

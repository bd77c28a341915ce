"""View tools for the selected body: frame, follow, hide, and measure the distance to another body."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import viser
from numpy.typing import NDArray
from viser.transforms import SO3

from workbench.envs.inspection import BodyReadings
from workbench.envs.scene.shapes import SceneGeometry
from workbench.hands.commands import FrameBody, HideBody, MeasureFrom, ShowHiddenBodies, TrackBody, WatchForce
from workbench.hands.panel import Selected
from workbench.live.view import SessionView
from workbench.page.command import Command, Refused
from workbench.page.scene.env_grid import InView, line_set, view_label
from workbench.page.scene.viewpoint import aspect_of, frame_box
from workbench.page.widgets.keys_and_palette import with_key
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Tool, tools_html
from workbench.page.widgets.visitors import Visitor

Floats = NDArray[np.floating]
MIN_FRAMED_METRES = 0.15
"""Minimum side of the framed box, so that the view of a small body shows its surroundings too."""
JOINT_COLOUR, MASS_COLOUR, MEASURE_COLOUR = (64, 200, 255), (255, 64, 160), (255, 196, 61)
AXIS_METRES = 0.12
"""Length of a joint's axis on each side of the joint."""
MASS_POINT_METRES = 0.012


class BodyView(PagePart[SessionView]):
    """The row of tools under the selected body, and what they change in the 3-D view.

    Args:
        body: returns the name of the selected body; empty for none.
        selected: returns the body as it is drawn; None if nothing of it is visible.
        order: viser's order of the row in its tab.
    """

    does = (FrameBody, TrackBody, HideBody, ShowHiddenBodies, MeasureFrom)

    def __init__(
        self,
        server: viser.ViserServer,
        body: Callable[[], str],
        selected: Callable[[], Selected | None],
        order: float,
    ) -> None:
        self._server, self._body, self._selected = server, body, selected
        self._hidden: frozenset[str] = frozenset()
        self._follows = ""
        """Name of the body that the viewpoints follow; empty for none."""
        self._followed: tuple[int, Floats] | None = None
        """Selected env, and position (3,) of the followed body in the view, at the last draw."""
        self._measured = ""
        """Name of the body from which distances are measured."""
        self._html = server.gui.add_html("", order=order, visible=False)
        self._line = line_set(server, "/hands/distance", MEASURE_COLOUR, 2.0)
        self._metres = view_label(server, "/hands/distance_label", "bottom-left")
        self._axis = line_set(server, "/hands/joint_axis", JOINT_COLOUR, 4.0)
        mass = partial(server.scene.add_icosphere, "/hands/mass", MASS_POINT_METRES, color=MASS_COLOUR)
        self._mass = InView(mass, "position")

    def key(self, view: SessionView) -> object:
        shown = self._body(), view.step_serial, view.task_serial, view.selected_env
        return *shown, self._hidden, self._follows, self._measured, view.settings.watched_forces

    def draw(self, view: SessionView) -> None:
        body, names = self._body(), () if view.task is None else view.task.geometry.body_names
        rows: list[Tool] = []
        if body in names:
            rows = [
                Tool("Frame", FrameBody(), with_key(FrameBody)),
                Tool("Follow", TrackBody(), with_key(TrackBody), on=self._follows == body),
                Tool("Hide", HideBody(), with_key(HideBody), on=body in self._hidden),
                Tool("Measure from", MeasureFrom(), with_key(MeasureFrom), on=self._measured == body),
            ]
        watched = view.settings.watched_forces
        pair = min(body, self._measured), max(body, self._measured)
        if body in names and self._measured in names and body != self._measured and pair not in watched:
            watch = WatchForce(body=body, other=self._measured, on=True)
            rows.append(Tool(f"Watch force with {self._measured}", watch, WatchForce.help()))
        if hidden := self._hidden & set(names):
            count = f"Show hidden ({len(hidden)})"
            rows.append(
                Tool(count, ShowHiddenBodies(), f"{', '.join(sorted(hidden))}. {ShowHiddenBodies.help()}")
            )
        self._html.visible = bool(rows)
        note = self._distance(view, body)
        self._html.content = tools_html(rows) + (render("note", text=note) if note else "")
        if watched:
            self._html.visible = True
            self._html.content += render("watched_forces", rows=_force_rows(view), stop=_stop_watching)

    def _distance(self, view: SessionView, body: str) -> str:
        """The distance from body `_measured` to the selected body, as text; if they are the same body, what
        to select."""
        ends = _ends(view, self._measured, body)
        if ends is None:
            return "Select a second body to see how far it is." if body and body == self._measured else ""
        way = ends[1] - ends[0]
        x, y, z = (f"{float(one):.4f}" for one in way)
        return f"{np.linalg.norm(way):.4f} m from {self._measured}, frame to frame: x {x}, y {y}, z {z} in the env's frame."

    def do(self, command: Command, visitor: Visitor) -> None:
        if isinstance(command, ShowHiddenBodies):
            self._hidden = frozenset()
            return
        body = self._body()
        if not body:
            raise Refused("Select a body first: click it in the view.")
        match command:
            case HideBody():
                self._hidden ^= {body}
            case MeasureFrom():
                self._measured = "" if self._measured == body else body
            case TrackBody():
                self._follows, self._followed = "" if self._follows == body else body, None
            case FrameBody():
                at = self._required()
                size = np.maximum(at.box[1] - at.box[0], MIN_FRAMED_METRES)
                middle = SO3(at.pose[3:]).apply(at.box.mean(axis=0)) + at.pose[:3] + at.offset
                # A sphere holds the box in any rotation.
                reach = np.full(3, np.linalg.norm(size) / 2)
                camera = visitor.client.camera
                to = frame_box(middle - reach, middle + reach, aspect_of(visitor.client))
                away = np.asarray(camera.position) - np.asarray(camera.look_at)
                distance = float(np.linalg.norm(to.position - to.look_at))
                # The direction stays: the user has turned the view to see something.
                camera.position = middle + away / max(float(np.linalg.norm(away)), 1e-6) * distance
                camera.look_at = middle

    def _required(self) -> Selected:
        if (at := self._selected()) is None:
            raise Refused("Nothing of this body is visible in the selected env.")
        return at

    # --- the 3-D view --------------------------------------------------------------------------------

    def without_hidden(self, geometry: SceneGeometry, poses: NDArray[np.float32]) -> NDArray[np.float32]:
        """`poses` (N, B, 7) with NaN for the hidden bodies, which are then not drawn."""
        rows = [row for row, name in enumerate(geometry.body_names) if name in self._hidden]
        if not rows:
            return poses
        shown = poses.copy()
        shown[:, rows] = np.nan
        return shown

    def draw_in_view(
        self,
        view: SessionView,
        poses: NDArray[np.float32],
        offset: Floats,
        read: BodyReadings | None,
    ) -> None:
        """Draw the measured distance, and move the viewpoints with the body that they follow.

        Args:
            poses: (N, B, 7) in env frames.
            offset: (3,) position of the selected env in the view.
            read: reading of the selected body, whose centre of mass and joint axis are drawn; None draws neither.
        """
        self._draw_distance(view, offset)
        self._draw_reading(read)
        place, before = _place(view, poses, self._follows, offset), self._followed
        self._followed = None if place is None else (view.selected_env, place)
        if place is None or before is None or before[0] != view.selected_env:
            return
        moved = place - before[1]
        if not moved.any():
            return
        for client in self._server.get_clients().values():
            # viser moves the look-at point with the position.
            client.camera.position = np.asarray(client.camera.position) + moved

    def _draw_distance(self, view: SessionView, offset: Floats) -> None:
        ends = _ends(view, self._measured, self._body())
        if ends is None:
            self._line.draw()
            self._metres.draw()
            return
        line = (ends + offset).astype(np.float32)
        self._line.draw(line[None])
        self._metres.draw(f"{np.linalg.norm(ends[1] - ends[0]):.4f} m", tuple(line.mean(axis=0).tolist()))

    def _draw_reading(self, read: BodyReadings | None) -> None:
        at = self._selected()
        if at is None or read is None or read.name != at.body:
            self._axis.draw()
            self._mass.draw()
            return
        turn, place = SO3(at.pose[3:]), at.pose[:3] + at.offset
        if read.centre_of_mass is None:
            self._mass.draw()
        else:
            self._mass.draw(tuple((turn.apply(read.centre_of_mass.astype(np.float64)) + place).tolist()))
        if read.joint is None:
            self._axis.draw()
        else:
            along = read.joint.axis.astype(np.float64) * AXIS_METRES
            origin = read.joint.origin.astype(np.float64)
            ends = turn.apply(np.stack([origin - along, origin + along])) + place
            self._axis.draw(ends[None].astype(np.float32))


def _place(view: SessionView, poses: NDArray[np.float32], body: str, offset: Floats) -> Floats | None:
    """(3,) position of a body of the selected env in the view; None if the env has no such body."""
    names = () if view.task is None else view.task.geometry.body_names
    if body not in names or poses.shape[1] != len(names):
        return None
    place = poses[view.selected_env, names.index(body), :3].astype(np.float64) + offset
    return place if np.isfinite(place).all() else None


def _force_rows(view: SessionView) -> list[tuple[str, str, str]]:
    """The bodies of each watched pair, and their force in the selected env at the shown moment."""
    forces = {} if view.step is None else view.step.forces
    rows: list[tuple[str, str, str]] = []
    for body, other in view.settings.watched_forces:
        newtons = forces.get((body, other))
        value = math.nan if newtons is None else float(newtons[view.selected_env])
        rows.append((body, other, "after the next step" if math.isnan(value) else f"{value:.3g} N"))
    return rows


def _stop_watching(body: str, other: str) -> WatchForce:
    return WatchForce(body=body, other=other, on=False)


def _ends(view: SessionView, start: str, end: str) -> Floats | None:
    """(2, 3) origins of the two bodies' frames in the selected env's frame; None if a body is missing."""
    task, step = view.task, view.step
    if task is None or step is None or start == end:
        return None
    names = task.geometry.body_names
    if start not in names or end not in names or step.poses.shape[:2] != (task.num_envs, len(names)):
        return None
    ends = step.poses[view.selected_env, [names.index(start), names.index(end)], :3].astype(np.float64)
    return ends if np.isfinite(ends).all() else None

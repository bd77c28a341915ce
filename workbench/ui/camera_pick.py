"""Read a pixel: press on a camera's picture, and be told what is there, how far it is, and where.

The question behind "is the cube in the picture" is often "what is this pixel": the depth that a policy gets of it, and
the name that its segmentation id stands for. The answer has the point in the env's own frame, where it is also marked
in the 3-D view, so that one sees whether the camera looks at what one thinks.
"""

from __future__ import annotations

import time

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.core.pictures import Picture
from workbench.session.session import Session
from workbench.session.studio_view import Picked, StudioCamera
from workbench.session.view import SessionView
from workbench.ui.fragments import render
from workbench.ui.inline_pictures import data_address
from workbench.ui.presses import Presses

REDRAW_EVERY = 0.25
"""Seconds. The picture is sent inside of HTML, which the page builds anew each time."""
LARGEST = 512
"""Pixels along its longer side."""
MARK_COLOUR = (230, 73, 128)
MARK_SIZE = 0.05
"""Metres from the point to each end of its cross."""


class CameraPick:
    """The folder in the present container, and the mark in the view."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server, self._session = server, session
        self._drawn: object = None
        self._drawn_at = 0.0
        with server.gui.add_folder("Read a pixel", expand_by_default=False) as self.folder:
            self._on = server.gui.add_checkbox(
                "Show the picture",
                False,
                hint="Press on the picture to be told what is there. It follows what the camera sees.",
            )
            self._html = server.gui.add_html("", visible=False)
            self._presses = Presses(server)
        self._press = self._presses.place_id("picture", lambda u, v, client: self._pick(u, v))
        self._mark = PointMark(server)

    def _pick(self, u: float, v: float) -> None:
        key = self._session.view().studio.selected
        if key is not None:
            self._session.studio.pick(key, u, v)

    def draw(self, view: SessionView) -> None:
        on = self._on.value is True
        if self._html.visible != on:
            self._html.visible = on
        camera = view.studio.chosen
        picture = None if camera is None else view.pictures.get(camera.key)
        if picture is not None and (picture.rgb is None or picture.env != view.selected_env):
            picture = None
        picked = picked_here(view)
        wanted = (None if camera is None else camera.key, id(picture), picked)
        if not on or wanted == self._drawn or time.monotonic() - self._drawn_at < REDRAW_EVERY:
            return
        self._drawn, self._drawn_at = wanted, time.monotonic()
        self._html.content = pick_html(camera, picture, picked, self._press)

    def draw_in_view(self, view: SessionView, offset: NDArray[np.float32]) -> None:
        """Mark the point that was picked.

        Args:
            offset: (3,) where the selected env stands in the view.
        """
        picked = picked_here(view) if self._on.value is True else None
        self._mark.draw(picked, offset)


def picked_here(view: SessionView) -> Picked | None:
    """What was picked, if it is of the camera and the env that are selected."""
    picked = view.studio.picked
    if picked is None or picked.key != view.studio.selected or picked.env != view.selected_env:
        return None
    return picked


def pick_html(camera: StudioCamera | None, picture: Picture | None, picked: Picked | None, press: str) -> str:
    note = ""
    if camera is None:
        note = "Choose a camera first."
    elif picture is None or picture.rgb is None:
        note = f"Tick rgb of {camera.info.name}: its picture comes here, to be pressed."
    rgb = None if picture is None or note else picture.rgb
    point = None if picked is None else picked.point
    numbers = "" if point is None else ", ".join(f"{x:.4f}" for x in point)
    return render(
        "camera_pick",
        note=note,
        picture="" if rgb is None else data_address(rgb, LARGEST),
        press=press,
        left="" if picked is None else f"{100 * picked.u:.2f}",
        top="" if picked is None else f"{100 * picked.v:.2f}",
        picked=picked is not None and rgb is not None,
        body="background" if picked is None or picked.body is None else picked.body,
        pixel="" if picked is None else f"{picked.pixel[0]}, {picked.pixel[1]}",
        depth="" if picked is None or picked.depth is None else f"{picked.depth:.4f}",
        point=numbers,
        copy=f"[{numbers}]",
    )


class PointMark:
    """A cross and its number in the view, at a point of the selected env."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._cross: viser.LineSegmentsHandle | None = None
        self._label: viser.LabelHandle | None = None
        self._drawn: object = None

    def draw(self, picked: Picked | None, offset: NDArray[np.float32]) -> None:
        point = None if picked is None else picked.point
        wanted = None if point is None or picked is None else (point, offset.tobytes(), picked.depth)
        if wanted == self._drawn:
            return
        self._drawn = wanted
        if point is None or picked is None:
            for handle in (self._cross, self._label):
                if handle is not None:
                    handle.remove()
            self._cross = self._label = None
            return
        place = np.asarray(point, np.float64) + offset
        text = picked.body or ""
        if self._cross is None or self._label is None:
            ends = np.eye(3, dtype=np.float32) * MARK_SIZE
            self._cross = self._server.scene.add_line_segments(
                "/picked/cross",
                np.stack([-ends, ends], axis=1),
                MARK_COLOUR,
                thickness=3.0,
                thickness_units="screen",
                position=place,
            )
            self._label = self._server.scene.add_label(
                "/picked/label", text, position=place, anchor="bottom-left"
            )
        else:
            self._cross.position = place
            self._label.position, self._label.text = place, text

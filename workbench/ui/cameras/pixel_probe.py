"""A press on the chosen camera's picture shows the body, the depth and the point there."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.session.cameras.view import PickedPixel, StudioCamera
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.ui.scene.env_grid import line_set, view_label
from workbench.ui.widgets.click_targets import Presses
from workbench.ui.widgets.templates import render

MARK_COLOUR = (230, 73, 128)
MARK_SIZE = 0.05
"""Metres from the point to each end of its cross."""


class CameraPick:
    """An overlay on the picture, the result, and a mark at the point in the 3-D view.

    viser's pictures do not tell where they are pressed, so a pane of our own HTML lies over the picture (``.wb-pane`` in
    page.css). Make it in the container of the picture, directly after it.
    """

    def __init__(self, server: viser.ViserServer, session: Session, presses: Presses) -> None:
        """
        Args:
            presses: of the tab or of a folder with a label; without a label it hides what comes after it.
        """
        self._drawn: object = None
        # After a picture that is added to the container later.
        self._pane = server.gui.add_html("", order=1e5, visible=False)
        self._found = server.gui.add_html("", order=1e5 + 1, visible=False)
        self._press = presses.place_id("picture", session.studio.reports.pick)
        self._cross = line_set(server, "/picked/cross", MARK_COLOUR, 3.0)
        self._label = view_label(server, "/picked/label", "bottom-left")

    def draw(self, view: SessionView, shown: bool) -> None:
        """Draw pane and result, where they changed.

        Args:
            shown: whether the chosen camera's picture is visible.
        """
        camera, picked = view.studio.chosen, picked_here(view)
        for handle, wanted in (
            (self._pane, shown and camera is not None),
            (self._found, shown and picked is not None),
        ):
            handle.visible = wanted
        size = None if camera is None else _size(camera)
        if camera is None or not shown or (size, picked) == self._drawn:
            return
        self._drawn = (size, picked)
        self._pane.content = pane_html(camera, picked, self._press)
        if picked is not None:
            self._found.content = render("camera_found", picked=picked)

    def draw_in_view(self, view: SessionView, offset: NDArray[np.float32]) -> None:
        """Mark the picked point by a cross and the body's name.

        Args:
            offset: (3,) of the selected env in the view.
        """
        picked = picked_here(view)
        if picked is None or picked.point is None:
            self._cross.draw()
            self._label.draw()
            return
        place = np.asarray(picked.point, np.float64) + offset
        ends = np.eye(3) * MARK_SIZE
        self._cross.draw(np.stack([place - ends, place + ends], axis=1))
        self._label.draw(picked.body or "", place)


def picked_here(view: SessionView) -> PickedPixel | None:
    """The pick, if it is of the selected camera and env."""
    picked = view.studio.results.picked
    if picked is None or picked.key != view.studio.selected or picked.env != view.selected_env:
        return None
    return picked


def pane_html(camera: StudioCamera, picked: PickedPixel | None, press: str) -> str:
    width, height = _size(camera)
    return render("camera_pane", press=press, aspect=f"{width / height:.6f}", picked=picked)


def _size(camera: StudioCamera) -> tuple[int, int]:
    said = camera.info if camera.now is None else camera.now
    return said.width, said.height

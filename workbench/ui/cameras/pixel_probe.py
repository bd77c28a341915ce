"""Press on the chosen camera's picture, and be told what is there, how far it is, and where.

The question behind "is the cube in the picture" is often "what is this pixel": the depth that a policy gets of it, and
the name that its segmentation id stands for. The answer has the point in the env's own frame, where it is also marked
in the 3-D view, so that one sees whether the camera looks at what one thinks.

viser's pictures do not say where they are pressed. So a pane of our own HTML lies over the picture that stands before
it in its container (``.wb-pane`` in page.css), as wide and as tall, and passes on where it was pressed.
"""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.session.cameras.view import Picked, StudioCamera
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.ui.scene.env_grid import line_set, view_label
from workbench.ui.widgets.click_targets import Presses
from workbench.ui.widgets.templates import render

MARK_COLOUR = (230, 73, 128)
MARK_SIZE = 0.05
"""Metres from the point to each end of its cross."""


class CameraPick:
    """The pane over the picture before it, what was found, and the mark in the view.

    Make it in the container of the picture, which must be the last before it.
    """

    def __init__(self, server: viser.ViserServer, session: Session, presses: Presses) -> None:
        """
        Args:
            presses: of the tab or of a folder with a name around it (what has no name hides what comes after it).
        """
        self._drawn: object = None
        # After a picture that is put into the container later.
        self._pane = server.gui.add_html("", order=1e5, visible=False)
        self._found = server.gui.add_html("", order=1e5 + 1, visible=False)
        self._press = presses.place_id("picture", session.studio.judging.pick)
        self._cross = line_set(server, "/picked/cross", MARK_COLOUR, 3.0)
        self._label = view_label(server, "/picked/label", "bottom-left")

    def draw(self, view: SessionView, shown: bool) -> None:
        """Draw what is new.

        Args:
            shown: whether the picture of the chosen camera is.
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
        """Mark the point that was picked by a cross and the body's name.

        Args:
            offset: (3,) where the selected env stands in the view.
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


def picked_here(view: SessionView) -> Picked | None:
    """What was picked, if it is of the camera and the env that are selected."""
    picked = view.studio.looked.picked
    if picked is None or picked.key != view.studio.selected or picked.env != view.selected_env:
        return None
    return picked


def pane_html(camera: StudioCamera, picked: Picked | None, press: str) -> str:
    width, height = _size(camera)
    return render("camera_pane", press=press, aspect=f"{width / height:.6f}", picked=picked)


def _size(camera: StudioCamera) -> tuple[int, int]:
    said = camera.info if camera.now is None else camera.now
    return said.width, said.height

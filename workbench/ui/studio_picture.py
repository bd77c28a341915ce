"""The chosen camera's picture, above the controls that move it: in colour, or as what else a policy may get of it.

A camera is placed for what comes out of it, and that is often depth or segmentation: a far plane that is too near, or a
gripper that hides the cube, is seen there first. So the picture that follows the hand is any of them. All kinds may be
on the Cameras tab at the same time; here is one.
"""

from __future__ import annotations

import math
import time

import viser

from workbench.core.camera_settings import CameraKey
from workbench.core.pictures import Picture
from workbench.session.preview import MODALITIES as IN_A_QUICK_LOOK
from workbench.session.session import Session
from workbench.session.view import SessionView
from workbench.ui.cameras_panel import FASTEST, CameraImage, modalities_of
from workbench.ui.false_colour import DepthRange
from workbench.ui.fragments import render
from workbench.ui.in_colours import COLOUR, depth_span, in_colours
from workbench.ui.parts import Clock


class StudioPicture:
    """The picture in the present container; what lies over it goes into `folder`."""

    def __init__(self, server: viser.ViserServer, session: Session, clock: Clock = time.monotonic) -> None:
        self._server, self._session = server, session
        self._drawn: tuple[CameraKey, Picture, str] | None = None
        self._clock, self._drawn_at = clock, -math.inf
        self._span: DepthRange | None = None
        self._wanted = COLOUR
        self.kinds: tuple[str, ...] = (COLOUR,)
        """That the chosen camera gives; `rgb` first."""
        self.folder = server.gui.add_folder(None)
        with self.folder:
            server.gui.add_html(render("studio_picture"))
        self._picture = CameraImage(server, self.folder)
        self._caption = server.gui.add_html("", visible=False)

    @property
    def shows(self) -> str:
        """Which kind of picture is to be made of the chosen camera."""
        return self._wanted if self._wanted in self.kinds else COLOUR

    def show_kind(self, kind: str) -> None:
        self._wanted = kind

    @property
    def visible(self) -> bool:
        return self._picture.visible

    def draw(self, view: SessionView) -> None:
        studio, key = view.studio, view.studio.selected
        chosen = studio.chosen
        quick = studio.quick_scale != 1.0
        gives = (COLOUR,) if chosen is None else modalities_of(chosen.info)
        self.kinds = tuple(kind for kind in gives if not quick or kind in IN_A_QUICK_LOOK)
        picture = None if key is None else view.pictures.get(key)
        if quick:
            picture = studio.quick
            if studio.wants_quick:
                self._session.studio.look()
        # The last one stays while the next is drawn; that of another camera does not.
        self._picture.show(self._drawn is not None and self._drawn[0] == key)
        self._caption.visible = self.visible and bool(self._caption.content)
        kind = self.shows
        if key is None or picture is None or picture.env != view.selected_env or view.task is None:
            return
        if self._drawn is not None and (self._drawn[0], self._drawn[2]) == (key, kind):
            if self._drawn[1] is picture or self._clock() - self._drawn_at < FASTEST:
                return
        self._span = depth_span(self._span if self._drawn and self._drawn[0] == key else None, picture)
        coloured = in_colours(picture, kind, view.task.segmentation, self._span)
        if coloured is None:
            return  # it is not there yet
        self._drawn, self._drawn_at = (key, picture, kind), self._clock()
        pixels, self._caption.content = coloured
        self._picture.draw(kind, pixels)

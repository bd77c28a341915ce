"""The Cameras tab: what the selected env's cameras see, and which of them are asked for.

A picture costs 50 to 100 ms on a machine without a GPU, so only what is shown is rendered. viser does
not say which tab a person looks at; the check boxes do: a camera without a tick is not asked of the
session. A picture that is replaced before the browser has loaded it is never seen at all (measured:
at 1,000 a second the page shows one in five seconds), hence the limit on how often they are sent.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import viser

from workbench.core.camera_settings import CameraKey
from workbench.core.pictures import CameraInfo, CameraKind, Picture
from workbench.session.messages import CameraRequest, TaskDescription
from workbench.session.view import SessionView
from workbench.ui.false_colour import DepthRange
from workbench.ui.fragments import render
from workbench.ui.in_colours import COLOUR, MODALITIES, depth_span, image_format, in_colours
from workbench.ui.parts import Clock, DrawDue, Part

FASTEST = 1 / 15
"""Seconds between two pictures of one camera."""
KIND_NAMES: dict[CameraKind, str] = {"sensor": "sensor", "human": "for people"}


@dataclass
class _Camera:
    info: CameraInfo
    ticks: dict[str, viser.GuiCheckboxHandle]
    captions: dict[str, viser.GuiHtmlHandle]
    folder: viser.GuiFolderHandle
    facts: viser.GuiHtmlHandle
    images: dict[str, viser.GuiImageHandle] = field(default_factory=dict)
    depth_span: DepthRange | None = None
    drawn: tuple[Picture, tuple[str, ...]] | None = None
    """What its images show."""
    stale: bool = False
    """Whether its pictures are said to be of another moment."""

    def wanted(self) -> tuple[str, ...]:
        return tuple(modality for modality, tick in self.ticks.items() if tick.value is True)


class MakesPictures(Protocol):
    """Who is asked for pictures: a session, which renders them, or a review, which decodes them."""

    def change(self, *, cameras: tuple[CameraRequest, ...]) -> None: ...


class CamerasPanel(Part[SessionView]):
    """
    Args:
        session: Who is asked for pictures.
        no_camera: What is said where there is none.
        studio_shows: Which kind of picture of the camera that is being placed is on the page beside its colours.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: MakesPictures,
        no_camera: str = "This task has no camera.",
        studio_shows: Callable[[], str] = lambda: COLOUR,
        clock: Clock = time.monotonic,
    ) -> None:
        self._no_camera, self._studio_shows = no_camera, studio_shows
        self._server = server
        self._session = session
        self._cameras: dict[tuple[CameraKind, str], _Camera] = {}
        self._remembered: dict[tuple[CameraKind, str, str], bool] = {}
        self._cameras_serial = -1
        self._due = DrawDue(FASTEST, clock)
        self._asked: tuple[CameraRequest, ...] | None = None
        self._quick = False
        self._studio: CameraKey | None = None
        """The camera that is being placed, whose picture is wanted whether or not it has a tick here."""
        self._note = server.gui.add_html(render("note", text="Pictures appear when the task is loaded."))
        self._frustums = server.gui.add_checkbox(
            "In the view",
            True,
            visible=False,
            hint="Draw these cameras, with their pictures, in the 3-D view.",
        )
        self._folder = server.gui.add_folder(None)

    @property
    def show_frustums(self) -> bool:
        return self._frustums.value is True

    def draw(self, view: SessionView) -> None:
        self._studio = view.studio.selected
        self._quick = view.studio.quick_scale != 1.0
        if view.task is not None and view.cameras_serial != self._cameras_serial:
            self._cameras_serial = view.cameras_serial
            self._build(view.task)
        self._ask()
        self._mark_stale(view)
        if not self._due.is_due((view.pictures_serial, view.selected_env)):
            return
        for key, camera in self._cameras.items():
            picture = view.pictures.get(key)
            if picture is None or picture.env != view.selected_env or view.task is None:
                continue
            # Kinds come one after the other, and a picture that is sent again is decoded again.
            if camera.drawn is None or camera.drawn[0] is not picture or camera.drawn[1] != camera.wanted():
                camera.drawn = (picture, camera.wanted())
                self._draw_camera(camera, picture, view.task, view.picture_milliseconds)

    def shown_pictures(self, view: SessionView) -> dict[tuple[CameraKind, str], Picture]:
        """The pictures of cameras with a tick, of the selected env: what the view's frustums wear."""
        return {
            key: picture
            for key, picture in view.pictures.items()
            if picture.env == view.selected_env
            and key in self._cameras
            and (key == view.studio.selected or self._cameras[key].wanted())
        }

    def _build(self, task: TaskDescription) -> None:
        """One folder a camera. One that is still there keeps it, with its ticks and its place on the page."""
        for key, camera in self._cameras.items():
            for modality, tick in camera.ticks.items():
                self._remembered[(*key, modality)] = tick.value is True
        before, self._cameras = self._cameras, {}
        stay = {(c.kind, c.name): modalities_of(c) for c in task.cameras} if task.can_render else {}
        for key in [key for key, camera in before.items() if stay.get(key) != tuple(camera.ticks)]:
            before.pop(key).folder.remove()
        if not task.can_render:
            note = (
                "This machine has no render device, so there are no pictures. "
                "Run workbench doctor to see what is missing."
            )
        elif not task.cameras:
            note = self._no_camera
        else:
            note = ""
        self._note.content = render("note", text=note)
        self._note.visible = bool(note)
        self._frustums.visible = not note
        if note:
            return
        first_of_kind = {}
        for camera in task.cameras:
            first_of_kind.setdefault(camera.kind, camera.name)
        with self._folder:
            for order, info in enumerate(task.cameras):
                key = (info.kind, info.name)
                camera = before.get(key)
                if camera is None:
                    camera = self._build_camera(info, first_of_kind[info.kind] == info.name)
                else:
                    camera.info, camera.depth_span = info, None
                    camera.facts.content = facts(camera)
                camera.folder.order = order
                self._cameras[key] = camera

    def _build_camera(self, info: CameraInfo, first: bool) -> _Camera:
        gui = self._server.gui
        folder = gui.add_folder(f"{info.name} · {KIND_NAMES[info.kind]}")
        ticks, captions = {}, {}
        with folder:
            about = gui.add_html("", order=1.0)
            for order, modality in enumerate(modalities_of(info)):
                on = self._remembered.get((info.kind, info.name, modality), first and modality == "rgb")
                ticks[modality] = gui.add_checkbox(modality, on, order=10.0 * order + 10)
                captions[modality] = gui.add_html("", order=10.0 * order + 12)
        camera = _Camera(info, ticks, captions, folder, about)
        about.content = facts(camera)
        return camera

    def _ask(self) -> None:
        """Ask for exactly the pictures that have a tick."""
        wanted = tuple(
            CameraRequest(camera.info.name, camera.info.kind, modalities)
            for key, camera in self._cameras.items()
            if (modalities := self._wanted_of(key, camera))
        )
        if wanted != self._asked:
            self._asked = wanted
            self._session.change(cameras=wanted)
        for camera in self._cameras.values():
            for modality, tick in camera.ticks.items():
                shown = tick.value is True
                camera.captions[modality].visible = shown
                if modality in camera.images:
                    camera.images[modality].visible = shown

    def _wanted_of(self, key: CameraKey, camera: _Camera) -> tuple[str, ...]:
        wanted = camera.wanted()
        if self._quick:
            return wanted  # it is looked through in another size, and need not be drawn in its own
        if key != self._studio:
            return wanted
        return tuple(m for m in modalities_of(camera.info) if m in (COLOUR, self._studio_shows(), *wanted))

    def _mark_stale(self, view: SessionView) -> None:
        """Say of pictures that are on the page, and are not of the moment that is, that they are not."""
        for key, camera in self._cameras.items():
            picture = view.pictures.get(key)
            here = picture is not None and picture.env == view.selected_env
            stale = not here and any(image.visible for image in camera.images.values())
            if stale != camera.stale:
                camera.stale = stale
                camera.facts.content = facts(camera)

    def _draw_camera(
        self, camera: _Camera, picture: Picture, task: TaskDescription, milliseconds: float
    ) -> None:
        if picture.depth is not None:
            camera.depth_span = depth_span(camera.depth_span, picture)
        for modality in camera.wanted():
            coloured = in_colours(picture, modality, task.segmentation, camera.depth_span)
            if coloured is None:
                continue
            pixels, caption = coloured
            if modality == COLOUR:
                # A recorded picture was rendered when it was recorded.
                took = f"{milliseconds:.0f}" if np.isfinite(milliseconds) else ""
                caption = render("rgb_caption", milliseconds=took)
            self._draw_image(camera, modality, pixels)
            if modality in camera.captions:
                camera.captions[modality].content = caption

    def _draw_image(self, camera: _Camera, modality: str, pixels: np.ndarray) -> None:
        handle = camera.images.get(modality)
        if handle is None:
            with camera.folder:
                camera.images[modality] = self._server.gui.add_image(
                    pixels,
                    format=image_format(modality),
                    jpeg_quality=75,
                    order=camera.ticks[modality].order + 1,
                )
        else:
            handle.image = pixels


def modalities_of(info: CameraInfo) -> tuple[str, ...]:
    """Those that can be shown, in the page's order."""
    return tuple(modality for modality in MODALITIES if modality in info.modalities)


def facts(camera: _Camera) -> str:
    """The line under a camera's name."""
    fovy = f"{np.degrees(camera.info.fovy):.0f}°"
    return render("camera_facts", info=camera.info, fovy=fovy, stale=camera.stale)

"""Pictures of the selected env's cameras; and the Studio's picture of the chosen camera, with pixel picks."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.cameras.apply import PREVIEW_MODALITIES
from workbench.cameras.commands import PickPixel, ShowPictures
from workbench.cameras.view import PickedPixel, ShownCameras, StudioCamera, StudioView
from workbench.envs.camera_data import CameraInfo, CameraKey, CameraKind, Picture
from workbench.live.messages import CameraRequest
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.machine.text import listed
from workbench.page.command import Command, Refused
from workbench.page.scene.env_grid import line_set, view_label
from workbench.page.widgets.fields import Field, tick
from workbench.page.widgets.modality_colours import (
    COLOUR,
    MODALITIES,
    DepthRange,
    depth_span,
    image_format,
    in_colours,
    narrowed,
)
from workbench.page.widgets.parts import Clock, DrawThrottle
from workbench.page.widgets.templates import render
from workbench.page.widgets.visitors import Visitor

PICTURE_PERIOD_SECONDS = 1 / 15
"""Minimum interval between two pictures of one camera. A picture that is replaced before the browser has loaded it is never
visible (measured: at 1,000 pictures a second, the page shows one every five seconds)."""
SHOWN_WIDTH_PIXELS = 400
"""Width of a shown picture; a panel is some 340 pixels wide."""
SETTLE_SECONDS = 0.4
"""Debounce time: if no other picture follows within it, the last picture is sent in full size."""
KIND_NAMES: dict[CameraKind, str] = {"sensor": "sensor", "human": "human view"}


class CameraImage:
    """An image in a container that shows a camera's pictures; it is created when the first picture arrives.

    Pictures in quick succession are sent at the size at which the panel shows them; the last one is then sent
    again in full size, so that it can be opened large.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        container: viser.GuiFolderHandle,
        clock: Clock = time.monotonic,
    ) -> None:
        self._server, self._container, self._clock = server, container, clock
        self._handle: viser.GuiImageHandle | None = None
        self._drawn_at = -math.inf
        self._whole: tuple[str, NDArray[np.uint8]] | None = None
        """Modality and full-size pixels of the last picture, if it is shown smaller."""

    @property
    def visible(self) -> bool:
        return self._handle is not None and self._handle.visible

    def show(self, shown: bool) -> None:
        """Show the last picture, if there is one, or hide it."""
        if self._handle is not None:
            self._handle.visible = shown

    def draw(self, kind: str, pixels: NDArray[np.uint8]) -> None:
        follows = self._clock() - self._drawn_at < SETTLE_SECONDS
        self._drawn_at = self._clock()
        smaller = narrowed(pixels, SHOWN_WIDTH_PIXELS, smooth=kind != "segmentation") if follows else pixels
        self._whole = None if smaller is pixels else (kind, pixels)
        self._send(kind, smaller)

    def settle(self) -> None:
        """Send the last picture in full size, if no other has followed within `SETTLE_SECONDS`."""
        if self._whole is not None and self.visible and self._clock() - self._drawn_at >= SETTLE_SECONDS:
            self._send(*self._whole)
            self._whole = None

    def _send(self, kind: str, pixels: NDArray[np.uint8]) -> None:
        if self._handle is None:
            with self._container:
                self._handle = self._server.gui.add_image(pixels, format=image_format(kind), jpeg_quality=80)
            return
        self._handle.format, self._handle.image, self._handle.visible = image_format(kind), pixels, True


@dataclass
class _Camera:
    info: CameraInfo
    ticks: dict[str, Field]
    captions: dict[str, viser.GuiHtmlHandle]
    folder: viser.GuiFolderHandle
    facts: viser.GuiHtmlHandle
    images: dict[str, CameraImage]
    depth_span: DepthRange | None = None
    drawn: tuple[Picture, tuple[str, ...]] | None = None
    """The picture and the modalities that its images show."""
    stale: bool = False
    """Whether its pictures are marked as pictures of another moment."""
    failed: str = ""
    """Reason why the camera cannot be drawn; empty if it can."""
    hidden: tuple[str, ...] = ()
    """Names of objects that the task hides from the camera."""


class CamerasPanel:
    """One folder per camera, with a checkbox per modality.

    A picture takes 50 to 100 ms without a GPU, and viser does not report which tab is open, so only ticked modalities are
    rendered.

    Args:
        no_camera: The note for a task without cameras.
        studio_shows: Returns the modality that the Studio shows of the camera that is being placed.
        is_shown: Returns whether any page may show the panel and the Studio; if not, few pictures are sent.
    """

    does = (ShowPictures,)

    def __init__(
        self,
        server: viser.ViserServer,
        no_camera: str = "This task has no camera yet.",
        studio_shows: Callable[[], str] = lambda: COLOUR,
        is_shown: Callable[[], bool] = lambda: True,
        clock: Clock = time.monotonic,
    ) -> None:
        self._no_camera, self._studio_shows, self._is_shown = no_camera, studio_shows, is_shown
        self._server, self._clock = server, clock
        self._cameras: dict[tuple[CameraKind, str], _Camera] = {}
        self._ticked: dict[tuple[CameraKind, str, str], bool] = {}
        """Whether each modality of each camera is ticked; entries of removed cameras are kept, since they may
        come back."""
        self._cameras_serial = -1
        self._due = DrawThrottle(PICTURE_PERIOD_SECONDS, clock)
        self._note = server.gui.add_html(render("note", text="Pictures appear when the task has loaded."))
        self._folder = server.gui.add_folder(None)

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ShowPictures(kind=kind, name=name, modality=modality, on=on):
                if (kind, name, modality) not in self._ticked:
                    raise Refused(f"There is no {kind} camera {name} with the modality {modality}.")
                self._ticked[kind, name, modality] = on

    def draw(self, seen: ShownCameras | None) -> None:
        for key, camera in self._cameras.items():
            for modality, field in camera.ticks.items():
                field.show(self._ticked[(*key, modality)])
        if seen is None:
            return
        if seen.cameras_serial != self._cameras_serial:
            self._cameras_serial = seen.cameras_serial
            self._build(seen)
        self._mark(seen)
        self._draw_places()
        for camera in self._cameras.values():
            for image in camera.images.values():
                image.settle()
        if not self._due.is_due((seen.pictures_serial, seen.env), hidden=not self._is_shown()):
            return
        for key, camera in self._cameras.items():
            picture = seen.pictures.get(key)
            if picture is None or picture.env != seen.env:
                continue
            # Do not send the same picture again: the browser would decode it again.
            wanted = self._wanted(camera)
            if camera.drawn is None or camera.drawn[0] is not picture or camera.drawn[1] != wanted:
                camera.drawn = (picture, wanted)
                self._draw_camera(camera, picture, seen)

    def shown_pictures(self, seen: ShownCameras) -> dict[tuple[CameraKind, str], Picture]:
        """The selected env's pictures of ticked cameras and of the camera in the Studio, for the frustums."""
        return {
            key: picture
            for key, picture in seen.pictures.items()
            if picture.env == seen.env
            and key in self._cameras
            and (key == seen.placed or self._wanted(self._cameras[key]))
        }

    def _build(self, seen: ShownCameras) -> None:
        """Make one folder per camera; a camera that still exists keeps its folder and ticks."""
        before, self._cameras = self._cameras, {}
        stay = {(c.kind, c.name): modalities_of(c) for c in seen.cameras} if seen.can_render else {}
        for key in [key for key, camera in before.items() if stay.get(key) != tuple(camera.ticks)]:
            before.pop(key).folder.remove()
        if not seen.can_render:
            note = (
                "This machine has no render device, so there are no pictures. "
                "Run workbench doctor to see what is missing."
            )
        elif not seen.cameras:
            note = self._no_camera
        else:
            note = ""
        self._note.content = render("note", text=note)
        self._note.visible = bool(note)
        if note:
            return
        first_of_kind = {}
        for camera in seen.cameras:
            first_of_kind.setdefault(camera.kind, camera.name)
        with self._folder:
            for order, info in enumerate(seen.cameras):
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
        folder = gui.add_folder(full_name(info.key))
        ticks, captions, images = {}, {}, {}
        with folder:
            about = gui.add_html("")
            for modality in modalities_of(info):
                given = {"kind": info.kind, "name": info.name, "modality": modality}
                on = self._ticked.setdefault((*info.key, modality), first and modality == "rgb")
                ticks[modality] = tick(self._server, modality, ShowPictures, "on", on, given=given)
                # The image is created with its first picture: the folder keeps its place above the caption.
                images[modality] = CameraImage(self._server, gui.add_folder(None), self._clock)
                captions[modality] = gui.add_html("")
        camera = _Camera(info, ticks, captions, folder, about, images)
        about.content = facts(camera)
        return camera

    def wanted(self, seen: ShownCameras | None) -> tuple[CameraRequest, ...]:
        """Requests for the pictures that the panel shows."""
        if seen is None:
            return ()
        return tuple(
            CameraRequest(camera.info.name, camera.info.kind, modalities)
            for key, camera in self._cameras.items()
            if (modalities := self._wanted_of(key, camera, seen))
        )

    def _draw_places(self) -> None:
        """Show the container of each ticked picture."""
        for camera in self._cameras.values():
            ticked = self._wanted(camera)
            for modality in camera.ticks:
                shown = modality in ticked and not camera.failed
                camera.captions[modality].visible = shown
                camera.images[modality].show(shown)

    def _wanted(self, camera: _Camera) -> tuple[str, ...]:
        """The ticked modalities."""
        return tuple(modality for modality in camera.ticks if self._ticked[(*camera.info.key, modality)])

    def _wanted_of(self, key: CameraKey, camera: _Camera, seen: ShownCameras) -> tuple[str, ...]:
        """The ticked modalities; for the camera in the Studio also `rgb` and the Studio's modality, unless
        the Studio draws a preview."""
        wanted = self._wanted(camera)
        if seen.preview or key != seen.placed or not self._is_shown():
            return wanted
        return tuple(m for m in modalities_of(camera.info) if m in (COLOUR, self._studio_shows(), *wanted))

    def _mark(self, seen: ShownCameras) -> None:
        """Mark cameras that cannot be drawn, and shown pictures that are not of the present moment."""
        for key, camera in self._cameras.items():
            picture = seen.pictures.get(key)
            here = picture is not None and picture.env == seen.env
            stale = not here and any(image.visible for image in camera.images.values())
            hidden = seen.hidden if camera.info.kind == "sensor" else ()
            marks = stale, seen.failed.get(key, ""), hidden
            if marks != (camera.stale, camera.failed, camera.hidden):
                camera.stale, camera.failed, camera.hidden = marks
                camera.facts.content = facts(camera)

    def _draw_camera(self, camera: _Camera, picture: Picture, seen: ShownCameras) -> None:
        if picture.depth is not None:
            camera.depth_span = depth_span(camera.depth_span, picture)
        for modality in self._wanted(camera):
            coloured = in_colours(picture, modality, seen.segmentation, camera.depth_span)
            if coloured is None:
                continue
            pixels, caption = coloured
            if modality == COLOUR:
                took = "" if seen.milliseconds is None else f"{seen.milliseconds:.0f}"
                caption = render("rgb_caption", milliseconds=took, degree=picture.degree)
            camera.images[modality].draw(modality, pixels)
            camera.captions[modality].content = caption


class StudioPicture:
    """The chosen camera's picture in the present container, in any modality; overlays go into `folder`.

    Depth and segmentation are offered because they are the first to show that a far plane is too near, or
    that a gripper hides the cube.
    """

    def __init__(self, server: viser.ViserServer, clock: Clock = time.monotonic) -> None:
        self._server = server
        self._drawn: tuple[CameraKey, Picture, str] | None = None
        self._clock, self._drawn_at = clock, -math.inf
        self._span: DepthRange | None = None
        self._wanted = COLOUR
        self.kinds: tuple[str, ...] = (COLOUR,)
        """Modalities of the chosen camera, `rgb` first."""
        self.folder = server.gui.add_folder(None)
        with self.folder:
            server.gui.add_html(render("studio_picture"))
        self._picture = CameraImage(server, self.folder, clock=clock)
        self._caption = server.gui.add_html("", visible=False)

    @property
    def shows(self) -> str:
        """The modality to render of the chosen camera."""
        return self._wanted if self._wanted in self.kinds else COLOUR

    def show_kind(self, kind: str) -> None:
        self._wanted = kind

    @property
    def visible(self) -> bool:
        return self._picture.visible

    def draw(self, view: SessionView) -> None:
        studio, key = view.of(StudioView), view.of(StudioView).selected
        chosen = studio.chosen
        preview = studio.preview_scale != 1.0
        gives = (COLOUR,) if chosen is None else modalities_of(chosen.info)
        self.kinds = tuple(kind for kind in gives if not preview or kind in PREVIEW_MODALITIES)
        picture = None if key is None else view.pictures.get(key)
        if preview:
            picture = studio.preview
        self._picture.settle()
        failed = "" if key is None else view.failed_cameras.get(key, "")
        if failed:
            self._drawn = None
            self._picture.show(False)
            self._caption.content, self._caption.visible = render("note", text=failed), True
            return
        # Keep the last picture until the next one arrives, but not a picture of another camera.
        self._picture.show(self._drawn is not None and self._drawn[0] == key)
        self._caption.visible = self.visible and bool(self._caption.content)
        kind = self.shows
        if key is None or picture is None or picture.env != view.selected_env or view.task is None:
            return
        if self._drawn is not None and (self._drawn[0], self._drawn[2]) == (key, kind):
            if self._drawn[1] is picture or self._clock() - self._drawn_at < PICTURE_PERIOD_SECONDS:
                return
        self._span = depth_span(self._span if self._drawn and self._drawn[0] == key else None, picture)
        coloured = in_colours(picture, kind, view.task.segmentation, self._span)
        if coloured is None:
            return  # the picture does not have this modality yet
        self._drawn, self._drawn_at = (key, picture, kind), self._clock()
        pixels, self._caption.content = coloured
        self._picture.draw(kind, pixels)


def full_name(key: CameraKey) -> str:
    """A camera's name as the page shows it."""
    kind, name = key
    return f"{name} · {KIND_NAMES[kind]}"


def modalities_of(info: CameraInfo) -> tuple[str, ...]:
    """The modalities that can be shown, in the page's order."""
    return tuple(modality for modality in MODALITIES if modality in info.modalities)


def facts(camera: _Camera) -> str:
    """The line below a camera's name, as HTML."""
    fovy = f"{np.degrees(camera.info.fovy):.0f}°"
    return render(
        "camera_facts",
        info=camera.info,
        fovy=fovy,
        stale=camera.stale,
        failed=camera.failed,
        hidden=listed(camera.hidden, 3),
    )


# --- picks: a press on the picture shows the body, the depth and the point ---------------------------


MARK_COLOUR = (230, 73, 128)
MARK_METRES = 0.05
"""Distance from the point to each end of its cross."""


class CameraPick:
    """Pixel picks: an overlay on the picture, the result, and a mark at the point in the 3D view.

    viser's images do not report the position of a press, so a pane of our own HTML lies over the picture
    (``.wb-pane`` in page.css). Construct a `CameraPick` in the picture's container, right after the picture.
    """

    def __init__(self, server: viser.ViserServer, session: LiveSession) -> None:
        self._drawn: object = None
        # The high order puts the pane after a picture that is added to the container later.
        self._pane = server.gui.add_html("", order=1e5, visible=False)
        self._found = server.gui.add_html("", order=1e5 + 1, visible=False)
        self._cross = line_set(server, "/picked/cross", MARK_COLOUR, 3.0)
        self._label = view_label(server, "/picked/label", "bottom-left")

    def draw(self, view: SessionView, shown: bool) -> None:
        """Draw pane and result, if they changed.

        Args:
            shown: whether the chosen camera's picture is visible.
        """
        camera, picked = view.of(StudioView).chosen, picked_here(view)
        for handle, wanted in (
            (self._pane, shown and camera is not None),
            (self._found, shown and picked is not None),
        ):
            handle.visible = wanted
        size = None if camera is None else _size(camera)
        if camera is None or not shown or (size, picked) == self._drawn:
            return
        self._drawn = (size, picked)
        self._pane.content = pane_html(camera, picked)
        if picked is not None:
            self._found.content = render("camera_found", picked=picked)

    def draw_in_view(self, view: SessionView, offset: NDArray[np.float32]) -> None:
        """Mark the picked point with a cross and the body's name.

        Args:
            offset: (3,) position of the selected env in the view, metres.
        """
        picked = picked_here(view)
        if picked is None or picked.point is None:
            self._cross.draw()
            self._label.draw()
            return
        place = np.asarray(picked.point, np.float64) + offset
        ends = np.eye(3) * MARK_METRES
        self._cross.draw(np.stack([place - ends, place + ends], axis=1))
        self._label.draw(picked.body or "", place)


def picked_here(view: SessionView) -> PickedPixel | None:
    """The pick, if it belongs to the selected camera and env."""
    picked = view.of(StudioView).results.picked
    if picked is None or picked.key != view.of(StudioView).selected or picked.env != view.selected_env:
        return None
    return picked


def pane_html(camera: StudioCamera, picked: PickedPixel | None) -> str:
    width, height = _size(camera)
    return render("camera_pane", pick=PickPixel(x=0.0, y=0.0), aspect=f"{width / height:.6f}", picked=picked)


def _size(camera: StudioCamera) -> tuple[int, int]:
    source = camera.info if camera.now is None else camera.now
    return source.width, source.height

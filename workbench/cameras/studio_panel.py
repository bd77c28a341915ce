"""The Studio, on the Cameras tab: choose a camera, place it, and write it into the file."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import PurePath

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.cameras.commands import (
    ChooseAxes,
    ChooseCamera,
    ChooseHandles,
    ChooseSnap,
    MoveCameraBack,
    MoveCameraDown,
    MoveCameraForward,
    MoveCameraLeft,
    MoveCameraRight,
    MoveCameraToView,
    MoveCameraUp,
    RedoCamera,
    ResetCamera,
    ScalePreview,
    ShowModality,
    ToggleLookThrough,
    TurnCameraDown,
    TurnCameraLeft,
    TurnCameraRight,
    TurnCameraUp,
    UndoCamera,
)
from workbench.cameras.compare_panel import CameraCompare
from workbench.cameras.edit_panel import WriteToFile
from workbench.cameras.events import CameraChosen, StudioOpened
from workbench.cameras.export_panel import CameraExport
from workbench.cameras.frustums import PlacedFrustum
from workbench.cameras.gizmo import CameraGizmo, LookThrough
from workbench.cameras.number_fields import CameraNumbers
from workbench.cameras.panel import CameraPick, StudioPicture, full_name
from workbench.cameras.pose_math import Floats, Frame, Placing, Snap, nudged, panned
from workbench.cameras.report_panel import CameraReportPanel
from workbench.cameras.suggest_panel import CameraSuggest
from workbench.cameras.view import StudioCamera, StudioView
from workbench.envs.camera_data import CameraKey, CameraSettings
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.page.command import Command, Refused
from workbench.page.commands import TellUnfolded
from workbench.page.widgets.fields import by_name, choice
from workbench.page.widgets.keys_and_palette import with_key
from workbench.page.widgets.parts import Clock, PagePart, Parts
from workbench.page.widgets.templates import render, sentence
from workbench.page.widgets.tools import Label, Tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.pictures.camera_conventions import target_of

NO_CAMERA = "none"
SNAPS = {"none": Snap(), "1 cm, 5°": Snap(0.01, 5.0), "5 cm, 15°": Snap(0.05, 15.0)}
SCALES = {"full": 1.0, "¼": 0.25, "½": 0.5, "× 2": 2.0}
TAB = "Cameras"
STEP_METRES = 0.01
"""Distance by which a key moves the camera."""
TURN_DEGREES = 1.0
"""Angle by which a key rotates the camera."""
MOVES: dict[type[Command], tuple[float, float, float]] = {
    MoveCameraLeft: (0, STEP_METRES, 0),
    MoveCameraRight: (0, -STEP_METRES, 0),
    MoveCameraUp: (0, 0, STEP_METRES),
    MoveCameraDown: (0, 0, -STEP_METRES),
    MoveCameraForward: (STEP_METRES, 0, 0),
    MoveCameraBack: (-STEP_METRES, 0, 0),
}
"""Metres (forward, left, up) by which each command moves the camera, in the camera's own frame."""
TURNS: dict[type[Command], tuple[float, float]] = {
    TurnCameraLeft: (TURN_DEGREES, 0),
    TurnCameraRight: (-TURN_DEGREES, 0),
    TurnCameraUp: (0, TURN_DEGREES),
    TurnCameraDown: (0, -TURN_DEGREES),
}
"""Degrees (left, up) by which each command rotates the camera."""
HANDLES = (
    "pose: move or rotate the camera; the target moves with the camera.\n"
    "eye and target: move the eye, while the camera keeps looking at the target; or move the target."
)
AXES = "The axes of the handles. The camera's own: red is forward, green left, blue up."
SNAP = "Dragging moves and rotates the camera in steps of this size."
SIZE = "Size of the preview above. The size of the camera's own pictures stays the same."
VARIES = (
    "The camera's pose differs between envs, or the task moves the camera. A placement here applies to all "
    "envs until the task moves the camera again."
)
IN_ITS_EYE = "Your view is at the camera's position. Move the view to see the handles."


class StudioPanel(PagePart[SessionView]):
    """The Studio. Only the chosen camera has gizmos and numbers; it is chosen here or by clicking its frustum.

    From the top: the button that shows the change of the file; the picture, in which the user checks every
    movement; the frequently used tools (look through, undo); the pose; the lens, folded.
    """

    does = (
        ChooseCamera,
        *MOVES,
        *TURNS,
        ToggleLookThrough,
        MoveCameraToView,
        ChooseHandles,
        ChooseAxes,
        ChooseSnap,
        ShowModality,
        *CameraNumbers.does,
    )

    def __init__(
        self,
        server: viser.ViserServer,
        session: LiveSession,
        pages: Callable[[], frozenset[int]],
        clock: Clock = time.monotonic,
    ) -> None:
        """
        Args:
            pages: returns the client ids of the pages that have this tab open.
        """
        self._pages = pages
        self._server, self._session = server, session
        self._placing = Placing(session)
        self._in_its_eye = False
        self._is_empty = False
        """Whether no camera is chosen and everything below the choice is hidden."""
        self._look_at, self._own_axes, self._snap = False, False, "none"
        gui = server.gui
        above = gui.add_folder(None)
        self._choice = choice(server, "Camera", ChooseCamera, "name", (NO_CAMERA,), NO_CAMERA)
        self._note = gui.add_html(render("note", text="Cameras appear when the task has loaded."))
        self._picture = StudioPicture(server, clock)
        self._shows = gui.add_html("", visible=False)
        self._facts = gui.add_html("", visible=False)
        self._tools = gui.add_html("", visible=False)
        self._look = LookThrough(server, self._placing)
        with gui.add_folder(
            "Handles and preview", expand_by_default=False, visible=False
        ) as self._handles_folder:
            self._handles = gui.add_html("")
        self._numbers = CameraNumbers(server, self._placing, look_at=lambda: self._look_at)
        self._writing = WriteToFile(server, session, self._new_from_viewer, above)
        report, compare = CameraReportPanel(server, session), CameraCompare(server, session)
        self._suggest = CameraSuggest(server, session)
        self._folders = report, compare, self._suggest, CameraExport(server, session)
        self._inner: Parts[SessionView] = Parts((self._writing, *self._folders))
        self.does = (*StudioPanel.does, *self._inner.does)
        gui.add_html(render("tell", command=TellUnfolded(panel=TAB)))
        with self._picture.folder:
            self._pick = CameraPick(server, session)
        self._gizmos: dict[int, CameraGizmo] = {}
        """The handles in the view of each page that has this tab open, by client id. A page with another tab
        open has none: there, a drag that should move the view would move the camera."""

    def unfold(self) -> None:
        """Handle the opening of the tab; the task may not be loaded yet."""
        self._session.dispatch(StudioOpened())

    @property
    def shows(self) -> str:
        """The modality to render of the chosen camera."""
        return self._picture.shows

    # --- in the view -------------------------------------------------------------------------------------

    def draw_in_view(self, view: SessionView, offset: NDArray[np.float32]) -> dict[CameraKey, PlacedFrustum]:
        """Draw the gizmos at the chosen camera. Returns the camera's frustum by the camera's key; empty if
        the camera cannot be placed.

        The frustum is at the camera's present pose: the pose of the newest picture would lag behind the
        pointer.

        Args:
            offset: (3,) position of the selected env in the view, metres.
        """
        self._placing.offset = offset
        self._suggest.draw_in_view(view, offset)
        self._pick.draw_in_view(view, offset)
        chosen = view.of(StudioView).placeable
        camera = chosen if view.timeline.shown is None else None
        self._look.draw(chosen)
        eye = None if chosen is None else self._placing.frame(chosen).to_view(_placed(chosen))
        covered = self._look.any or (eye is not None and self._is_in_eye(eye))
        self._in_its_eye = covered and not self._look.any
        self._draw_gizmos(None if covered else camera)
        if chosen is None or eye is None:
            return {}
        return {chosen.key: PlacedFrustum(eye, _placed(chosen), hidden=covered)}

    def _draw_gizmos(self, camera: StudioCamera | None) -> None:
        clients, pages = self._server.get_clients(), self._pages()
        for page in self._gizmos.keys() - pages:
            gizmo = self._gizmos.pop(page)
            if page in clients:
                gizmo.remove()
        for page in pages & clients.keys():
            if page not in self._gizmos:
                self._gizmos[page] = CameraGizmo(
                    clients[page],
                    self._placing,
                    snap=lambda: SNAPS[self._snap],
                    own_axes=lambda: self._own_axes,
                    look_at=lambda: self._look_at,
                )
            self._gizmos[page].draw(camera)

    def _is_in_eye(self, pose: Floats) -> bool:
        """Whether any page's viewpoint is within 0.1 m of the camera's pose (7,), so that the frustum's
        picture would fill that page's view."""
        near = (
            float(np.linalg.norm(c.camera.position - pose[:3])) for c in self._server.get_clients().values()
        )
        return min(near, default=1.0) < 0.1

    # --- the tab -----------------------------------------------------------------------------------------

    def draw(self, view: SessionView) -> None:
        studio = view.of(StudioView)
        self._draw_choice(view)
        self._writing.draw(view)
        chosen, camera = studio.chosen, studio.placeable
        if chosen is None and self._is_empty:
            return
        self._is_empty = chosen is None
        self._facts.visible = chosen is not None
        self._tools.visible = camera is not None
        self._handles_folder.visible = self._shows.visible = camera is not None
        self._numbers.draw(camera)
        self._picture.draw(view)
        self._pick.draw(view, shown=self._picture.visible)
        for part in self._folders:
            # Hidden without a camera, because the controls would do nothing.
            part.folder.visible = chosen is not None
            part.draw(view)
        if chosen is not None:
            self._facts.content = self._facts_of(chosen, view)
        if camera is not None:
            self._tools.content = self._tools_of(camera, studio)
            self._handles.content = self._handles_of(studio.preview_scale)
            self._shows.content = tools_html(self._shown_kinds())

    def _draw_choice(self, view: SessionView) -> None:
        studio = view.of(StudioView)
        names, chosen = [full_name(camera.key) for camera in studio.cameras], studio.chosen
        self._choice.visible = bool(names)
        self._choice.show(
            NO_CAMERA if chosen is None else full_name(chosen.key), options=by_name((NO_CAMERA, *names))
        )
        if not names:
            text = (
                "This task has no camera yet. Add a sensor below."
                if view.task is not None
                else "Cameras appear when the task has loaded."
            )
        elif studio.selected is None:
            text = "Choose a camera here, or click its frustum in the 3D view, to place it."
        else:
            text = ""
        self._note.visible = bool(text)
        if text:
            self._note.content = render("note", text=text)

    def _facts_of(self, camera: StudioCamera, view: SessionView) -> str:
        info = camera.info
        return render(
            "studio_facts",
            refused=sentence(camera.refused),
            moved=camera.moved,
            file="" if info.site is None else PurePath(info.site.file).name,
            line=None if info.site is None else info.site.line,
            mount=info.mount,
            varies=VARIES if info.varies else "",
            hint=IN_ITS_EYE if self._in_its_eye else "",
            problem=view.of(StudioView).problem,
            took=_took(camera, view),
            quick=_preview_text(camera, view.of(StudioView).preview_scale),
        )

    def _tools_of(self, camera: StudioCamera, studio: StudioView) -> str:
        looks = self._look.any
        file = (
            "Return the camera to the file's placement." if camera.moved else "The camera matches the file."
        )
        return tools_html(
            [
                Tool("Back to my view" if looks else "Look through", ToggleLookThrough(), on=looks),
                Tool("Move to my view", MoveCameraToView()),
            ],
            [
                _step_tool("Undo", UndoCamera(), studio.undo),
                _step_tool("Redo", RedoCamera(), studio.redo),
                Tool("Reset to file", ResetCamera(), file, off=not camera.moved),
            ],
        )

    def _handles_of(self, scale: float) -> str:
        """HTML of the buttons for the gizmos (what they move, their axes, their snap steps) and for the
        preview's size."""
        rows = [
            _choice(
                "Handles",
                HANDLES,
                {"pose": ChooseHandles(look_at=False), "eye and target": ChooseHandles(look_at=True)},
                ChooseHandles(look_at=self._look_at),
            ),
            _choice(
                "Axes",
                AXES,
                {"world": ChooseAxes(own=False), "camera": ChooseAxes(own=True)},
                ChooseAxes(own=self._own_axes),
                off=self._look_at,
            ),
            _choice(
                "Snap", SNAP, {name: ChooseSnap(snap=name) for name in SNAPS}, ChooseSnap(snap=self._snap)
            ),
            _choice(
                "Size",
                SIZE,
                {name: ScalePreview(scale=size) for name, size in SCALES.items()},
                ScalePreview(scale=scale),
            ),
        ]
        return tools_html(*rows)

    def _shown_kinds(self) -> list[Tool | Label]:
        """Buttons for the modality of the picture above."""
        kinds: dict[str, Command] = {kind: ShowModality(kind=kind) for kind in self._picture.kinds}
        return _choice("Shows", "What the picture shows.", kinds, ShowModality(kind=self._picture.shows))

    # --- commands ----------------------------------------------------------------------------------------

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ChooseCamera(name=name):
                self._session.dispatch(CameraChosen(self._key_of(name)))
            case ToggleLookThrough():
                self._look.toggle(visitor.client)
            case MoveCameraToView():
                self._placing.change(None, partial(self._look.settings_from, visitor.client))
            case ChooseHandles(look_at=look_at):
                self._look_at = look_at
            case ChooseAxes(own=own):
                self._own_axes = own
            case ChooseSnap(snap=name):
                if name not in SNAPS:
                    raise Refused(f"There is no snap {name!r}; choose from: {'; '.join(SNAPS)}.")
                self._snap = name
            case ShowModality(kind=kind):
                self._picture.show_kind(kind)
            case _ if isinstance(command, CameraNumbers.does):
                self._numbers.do(command, visitor)
            case _ if type(command) in self._inner.does:
                self._inner.do(command, visitor)
            case _:
                self._by_key(command)

    def _key_of(self, name: str) -> CameraKey | None:
        keys = {full_name(camera.key): camera.key for camera in self._session.view().of(StudioView).cameras}
        if name != NO_CAMERA and name not in keys:
            raise Refused(f"There is no camera {name}.")
        return keys.get(name)

    def _new_from_viewer(self, client: viser.ClientHandle, settings: CameraSettings) -> CameraSettings:
        return self._look.settings_from(client, settings, Frame(None, self._placing.offset))

    def _by_key(self, command: Command) -> None:
        """Move the camera by a key. The arrow keys without modifiers belong to the timeline."""
        # Only while a page has this tab open: nothing on the other tabs shows that a camera moves.
        if self._placing.camera is None or not self._pages():
            raise Refused("Choose a camera on the Cameras tab first.")
        if (step := MOVES.get(type(command))) is not None:
            self._move(partial(nudged, step=step), "key")
        else:
            left, up = TURNS[type(command)]
            self._move(partial(panned, left=left, up=up), "turning key")

    def _move(self, move: Callable[[Floats], Floats], control: str) -> None:
        def change(now: CameraSettings, frame: Frame) -> CameraSettings:
            moved = frame.from_view(now, move(frame.to_view(now)))
            keeps_target = self._look_at and moved.position != now.position
            return frame.turned_to(moved, target_of(now)) if keeps_target else moved

        self._placing.change(control, change)


def _step_tool(name: str, command: Command, step: str | None) -> Tool:
    hint = f"{name}: {step}" if step else f"There is nothing to {name.lower()}."
    return Tool(name, command, with_key(type(command), hint), off=step is None)


def _choice(
    label: str, hint: str, commands: dict[str, Command], now: Command, off: bool = False
) -> list[Tool | Label]:
    """A label, and buttons of which one is on.

    Args:
        now: the command of the button that is on.
    """
    tools = [Tool(name, one, " ", on=one == now, off=off, style="pill") for name, one in commands.items()]
    return [Label(label, hint), *tools]


def _placed(camera: StudioCamera) -> CameraSettings:
    assert camera.now is not None
    return camera.now


def _took(camera: StudioCamera, view: SessionView) -> str:
    """How the camera's picture was drawn and how long that took; empty if the preview has another size than the camera."""
    picture = view.pictures.get(camera.key)
    if picture is None or picture.degree is None or view.of(StudioView).preview_scale != 1.0:
        return ""
    took = view.picture_milliseconds
    return picture.degree if took is None else f"{picture.degree}, {took:.0f} ms"


def _preview_text(camera: StudioCamera, scale: float) -> str:
    if scale == 1.0 or camera.now is None:
        return ""
    width, height = round(camera.now.width * scale), round(camera.now.height * scale)
    return (
        f"The preview is {width} × {height}. The camera stays {camera.now.width} × "
        f"{camera.now.height}, and only this size is saved."
    )

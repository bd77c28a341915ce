"""The Studio tab: choose one camera, place it, and write it into the file."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import PurePath
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from viser._messages import HotkeyKey  # the type of add_command's argument (viser 1.1.1)

from workbench.core.camera_data import CameraKey, CameraSettings
from workbench.core.cameras.conventions import target_of
from workbench.session.cameras.view import StudioCamera, StudioView
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.ui.cameras.compare import CameraCompare
from workbench.ui.cameras.export import CameraExport
from workbench.ui.cameras.fields import CameraNumbers
from workbench.ui.cameras.frustums import PlacedFrustum
from workbench.ui.cameras.gizmo import CameraGizmo, LookThrough
from workbench.ui.cameras.panel import KIND_NAMES, CameraPick, StudioPicture
from workbench.ui.cameras.pose_math import Floats, Frame, Placing, Snap, nudged, panned
from workbench.ui.cameras.report import CameraReportPanel
from workbench.ui.cameras.suggest import CameraSuggest
from workbench.ui.cameras.write_to_file import WriteToFile
from workbench.ui.scene.viewpoint import ViewPanel
from workbench.ui.widgets.click_targets import Presses
from workbench.ui.widgets.hotkeys import Command
from workbench.ui.widgets.inputs import Control, refusals_told
from workbench.ui.widgets.parts import Clock, PagePart
from workbench.ui.widgets.templates import render, sentence

NO_CAMERA = "none"
SNAPS = {"none": Snap(), "1 cm, 5°": Snap(0.01, 5.0), "5 cm, 15°": Snap(0.05, 15.0)}
SCALES = {"full": 1.0, "¼": 0.25, "½": 0.5, "× 2": 2.0}
STEP = 0.01
"""Metres by which a key moves the camera."""
TURN = 1.0
"""Degrees by which a key turns it."""
VIEW = "Envs in the 3D view (O). With one alone the handles are large."
HANDLES = (
    "pose: move or rotate the camera; its target moves with it.\n"
    "eye and target: move the eye, and it keeps looking at its target; or move the target."
)
AXES = "The axes along which it is moved and rotated. The camera's own: red is forward, green left, blue up."
SNAP = "Dragging moves and rotates in steps of this size."
SIZE = "Size of the preview above. The camera keeps its own."
VARIES = (
    "Its pose differs between envs, or the task moves it: the placement here applies to all envs until then."
)
IN_ITS_EYE = "You are at its position. Move the view to see its handles."


@dataclass(frozen=True)
class Toggle:
    """A row of buttons of which one is on."""

    label: str
    hint: str
    choices: dict[str, Any]
    now: object
    choose: Callable[[Any], None]


class StudioPanel(PagePart[SessionView]):
    """The tab. Only the chosen camera has gizmos and numbers; it is chosen here or by a press on its frustum.

    From the top: the button that shows the change of the file; the picture, by which every movement is checked; what is
    used all the time (look through it, undo); the pose; the lens, folded.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        view_panel: ViewPanel,
        pages: Callable[[], frozenset[int]],
        clock: Clock = time.monotonic,
    ) -> None:
        """
        Args:
            pages: the pages that have this tab open, by client id.
        """
        self._pages = pages
        self._server, self._session, self._view_panel = server, session, view_panel
        self._placing = Placing(session)
        self._keys: tuple[CameraKey, ...] = ()
        self._names: dict[str, CameraKey | None] = {NO_CAMERA: None}
        self._in_its_eye = False
        self._is_empty = False
        """No camera is chosen, and everything below the choice is hidden."""
        self._look_at, self._own_axes, self._snap = False, False, Snap()
        gui = server.gui
        choices: tuple[str, ...] = (NO_CAMERA,)
        above = gui.add_folder(None)
        self._choice: Control[Any, Any] = Control(
            gui.add_dropdown("Camera", choices, initial_value=NO_CAMERA, visible=False),
            read=lambda name: self._names.get(name),
            send=session.studio.select,
            shown=self._name_of,
        )
        self._note = gui.add_html(render("note", text="Cameras appear when the task has loaded."))
        self._picture = StudioPicture(server, session, clock)
        self._facts = gui.add_html("", visible=False)
        self._tools = gui.add_html("", visible=False)
        self._look = LookThrough(server, self._placing)
        self._handles = gui.add_html("", visible=False)
        self._numbers = CameraNumbers(server, self._placing, look_at=lambda: self._look_at)
        self._writing = WriteToFile(server, session, self._placing, self._new_from_viewer, above)
        verdict, compare = CameraReportPanel(server, session), CameraCompare(server, session)
        self._suggest = CameraSuggest(server, session)
        self._folders = verdict, compare, self._suggest, CameraExport(server, session)
        self._presses = Presses(server)
        self._presses.when_unfolded(self._on_opened)
        self._was_opened = False
        with self._picture.folder:
            self._pick = CameraPick(server, session, self._presses)
        self._gizmos: dict[int, CameraGizmo] = {}
        """The handles in the view of each page that has this tab open, by client id. On another tab a drag that is meant for
        the view would move the camera."""

    def _on_opened(self) -> None:
        """The tab was opened, perhaps before the task was loaded."""
        self._was_opened = True
        self._choose_first(self._session.view())

    def _choose_first(self, view: SessionView) -> None:
        """Choose the first sensor camera once the tab was opened. A person may then choose none."""
        if view.studio.was_chosen or not self._was_opened or view.task is None:
            return
        cameras = sorted(view.task.cameras, key=lambda camera: camera.kind != "sensor")
        if cameras and view.studio.selected is None:
            self._session.studio.select(cameras[0].key)

    @property
    def shows(self) -> str:
        """The modality to render of the chosen camera."""
        return self._picture.shows

    @property
    def looks_through(self) -> bool:
        """Whether a page looks through the chosen camera."""
        return self._look.any

    def _name_of(self, key: CameraKey | None) -> str | None:
        return next((name for name, known in self._names.items() if known == key), NO_CAMERA)

    # --- in the view -------------------------------------------------------------------------------------

    def draw_in_view(self, view: SessionView, offset: NDArray[np.float32]) -> dict[CameraKey, PlacedFrustum]:
        """Put the gizmos on the chosen camera; return the place of its frustum.

        That is its present place, not that of its newest picture, which would lag behind the hand.

        Args:
            offset: (3,) of the selected env in the view.
        """
        self._placing.offset = offset
        self._suggest.draw_in_view(view, offset)
        self._pick.draw_in_view(view, offset)
        chosen = view.studio.placeable
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
                    snap=lambda: self._snap,
                    own_axes=lambda: self._own_axes,
                    look_at=lambda: self._look_at,
                )
            self._gizmos[page].draw(camera)

    def _is_in_eye(self, pose: Floats) -> bool:
        """Whether a page's viewpoint is at the camera: its frustum, with its picture, would fill that view."""
        near = (
            float(np.linalg.norm(c.camera.position - pose[:3])) for c in self._server.get_clients().values()
        )
        return min(near, default=1.0) < 0.1

    # --- the tab -----------------------------------------------------------------------------------------

    def draw(self, view: SessionView) -> None:
        studio = view.studio
        self._choose_first(view)
        self._draw_choice(view)
        self._writing.draw(studio)
        chosen, camera = studio.chosen, studio.placeable
        if chosen is None and self._is_empty:
            return
        self._is_empty = chosen is None
        self._facts.visible = chosen is not None
        self._tools.visible = camera is not None
        self._handles.visible = camera is not None
        self._numbers.draw(camera)
        self._picture.draw(view)
        self._pick.draw(view, shown=self._picture.visible)
        for part in self._folders:
            # Without a camera their controls would do nothing.
            part.folder.visible = chosen is not None
            part.draw(view)
        if chosen is not None:
            self._facts.content = self._facts_of(chosen, view)
        if camera is not None:
            self._tools.content = self._tools_of(camera, studio)
            several = view.task is not None and view.task.num_envs > 1
            self._handles.content = self._handles_of(studio.preview_scale, several)

    def _draw_choice(self, view: SessionView) -> None:
        studio = view.studio
        keys = tuple(camera.key for camera in studio.cameras)
        if keys != self._keys:
            self._keys = keys
            self._names = {
                NO_CAMERA: None,
                **{f"{name} · {KIND_NAMES[kind]}": (kind, name) for kind, name in keys},
            }
            self._choice.handle.options = tuple(self._names)
        self._choice.show(studio.selected)
        self._choice.handle.visible = bool(keys)
        if not keys:
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
            problem=view.studio.problem,
            took=_took(camera, view),
            quick=_preview_text(camera, view.studio.preview_scale),
        )

    def _tools_of(self, camera: StudioCamera, studio: StudioView) -> str:
        actions = self._session.studio
        looks = self._look.any
        rows = [
            [
                self._tool(
                    "Back to my view" if looks else "Look through", "", "look", self._look.toggle, on=looks
                ),
                self._tool("Move to my view", "", "put", self._put),
            ],
            [
                self._tool(
                    "Undo",
                    f"Undo: {studio.undo} (Ctrl+Z)" if studio.undo else "There is nothing to undo.",
                    "undo",
                    lambda _: actions.undo(),
                    off=studio.undo is None,
                ),
                self._tool(
                    "Redo",
                    f"Redo: {studio.redo} (Ctrl+Shift+Z)" if studio.redo else "There is nothing to redo.",
                    "redo",
                    lambda _: actions.redo(),
                    off=studio.redo is None,
                ),
                self._tool(
                    "Reset to file",
                    "Restore the placement in the file." if camera.moved else "It matches the file.",
                    "back",
                    lambda _: self._back_to_file(),
                    off=not camera.moved,
                ),
            ],
        ]
        return render("studio_tools", rows=rows)

    def _handles_of(self, scale: float, several: bool) -> str:
        """Buttons for the gizmos (pose or eye and target, axes, steps) and for the picture (modality, size).

        Args:
            several: there is more than one env. Among many the handles are a small knot.
        """
        kinds = {kind: kind for kind in self._picture.kinds}
        show = self._view_panel
        choices = {"all envs": False, "this env": True}
        envs = Toggle("View", VIEW, choices, show.only_selected, show.show_only_selected)
        toggles = (
            *((envs,) if several else ()),
            Toggle(
                "Handles",
                HANDLES,
                {"pose": False, "eye and target": True},
                self._look_at,
                self._set_look_at,
            ),
            Toggle("Axes", AXES, {"world": False, "camera": True}, self._own_axes, self._set_own_axes),
            Toggle("Snap", SNAP, SNAPS, self._snap, self._set_snap),
            Toggle(
                "Shows", "What the picture above shows.", kinds, self._picture.shows, self._picture.show_kind
            ),
            Toggle("Size", SIZE, SCALES, scale, self._session.studio.set_preview_scale),
        )
        rows = [
            [
                {"label": one.label, "hint": one.hint},
                *(
                    self._tool(
                        name,
                        "",
                        f"{one.label} {name}",
                        lambda _, one=one, value=value: one.choose(value),
                        one.now == value,
                        one.label == "Axes" and self._look_at,
                        style="pill",
                    )
                    for name, value in one.choices.items()
                ),
            ]
            for one in toggles
        ]
        return render("studio_tools", rows=rows)

    def _set_look_at(self, on: bool) -> None:
        self._look_at = on

    def _set_own_axes(self, on: bool) -> None:
        self._own_axes = on

    def _set_snap(self, snap: Snap) -> None:
        self._snap = snap

    def _tool(
        self,
        name: str,
        hint: str,
        key: str,
        pressed: Callable[[viser.ClientHandle | None], None],
        on: bool = False,
        off: bool = False,
        style: str = "button",
    ) -> dict[str, object]:
        press = self._presses.id_of(key, pressed)
        return {"name": name, "hint": hint, "on": on, "press": "" if off else press, "style": style}

    # --- presses -----------------------------------------------------------------------------------------

    def _back_to_file(self) -> None:
        key = self._session.view().studio.selected
        if key is not None:
            self._session.studio.back_to_file(key)

    def _put(self, client: viser.ClientHandle | None) -> None:
        if client is None:
            return
        with refusals_told(client):
            self._placing.change(None, partial(self._look.settings_from, client))

    def _new_from_viewer(self, client: viser.ClientHandle, settings: CameraSettings) -> CameraSettings:
        return self._look.settings_from(client, settings, Frame(None, self._placing.offset))

    def commands(self) -> list[Command]:
        """Commands with keys. The arrow keys alone belong to the timeline."""
        return [
            Command("Undo the last camera change", self._session.studio.undo, "Z", "cmd/ctrl"),
            Command("Redo the camera change", self._session.studio.redo, "Z", "cmd/ctrl+shift"),
            self._moves("left", "arrowleft", (0, STEP, 0)),
            self._moves("right", "arrowright", (0, -STEP, 0)),
            self._moves("up", "arrowup", (0, 0, STEP)),
            self._moves("down", "arrowdown", (0, 0, -STEP)),
            self._moves("forward", "pageup", (STEP, 0, 0)),
            self._moves("back", "pagedown", (-STEP, 0, 0)),
            self._turns("left", "arrowleft", TURN, 0),
            self._turns("right", "arrowright", -TURN, 0),
            self._turns("up", "arrowup", 0, TURN),
            self._turns("down", "arrowdown", 0, -TURN),
        ]

    def _moves(self, name: str, key: HotkeyKey, step: tuple[float, float, float]) -> Command:
        move = partial(self._by_key, partial(nudged, step=step), "key")
        return Command(f"Move the chosen camera {name}", move, key, "alt")

    def _turns(self, name: str, key: HotkeyKey, left: float, up: float) -> Command:
        turn = partial(self._by_key, partial(panned, left=left, up=up), "turning key")
        return Command(f"Rotate the chosen camera {name}", turn, key, "alt+shift")

    def _by_key(self, move: Callable[[Floats], Floats], control: str) -> None:
        def change(now: CameraSettings, frame: Frame) -> CameraSettings:
            moved = frame.from_view(now, move(frame.to_view(now)))
            keeps_target = self._look_at and moved.position != now.position
            return frame.turned_to(moved, target_of(now)) if keeps_target else moved

        # Not from another tab: nothing there shows that a camera moves.
        if self._placing.camera is not None and self._pages():
            self._placing.change(control, change)


def _placed(camera: StudioCamera) -> CameraSettings:
    assert camera.now is not None
    return camera.now


def _took(camera: StudioCamera, view: SessionView) -> str:
    """Of the camera's picture: how it is drawn, and how long that took; empty for one of another size than the camera's."""
    picture = view.pictures.get(camera.key)
    if picture is None or picture.degree is None or view.studio.preview_scale != 1.0:
        return ""
    took = view.picture_milliseconds
    return picture.degree if took is None else f"{picture.degree}, {took:.0f} ms"


def _preview_text(camera: StudioCamera, scale: float) -> str:
    if scale == 1.0 or camera.now is None:
        return ""
    width, height = round(camera.now.width * scale), round(camera.now.height * scale)
    return (
        f"The preview is {width} × {height}; the camera stays {camera.now.width} × "
        f"{camera.now.height}, and only that is saved."
    )

"""Writes cameras into the author's file: shows the change as a diff, makes it, checks it, and reverts it."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path, PurePath

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.cameras.commands import (
    MAX_CAMERA_NAME_CHARACTERS,
    AddCamera,
    CopyTask,
    DropCameraChange,
    DuplicateCamera,
    NameCamera,
    PlanCameraChange,
    RemoveCamera,
    RenameCamera,
    RevertCameraChange,
    SaveCameraChange,
)
from workbench.cameras.edit_state import IN_FILE
from workbench.cameras.events import EditWanted
from workbench.cameras.job_result import NewResult
from workbench.cameras.pose_math import rounded
from workbench.cameras.view import EditRequest, EditState, StudioView
from workbench.envs.camera_data import CameraKind, CameraSettings
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.page.command import Command, Refused
from workbench.page.widgets.fields import Field
from workbench.page.widgets.modality_colours import data_address
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render, sentence
from workbench.page.widgets.tools import Tool, tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.pictures.camera_conventions import axes_of, intrinsic_of, pose_of, vertical_fov

LEAVE, CLOSE = "Discard the change", "Close"
TONES = {"checked": "good", "undone": "plain", "refused": "warn", "mismatch": "bad"}
NOTHING = EditState()


class CameraChange:
    """The diff of a change with its buttons and its result, in the present container.

    The tab has two of these, one at each place where changes are requested. The buttons of a new diff are
    scrolled into view.

    Args:
        folder: Folder for a copy of the task.
    """

    def __init__(self, server: viser.ViserServer, folder: Path) -> None:
        self.arrival = NewResult()
        self._html = server.gui.add_html("", visible=False)
        self._folder = folder
        self._drawn: tuple[EditState, bool, bool] | None = None

    def draw(self, edit_state: EditState, stale: bool) -> None:
        """Show the stage of a change; an `EditState` without stage and message hides everything.

        Args:
            stale: whether the camera was moved since the change was planned.
        """
        stage = edit_state.stage
        self._html.visible = stage != "none" or bool(edit_state.message)
        drawn = None if self._drawn is None else self._drawn[0]
        if (
            drawn is not None
            and drawn.stage == stage
            and drawn.picture is None
            and edit_state.picture is not None
        ):
            # The picture of a plan arrives later and pushes the buttons out of view: scroll to them again.
            self.arrival.asked(drawn)
        new = self.arrival.just_came(edit_state if stage != "none" else None)
        if self._drawn is None or self._drawn[0] is not edit_state or self._drawn[1:] != (stale, new):
            self._drawn = edit_state, stale, new
            self._html.content = edit_html(edit_state, stale, self._folder, new)


def tools_of(edit_state: EditState, stale: bool, folder: Path) -> list[Tool]:
    """Buttons for a change; `stale` and `folder` as in `CameraChange`."""
    stage, tools = edit_state.stage, []
    if stage == "planned" and not stale:
        name = "" if edit_state.edit is None else edit_state.edit.names
        tools.append(tool(f"Save to {name}" if name else "Save", SaveCameraChange(), tone="main"))
    if stage in IN_FILE:
        tools.append(tool("Revert in the file", RevertCameraChange()))
    if edit_state.can_copy:
        hint = f"A file of your own in {folder}, under a free name; the page opens it."
        tools.append(Tool("Copy the task to my folder", CopyTask(), hint, tone="main"))
    if stage not in ("none", "written"):
        tools.append(tool(LEAVE if stage == "planned" else CLOSE, DropCameraChange()))
    return tools


def edit_html(edit_state: EditState, stale: bool, folder: Path, new: bool = False) -> str:
    """The stage of a change, as HTML.

    Args:
        folder: Folder for a copy of the task.
        new: Whether to scroll the buttons into view.
    """
    edit, planned = edit_state.edit, edit_state.stage == "planned"
    seen = edit_state.picture.rgb if planned and edit_state.picture is not None else None
    files = [] if edit is None or edit_state.stage == "undone" else edit.changes
    settings = None if edit_state.request is None else edit_state.request.settings
    tools = tools_of(edit_state, stale, folder)
    return render(
        "camera_writing",
        message="The camera was moved after this change was planned: show the change again."
        if stale
        else edit_state.message,
        tone="warn" if stale else TONES.get(edit_state.stage, "plain"),
        about=edit_state.request.about if planned and edit_state.request is not None else "",
        picture="" if seen is None else data_address(seen, PREVIEW_PIXELS),
        drawing=settings if planned and edit_state.drawing else None,
        files=[(change.file, PurePath(change.file).name, diff_lines(change.diff)) for change in files],
        folded=edit_state.stage in IN_FILE,
        notes=() if edit is None or edit_state.stage == "undone" else edit.notes,
        snippet=edit_state.snippet,
        rows=[tools] if tools else [],
        new=new,
    )


def diff_lines(diff: str) -> list[tuple[str, str]]:
    """Kind (``add``, ``del``, ``at``, ``same``) and text of each line of a unified diff, without the file names.

    The common indentation is removed, since the panel is narrow.
    """
    kinds = {"+": "add", "-": "del", "@": "at"}
    lines = [(kinds.get(line[:1], "same"), line) for line in diff.splitlines()[2:]]
    code = [line[1:] for kind, line in lines if kind != "at" and line[1:].strip()]
    indent = min((len(line) - len(line.lstrip()) for line in code), default=0)
    return [(kind, line if kind == "at" else line[:1] + " " + line[1 + indent :]) for kind, line in lines]


WITH_CHOSEN = (
    tool("Duplicate", DuplicateCamera()),
    tool("Rename", RenameCamera()),
    tool("Remove", RemoveCamera()),
)
ADD = tool("Add sensor", AddCamera(kind="sensor")), tool("Add human view", AddCamera(kind="human"))
NAME_HINT = "Letters, digits and _. If this is empty, a new camera gets a free name."
WHERE = (
    "A new sensor looks at the task's objects from where you look; a new human view is placed at your "
    "viewpoint. The new camera's picture appears before anything is saved."
)
NEW = CameraSettings(
    position=(0.0, 0.0, 0.0),
    quaternion=(1.0, 0.0, 0.0, 0.0),
    fov=1.0,
    intrinsic=None,
    width=128,
    height=128,
    near=0.01,
    far=100.0,
    shader_pack="minimal",
)
"""Settings of a new camera if the task has no fixed camera of the same kind to take them from: as in
ManiSkill's own tasks. Only the pose is replaced."""
NEW_NAMES = {"sensor": "side_camera", "human": "render_camera"}
PREVIEW_PIXELS = 256
"""Longer side of the new camera's picture."""

FromViewer = Callable[[viser.ClientHandle, CameraSettings], CameraSettings]


class WriteToFile(PagePart[SessionView]):
    """The button that shows the change of the file for the chosen camera, and the page's folder to add, copy,
    rename and remove cameras.

    Args:
        above: the page's folder for the button and its change.
        from_viewer: returns settings with the pose of a page's viewpoint, in the env's frame.
    """

    does = (
        PlanCameraChange,
        NameCamera,
        AddCamera,
        DuplicateCamera,
        RenameCamera,
        RemoveCamera,
    )

    def __init__(
        self,
        server: viser.ViserServer,
        session: LiveSession,
        from_viewer: FromViewer,
        above: viser.GuiFolderHandle,
    ) -> None:
        self._session, self._from_viewer = session, from_viewer
        gui, folder = server.gui, session.view().of(StudioView).copies_to
        self._name = ""
        self._named: EditState | None = None
        """Last change after which the name field was cleared."""
        with above:
            self._plan = gui.add_html("", visible=False)
            self._change = CameraChange(server, folder)
        with gui.add_folder("Add, copy, rename, remove", expand_by_default=False):
            self._typed = Field(
                server, "New name", NameCamera, "name", hint=NAME_HINT, longest=MAX_CAMERA_NAME_CHARACTERS
            )
            self._members = gui.add_html("")
            gui.add_html(render("aside", text=WHERE))
            self._member_change = CameraChange(server, folder)

    # --- requests --------------------------------------------------------------------------------------

    def do(self, command: Command, visitor: Visitor) -> None:
        studio = self._session.view().of(StudioView)
        match command:
            case NameCamera(name=name):
                self._name = name
            case AddCamera(kind=kind):
                self._add(kind, visitor.client)
            case _ if studio.chosen is None:
                raise Refused("Choose a camera first.")
            case PlanCameraChange() if studio.chosen.refused:
                raise Refused(sentence(studio.chosen.refused))
            case PlanCameraChange():
                self._ask(EditRequest("edit", studio.chosen.key))
            case DuplicateCamera():
                kind, like = studio.chosen.key
                name = self._checked_name(studio, kind, like)
                self._ask(EditRequest("duplicate", studio.chosen.key, name=name))
            case RenameCamera():
                name = self._checked_name(studio, studio.chosen.key[0], "")
                self._ask(EditRequest("rename", studio.chosen.key, name=name))
            case RemoveCamera():
                self._ask(EditRequest("remove", studio.chosen.key))

    def _ask(self, request: EditRequest) -> None:
        """Request a plan. Stores the present edit state first, since the answer may arrive at once."""
        change = self._change if request.what == "edit" else self._member_change
        change.arrival.asked(self._session.view().of(StudioView).edit_state)
        self._session.dispatch(EditWanted(request))

    def _add(self, kind: CameraKind, client: viser.ClientHandle) -> None:
        view = self._session.view()
        key = (kind, self._checked_name(view.of(StudioView), kind, NEW_NAMES[kind]))
        settings, words = self._from_viewer(client, lens_of_siblings(view.of(StudioView), kind)), ""
        names, places = objects_in(view)
        if kind == "sensor":
            settings, words = first_place(settings, names, places)
        settings = replace(settings, distance=distance_to(settings, places))
        self._ask(EditRequest("add", key, settings, about=words))

    def _checked_name(self, view: StudioView, kind: CameraKind, like: str) -> str:
        """The typed name; if no name is typed, a free name that begins with `like`.

        Raises:
            Refused: the name is invalid or taken, or no name is typed and `like` is empty.
        """
        name = self._name.strip()
        if not name and like:
            return free_name(view, kind, like)
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
            raise Refused(
                "Type a new name first: letters, digits and _."
                if not name
                else "A name has letters, digits and _, and does not begin with a digit."
            )
        if any(camera.key == (kind, name) for camera in view.cameras):
            raise Refused(f"There is a camera {name} already.")
        return name

    # --- drawing ---------------------------------------------------------------------------------------

    def draw(self, view: SessionView) -> None:
        studio = view.of(StudioView)
        chosen, edit_state = studio.chosen, studio.edit_state
        stale = is_stale(studio)
        can_place = chosen is not None and not chosen.refused
        of_members = edit_state.what != "edit"
        # "Show the change" is hidden while "Save" is shown: a second press on it must not write a diff that
        # the user has not read.
        can_plan = can_place and (edit_state.stage != "planned" or stale or of_members)
        wants_plan = can_plan and chosen is not None and chosen.moved and edit_state.stage != "written"
        # Before the first movement the button is disabled, not hidden: if it appeared with the movement, it
        # would push the other buttons away.
        plan = tool("Show the change", PlanCameraChange(), off=not wants_plan, tone="main")
        self._plan.visible, self._plan.content = can_plan, tools_html([plan])
        for change, here in ((self._change, not of_members), (self._member_change, of_members)):
            change.draw(edit_state if here else NOTHING, stale and here)
        if edit_state.stage == "checked" and of_members and edit_state is not self._named:
            self._named = edit_state
            self._name = ""  # the name is taken now
        self._typed.show(self._name)
        self._members.content = tools_html([] if chosen is None else WITH_CHOSEN, ADD)


def is_stale(studio: StudioView) -> bool:
    """Whether the camera was moved since its change was planned."""
    request = studio.edit_state.request
    if studio.edit_state.stage != "planned" or request is None or request.what == "add":
        return False
    camera = studio.camera(request.key)
    return camera is not None and camera.now != request.settings


def lens_of_siblings(studio: StudioView, kind: CameraKind) -> CameraSettings:
    """The file's settings of the first camera of this kind without a mount. If there is none, `NEW`, with 512
    x 512 pixels for a human camera."""
    for camera in studio.cameras:
        if camera.key[0] == kind and camera.info.mount is None and camera.info.settings is not None:
            return camera.info.settings
    return NEW if kind == "sensor" else replace(NEW, width=512, height=512)


def free_name(studio: StudioView, kind: CameraKind, like: str) -> str:
    """`like`, with a number at its end if a camera of the kind has that name."""
    taken = {camera.key for camera in studio.cameras}
    names = itertools.chain([like], (f"{like}_{number}" for number in itertools.count(2)))
    return next(name for name in names if (kind, name) not in taken)


# --- initial pose of a new sensor -------------------------------------------------------------------

# A user who adds a camera looks at a whole table, or at a grid of sixteen envs, from metres away: from there,
# a cube would be four pixels wide in a picture of 128 x 128. So the new camera keeps the direction of the
# page's view, but its eye is put where the objects of all envs fill the picture. If the page's viewpoint is
# already near that place, it becomes the eye.

MARGIN_METRES = 0.1
"""Margin around the origins of the objects."""
DISTANCE_FACTOR = 1.25
"""Factor on the distance at which the objects just fill the picture."""
MIN_DISTANCE_METRES = 0.6
"""Minimum distance: a hand that reaches for one small object must be in the picture too."""
KEEP_VIEW_FACTOR = 1.5
"""The page's viewpoint is kept if its distance from the objects is at most this factor times the wanted
distance."""
MIN_TARGET_METRES = 0.1
MAX_NAMES = 3


def first_place(
    seen_from: CameraSettings, names: tuple[str, ...], places: NDArray[np.float64]
) -> tuple[CameraSettings, str]:
    """The initial settings of a new sensor, and a sentence about its position.

    Args:
        seen_from: settings with the sensor's lens and the pose of the page's viewpoint, in the env's frame.
        names: names of the objects to see.
        places: (K, 3) positions of the objects in all envs, each in its env's frame.
    """
    stays = "It is placed at your viewpoint."
    if not len(places):
        return seen_from, stays
    pose = pose_of(seen_from)
    # Median and quantile: an object that fell off the table must not move the camera away from the others.
    middle = np.median(places, axis=0)
    reach = float(np.quantile(np.linalg.norm(places - middle, axis=1), 0.9)) + MARGIN_METRES
    fov = vertical_fov(intrinsic_of(seen_from), seen_from.height)
    wanted = max(MIN_DISTANCE_METRES, DISTANCE_FACTOR * reach / math.sin(fov / 2))
    away = float(np.linalg.norm(middle - pose[:3]))
    if away <= KEEP_VIEW_FACTOR * wanted:
        return seen_from, stays
    x, y, z = rounded(middle - wanted * axes_of(pose[3:])[0], 4)
    seen = ", ".join(names[:MAX_NAMES]) + (" and others" if len(names) > MAX_NAMES else "")
    words = f"It looks at {seen} from where you look, {wanted:.2f} m away; you are {away:.1f} m away."
    return replace(seen_from, position=(x, y, z)), words


def distance_to(settings: CameraSettings, places: NDArray[np.float64]) -> float | None:
    """Distance in metres from the eye to the point on its line of sight that is nearest to the median of
    `places` (K, 3). None if there are no places, or if the distance is less than `MIN_TARGET_METRES`."""
    if not len(places):
        return None
    pose = pose_of(settings)
    distance = float((np.median(places, axis=0) - pose[:3]) @ axes_of(pose[3:])[0])
    return None if distance < MIN_TARGET_METRES else distance


def objects_in(view: SessionView) -> tuple[tuple[str, ...], NDArray[np.float64]]:
    """Names of a task's objects that a sensor may see, and their positions (K, 3) in all envs at the shown moment."""
    task, step = view.task, view.step
    if task is None or step is None or step.poses.shape[1] != len(task.geometry.body_names):
        return (), np.zeros((0, 3))
    objects = [thing for thing in task.objects if not (thing.hidden or thing.robot)]
    bodies = {name for thing in objects for name in (thing.links or (thing.name,))}
    columns = [i for i, name in enumerate(task.geometry.body_names) if name in bodies]
    places = step.poses[:, columns, :3].reshape(-1, 3).astype(np.float64)
    return tuple(thing.name for thing in objects), places[np.isfinite(places).all(axis=1)]

"""Writes cameras into the author's file: shows the change as a diff, makes it, checks it, and takes it back."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import PurePath

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.core.camera_data import CameraKind, CameraSettings
from workbench.core.cameras.conventions import axes_of, intrinsic_of, pose_of, vertical_fov
from workbench.session.cameras.file_edits import IN_FILE
from workbench.session.cameras.view import EditRequest, EditState, StudioView
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.ui.cameras.pose_math import Placing, rounded
from workbench.ui.server.control_values import limit_text
from workbench.ui.server.viser_private import element_id
from workbench.ui.widgets.images import data_address
from workbench.ui.widgets.progress import NewResult
from workbench.ui.widgets.templates import render

LEAVE, CLOSE = "Discard the change", "Close"
MOODS = {"checked": "good", "undone": "plain", "refused": "warn", "mismatch": "bad"}
NOTHING = EditState()


class CameraChange:
    """The diff of a change with its buttons, and what came of it, in the present container.

    The tab has one at each of the two places where changes are asked for; the new one is scrolled into view.
    """

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        gui = server.gui
        self.arrival = NewResult()
        self._text = gui.add_html("", visible=False)
        self._write = gui.add_button("Save", icon=viser.Icon.DEVICE_FLOPPY, visible=False)
        self._undo = gui.add_button(
            "Revert in the file", icon=viser.Icon.ARROW_BACK_UP, color="gray", visible=False
        )
        self._copy = gui.add_button(
            "Copy the task to my folder",
            icon=viser.Icon.COPY,
            visible=False,
            hint=f"A file of your own in {session.studio.file.folder}, under a free name; the page opens it.",
        )
        self._drop = gui.add_button(LEAVE, color="gray", visible=False)
        self._write.on_click(lambda _: session.studio.file.write())
        self._undo.on_click(lambda _: session.studio.file.undo_write())
        self._copy.on_click(lambda _: session.studio.file.copy_task())
        self._drop.on_click(lambda _: session.studio.file.drop_plan())
        self._drawn: tuple[EditState, bool, bool] | None = None

    def draw(self, edit_state: EditState, stale: bool) -> None:
        """Show the stage of a change; a `EditState` without stage and message hides all.

        Args:
            stale: the camera was moved since the change was planned.
        """
        stage = edit_state.stage
        self._text.visible = stage != "none" or bool(edit_state.message)
        self._copy.visible = edit_state.can_copy
        self._write.visible = stage == "planned" and not stale
        self._drop.visible = stage not in ("none", "written")
        self._undo.visible = stage in IN_FILE
        name = "" if edit_state.edit is None else edit_state.edit.names
        self._drop.label = LEAVE if stage == "planned" else CLOSE
        self._write.label = f"Save to {name}" if name else "Save"
        drawn = None if self._drawn is None else self._drawn[0]
        if (
            drawn is not None
            and drawn.stage == stage
            and drawn.picture is None
            and edit_state.picture is not None
        ):
            # The picture of a plan comes later, and pushes the buttons out of sight.
            self.arrival.asked(drawn)
        new = self.arrival.just_came(edit_state if stage != "none" else None)
        if self._drawn is None or self._drawn[0] is not edit_state or self._drawn[1:] != (stale, new):
            self._drawn = edit_state, stale, new
            self._text.content = edit_html(edit_state, stale, element_id(self._drop) if new else "")


def edit_html(edit_state: EditState, stale: bool, scroll_to: str = "") -> str:
    """The stage of a change, as HTML.

    Args:
        scroll_to: id of the element to scroll into view.
    """
    edit, planned = edit_state.edit, edit_state.stage == "planned"
    seen = edit_state.picture.rgb if planned and edit_state.picture is not None else None
    files = [] if edit is None or edit_state.stage == "undone" else edit.changes
    settings = None if edit_state.request is None else edit_state.request.settings
    return render(
        "camera_writing",
        message="The camera has moved since: show the change again." if stale else edit_state.message,
        mood="warn" if stale else MOODS.get(edit_state.stage, "plain"),
        about=edit_state.request.about if planned and edit_state.request is not None else "",
        picture="" if seen is None else data_address(seen, PREVIEW),
        drawing=settings if planned and edit_state.drawing else None,
        files=[(change.file, PurePath(change.file).name, diff_lines(change.diff)) for change in files],
        folded=edit_state.stage in IN_FILE,
        notes=() if edit is None or edit_state.stage == "undone" else edit.notes,
        snippet=edit_state.snippet,
        scroll_to=scroll_to,
    )


def diff_lines(diff: str) -> list[tuple[str, str]]:
    """Kind (``add``, ``del``, ``at``, ``same``) and text of each line of a unified diff, without the file names.

    The common indentation is left out: the panel is narrow.
    """
    kinds = {"+": "add", "-": "del", "@": "at"}
    lines = [(kinds.get(line[:1], "same"), line) for line in diff.splitlines()[2:]]
    code = [line[1:] for kind, line in lines if kind != "at" and line[1:].strip()]
    indent = min((len(line) - len(line.lstrip()) for line in code), default=0)
    return [(kind, line if kind == "at" else line[:1] + " " + line[1 + indent :]) for kind, line in lines]


DUPLICATE, RENAME, REMOVE = "Duplicate", "Rename", "Remove"
ADD_SENSOR, ADD_HUMAN = "Add sensor", "Add human view"
WHERE = (
    "A new sensor looks at the task's objects from where you look; a human view is placed at your viewpoint. Its picture "
    "follows in a moment, before anything is saved."
)
LONGEST_NAME = 64
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
"""Settings, without the pose, of the first camera of a kind: those of ManiSkill's own tasks."""
NEW_NAMES = {"sensor": "side_camera", "human": "render_camera"}
PREVIEW = 256
"""Pixels of the longer side of the new camera's picture."""

FromViewer = Callable[[viser.ClientHandle, CameraSettings], CameraSettings]


class WriteToFile:
    """The button that writes the chosen camera's placement, and the folder to add, copy, rename and remove cameras.

    Args:
        above: gets the button and its change.
        from_viewer: these settings at a page's viewpoint, in the env's frame.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        placing: Placing,
        from_viewer: FromViewer,
        above: viser.GuiFolderHandle,
    ) -> None:
        self._session, self._placing, self._from_viewer = session, placing, from_viewer
        gui = server.gui
        self._named: EditState | None = None
        """The last change after which the field for a name was emptied."""
        with above:
            # Disabled, not hidden: coming with the first movement it would push the controls below away.
            self._plan = gui.add_button("Show the change", icon=viser.Icon.FILE_DIFF, visible=False)
            self._change = CameraChange(server, session)
        with gui.add_folder("Add, copy, rename, remove", expand_by_default=False):
            self._name = gui.add_text(
                "New name",
                "",
                hint="Letters, digits, - and _. A new camera gets a name if this is empty.",
            )
            limit_text(self._name, LONGEST_NAME)
            self._with_chosen = gui.add_button_group("", (DUPLICATE, RENAME, REMOVE), visible=False)
            add = gui.add_button_group("", (ADD_SENSOR, ADD_HUMAN))
            self._why_not = gui.add_html("", visible=False)
            gui.add_html(render("aside", text=WHERE))
            self._member_change = CameraChange(server, session)
        self._plan.on_click(lambda _: self._plan_write())
        self._with_chosen.on_click(self._on_member)
        add.on_click(self._on_member)

    # --- requests --------------------------------------------------------------------------------------

    def _plan_write(self) -> None:
        camera = self._placing.camera
        if camera is not None:
            self._ask(EditRequest("edit", camera.key))

    def _ask(self, request: EditRequest) -> None:
        """Ask for a plan. Notes the place first: the answer may come at once."""
        self._say("")
        change = self._change if request.what == "edit" else self._member_change
        change.arrival.asked(self._session.view().studio.edit_state)
        self._session.studio.file.plan(request)

    def _on_member(self, event: viser.GuiEvent) -> None:
        try:
            self._plan_member(event.target.value, event.client)
        except ValueError as error:
            self._say(str(error))

    def _say(self, why_not: str) -> None:
        """Show a refusal next to the buttons."""
        self._why_not.visible = bool(why_not)
        self._why_not.content = render("warning", text=why_not) if why_not else ""

    def _plan_member(self, what: object, client: viser.ClientHandle | None) -> None:
        view = self._session.view()
        chosen = view.studio.chosen
        if what in (ADD_SENSOR, ADD_HUMAN) and client is not None:
            kind = "sensor" if what == ADD_SENSOR else "human"
            key = (kind, self._checked_name(view.studio, kind, NEW_NAMES[kind]))
            settings, words = self._from_viewer(client, lens_of_siblings(view.studio, kind)), ""
            names, places = objects_in(view)
            if kind == "sensor":
                settings, words = first_place(settings, names, places)
            settings = replace(settings, distance=distance_to(settings, places))
            self._ask(EditRequest("add", key, settings, about=words))
        elif chosen is None:
            raise ValueError("Choose the camera first.")
        elif what == REMOVE:
            self._ask(EditRequest("remove", chosen.key))
        elif what in (DUPLICATE, RENAME):
            name = self._checked_name(view.studio, chosen.key[0], chosen.key[1] if what == DUPLICATE else "")
            change = "duplicate" if what == DUPLICATE else "rename"
            self._ask(EditRequest(change, chosen.key, name=name))

    def _checked_name(self, view: StudioView, kind: CameraKind, like: str) -> str:
        """The typed name, or a free one like `like`.

        Raises:
            ValueError: neither is possible.
        """
        name = self._name.value.strip()
        if not name and like:
            return free_name(view, kind, like)
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_-]*", name):
            raise ValueError(
                "Type a new name first: letters, digits, - and _."
                if not name
                else "A name has letters, digits, - and _."
            )
        if any(camera.key == (kind, name) for camera in view.cameras):
            raise ValueError(f"There is a camera {name} already.")
        return name

    # --- drawing ---------------------------------------------------------------------------------------

    def draw(self, studio: StudioView) -> None:
        chosen, edit_state = studio.chosen, studio.edit_state
        stale = is_stale(studio)
        can_place = chosen is not None and not chosen.refused
        of_members = edit_state.what != "edit"
        # Hidden while "Save" is shown: a second press must not write a diff that was not read.
        can_plan = can_place and (edit_state.stage != "planned" or stale or of_members)
        wants_plan = can_plan and chosen is not None and chosen.moved and edit_state.stage != "written"
        self._plan.visible = can_plan
        self._plan.disabled = not wants_plan
        for change, here in ((self._change, not of_members), (self._member_change, of_members)):
            change.draw(edit_state if here else NOTHING, stale and here)
        if edit_state.stage == "checked" and of_members and edit_state is not self._named:
            self._named = edit_state
            self._name.value = ""  # it is taken now
        self._with_chosen.visible = chosen is not None


def is_stale(studio: StudioView) -> bool:
    """Whether the camera was moved since its change was planned."""
    request = studio.edit_state.request
    if studio.edit_state.stage != "planned" or request is None or request.what == "add":
        return False
    camera = studio.camera(request.key)
    return camera is not None and camera.now != request.settings


def lens_of_siblings(studio: StudioView, kind: CameraKind) -> CameraSettings:
    """The file's settings of the first camera of this kind without a mount, or else `NEW`."""
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

# A person who adds a camera looks at a whole table or a grid of sixteen from metres away, where a cube is four pixels of a
# picture of 128. So the direction of the page's view is kept, and the eye moves along it to where the objects of all envs
# fill the picture; if the view is from about there, the eye is the page's viewpoint.

AROUND = 0.1
"""Metres of room around the origins of the objects."""
ROOM = 1.25
"""Factor on the distance at which the objects just fill the picture."""
NEAREST = 0.6
"""Least metres: a hand that reaches for one small object has to be in the picture too."""
NEAR_ENOUGH = 1.5
"""Factor on the wanted distance up to which the page's viewpoint is kept."""
NEAREST_TARGET = 0.1
"""Metres."""
MOST_NAMES = 3


def first_place(
    seen_from: CameraSettings, names: tuple[str, ...], places: NDArray[np.float64]
) -> tuple[CameraSettings, str]:
    """The initial settings of a new sensor, and a sentence about its place.

    Args:
        seen_from: its lens at the page's viewpoint, in the env's frame.
        names: of the objects to see.
        places: (K, 3) of the objects in all envs, each in its env's frame.
    """
    stays = "It is placed at your viewpoint."
    if not len(places):
        return seen_from, stays
    pose = pose_of(seen_from)
    # Median and quantile: one object that fell from the table must not move the camera away from the others.
    middle = np.median(places, axis=0)
    reach = float(np.quantile(np.linalg.norm(places - middle, axis=1), 0.9)) + AROUND
    fov = vertical_fov(intrinsic_of(seen_from), seen_from.height)
    wanted = max(NEAREST, ROOM * reach / math.sin(fov / 2))
    away = float(np.linalg.norm(middle - pose[:3]))
    if away <= NEAR_ENOUGH * wanted:
        return seen_from, stays
    x, y, z = rounded(middle - wanted * axes_of(pose[3:])[0], 4)
    told = ", ".join(names[:MOST_NAMES]) + (" and others" if len(names) > MOST_NAMES else "")
    words = f"It looks at {told} from where you look, {wanted:.2f} m away; you are {away:.1f} m away."
    return replace(seen_from, position=(x, y, z)), words


def distance_to(settings: CameraSettings, places: NDArray[np.float64]) -> float | None:
    """Metres along the line of sight to the point nearest to the median of places (K, 3); None if it is behind."""
    if not len(places):
        return None
    pose = pose_of(settings)
    distance = float((np.median(places, axis=0) - pose[:3]) @ axes_of(pose[3:])[0])
    return None if distance < NEAREST_TARGET else distance


def objects_in(view: SessionView) -> tuple[tuple[str, ...], NDArray[np.float64]]:
    """Names of a task's objects that a sensor may see, and their places (K, 3) in all envs at the shown moment."""
    task, step = view.task, view.step
    if task is None or step is None or step.poses.shape[1] != len(task.geometry.body_names):
        return (), np.zeros((0, 3))
    objects = [thing for thing in task.objects if not (thing.hidden or thing.robot)]
    bodies = {name for thing in objects for name in (thing.links or (thing.name,))}
    columns = [i for i, name in enumerate(task.geometry.body_names) if name in bodies]
    places = step.poses[:, columns, :3].reshape(-1, 3).astype(np.float64)
    return tuple(thing.name for thing in objects), places[np.isfinite(places).all(axis=1)]

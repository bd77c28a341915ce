"""A camera's way into the author's file: the change is shown, made, checked, and can be taken back.

Nothing is written that was not read first: one button shows what would change, as a diff, and only beside the diff
is the button that makes it. What comes after (the reload, the comparison of the new env's camera with what was
asked for) is said in the same place, so that "written" is never the last word of a change that did not work. A
plan says where the camera stood when it was made; if the camera was moved since, the plan is asked for anew.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import PurePath

import viser

from workbench.core.camera_settings import CameraKey, CameraSettings
from workbench.session.session import Session
from workbench.session.studio_view import StudioCamera, StudioView, Writing
from workbench.ui.changed import fill, show
from workbench.ui.checked import checked_text
from workbench.ui.fragments import render
from workbench.ui.placing import Placing

DUPLICATE, RENAME, REMOVE = "Duplicate", "Rename", "Remove"
ADD_SENSOR, ADD_HUMAN = "Add a sensor", "Add one for people"
LEAVE, CLOSE = "Leave the file as it is", "Close"
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
"""A camera that is added, but for its place: what ManiSkill's own tasks have."""
MOODS = {"checked": "good", "undone": "plain", "refused": "warn", "mismatch": "bad"}
DONE = ("written", "checked", "mismatch")

FromViewer = Callable[[viser.ClientHandle, CameraSettings], CameraSettings]


class CameraWriting:
    """
    Args:
        from_viewer: these settings at the place from which a page's own view looks, in the env's frame.
    """

    def __init__(
        self, server: viser.ViserServer, session: Session, placing: Placing, from_viewer: FromViewer
    ) -> None:
        self._session, self._placing, self._from_viewer = session, placing, from_viewer
        gui = server.gui
        self._planned: tuple[CameraKey, CameraSettings | None] | None = None
        """Whose plan it is, and how that camera was placed then."""
        # Always there: one that came with the first movement would push what is under it out of the hand.
        self._plan = gui.add_button("Show the change", icon=viser.Icon.FILE_DIFF, visible=False)
        self._text = gui.add_html("", visible=False)
        self._write = gui.add_button("Write it", icon=viser.Icon.DEVICE_FLOPPY, color="green", visible=False)
        self._undo = gui.add_button(
            "Take it back out of the file", icon=viser.Icon.ARROW_BACK_UP, color="gray", visible=False
        )
        self._copy = gui.add_button(
            "Copy the task into my folder",
            icon=viser.Icon.COPY,
            visible=False,
            hint=f"A file of your own in {session.studio.folder}, under a name that is free; the page opens it.",
        )
        self._drop = gui.add_button(LEAVE, color="gray", visible=False)
        self._name: viser.GuiTextHandle | None = None
        self._with_chosen: viser.GuiButtonGroupHandle | None = None
        self._plan.on_click(lambda _: self._plan_write())
        self._write.on_click(lambda _: session.studio.write())
        self._undo.on_click(lambda _: session.studio.undo_write())
        self._copy.on_click(lambda _: session.studio.copy_task())
        self._drop.on_click(lambda _: session.studio.drop_plan())

    def add_members(self, server: viser.ViserServer) -> None:
        """The folder that adds, copies, renames and removes: last in the tab, since it is wanted least."""
        gui = server.gui
        with gui.add_folder("Add, copy, rename, remove", expand_by_default=False):
            self._name = gui.add_text("New name", "", hint="Letters, digits, - and _.")
            self._with_chosen = gui.add_button_group("", (DUPLICATE, RENAME, REMOVE), visible=False)
            add = gui.add_button_group("", (ADD_SENSOR, ADD_HUMAN))
            gui.add_html(
                render(
                    "note", text="A new camera stands where you look from. The change is shown above first."
                )
            )
        self._with_chosen.on_click(self._on_member)
        add.on_click(self._on_member)

    # --- asked -----------------------------------------------------------------------------------------

    def _plan_write(self) -> None:
        camera = self._placing.camera
        if camera is not None:
            self._planned = camera.key, camera.now
            self._session.studio.plan_write(camera.key)

    def _on_member(self, event: viser.GuiEvent) -> None:
        try:
            self._plan_member(event.target.value, event.client)
        except ValueError as error:
            if event.client is not None:
                event.client.add_notification(
                    "Not possible", str(error), color="orange", auto_close_seconds=6.0
                )

    def _plan_member(self, what: object, client: viser.ClientHandle | None) -> None:
        studio = self._session.studio
        view = self._session.view().studio
        chosen = view.chosen
        if what in (ADD_SENSOR, ADD_HUMAN) and client is not None:
            kind = "sensor" if what == ADD_SENSOR else "human"
            settings = self._from_viewer(
                client, NEW if kind == "sensor" else replace(NEW, width=512, height=512)
            )
            key = (kind, self._checked_name(view, kind))
            self._planned = key, None
            studio.plan_add(kind, key[1], settings)
        elif chosen is None:
            raise ValueError("Choose the camera first.")
        elif what == REMOVE:
            self._planned = chosen.key, chosen.now
            studio.plan_remove(chosen.key)
        elif what in (DUPLICATE, RENAME):
            name = self._checked_name(view, chosen.key[0])
            self._planned = chosen.key, chosen.now
            (studio.plan_duplicate if what == DUPLICATE else studio.plan_rename)(chosen.key, name)

    def _checked_name(self, view: StudioView, kind: str) -> str:
        name = checked_text("" if self._name is None else self._name.value, LONGEST_NAME, "name").strip()
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_-]*", name):
            raise ValueError(
                "Type a new name first: letters, digits, - and _."
                if not name
                else "A name has letters, digits, - and _."
            )
        if any(camera.key == (kind, name) for camera in view.cameras):
            raise ValueError(f"There is a camera {name} already.")
        return name

    # --- drawn -----------------------------------------------------------------------------------------

    def draw(self, studio: StudioView) -> None:
        chosen, writing = studio.chosen, studio.writing
        stale = self._is_stale(studio)
        can_place = chosen is not None and not chosen.refused
        wants_plan = (
            chosen is not None
            and can_place
            and chosen.moved
            and (writing.stage not in ("planned", "written") or stale)
        )
        # Not at the place of the button that writes: a second press must not write what was not read.
        show(self._plan, can_place and (writing.stage != "planned" or stale))
        if self._plan.disabled == wants_plan:
            self._plan.disabled = not wants_plan
        show(self._text, writing.stage != "none" or bool(writing.message))
        show(self._copy, writing.can_copy)
        show(self._write, writing.stage == "planned" and not stale)
        show(self._drop, writing.stage in ("planned", "refused", "undone"))
        show(self._undo, writing.stage in DONE)
        leave = LEAVE if writing.stage == "planned" else CLOSE
        if self._drop.label != leave:
            self._drop.label = leave
        name = "" if writing.edit is None else writing.edit.names
        label = f"Write it to {name}" if name else "Write it"
        if self._write.label != label:
            self._write.label = label
        text = writing_html(writing, chosen, stale)
        fill(self._text, text)
        if self._with_chosen is not None:
            show(self._with_chosen, chosen is not None)

    def _is_stale(self, studio: StudioView) -> bool:
        """The camera was moved since the plan for it was made."""
        if studio.writing.stage != "planned" or self._planned is None:
            return False
        key, placed = self._planned
        camera = studio.camera(key)
        return placed is not None and camera is not None and camera.now != placed


def writing_html(writing: Writing, chosen: StudioCamera | None, stale: bool) -> str:
    """How far the change is; every value escaped."""
    edit, refusal = writing.edit, writing.refusal
    files = [] if edit is None or writing.stage == "undone" else edit.changes
    return render(
        "camera_writing",
        message="The camera was moved since: show the change again." if stale else writing.message,
        mood="warn" if stale else MOODS.get(writing.stage, "plain"),
        files=[(change.file, PurePath(change.file).name, diff_lines(change.diff)) for change in files],
        folded=writing.stage in DONE,
        notes=() if edit is None or writing.stage == "undone" else edit.notes,
        reason="" if refusal is None or refusal.reason in writing.message else refusal.reason,
        snippet="" if refusal is None else refusal.snippet,
    )


def diff_lines(diff: str) -> list[tuple[str, str]]:
    """Each line of a unified diff with its kind (``add``, ``del``, ``at``, ``same``), less the names of the files.

    The indentation that all of them have is left out: the panel is narrow.
    """
    kinds = {"+": "add", "-": "del", "@": "at"}
    lines = [(kinds.get(line[:1], "same"), line) for line in diff.splitlines()[2:]]
    code = [line[1:] for kind, line in lines if kind != "at" and line[1:].strip()]
    indent = min((len(line) - len(line.lstrip()) for line in code), default=0)
    return [(kind, line if kind == "at" else line[:1] + " " + line[1 + indent :]) for kind, line in lines]

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

import viser

from workbench.core.camera_settings import CameraKey, CameraSettings
from workbench.session.session import Session
from workbench.session.studio_view import StudioView, Writing
from workbench.ui.camera_change import CameraChange
from workbench.ui.changed import show
from workbench.ui.checked import checked_text
from workbench.ui.first_place import first_place, objects_in
from workbench.ui.fragments import render
from workbench.ui.placing import Placing

DUPLICATE, RENAME, REMOVE = "Duplicate", "Rename", "Remove"
ADD_SENSOR, ADD_HUMAN = "Add a sensor", "Add one for people"
WHERE = "A new sensor looks at the task's objects from the side that you look from; one for people stands where you look from."
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

FromViewer = Callable[[viser.ClientHandle, CameraSettings], CameraSettings]


class CameraWriting:
    """
    Args:
        from_viewer: these settings at the place from which a page's own view looks, in the env's frame.
    """

    def __init__(
        self, server: viser.ViserServer, session: Session, placing: Placing, from_viewer: FromViewer
    ) -> None:
        self._server, self._session = server, session
        self._placing, self._from_viewer = placing, from_viewer
        gui = server.gui
        self._planned: tuple[CameraKey, CameraSettings | None] | None = None
        """Whose plan it is, and how that camera was placed then."""
        self._about = ""
        """What is said of the plan beside."""
        # Always there: one that came with the first movement would push what is under it out of the hand.
        self._plan = gui.add_button("Show the change", icon=viser.Icon.FILE_DIFF, visible=False)
        self._change = CameraChange(server, session)
        self._plan.on_click(lambda _: self._plan_write())
        self._name: viser.GuiTextHandle | None = None
        self._with_chosen: viser.GuiButtonGroupHandle | None = None
        self._member_change: CameraChange | None = None
        self._of_members = False
        """The change was asked for in the folder that adds and removes."""
        self._before: Writing | None = None
        """What there was when it was asked for, which is not to be shown as its answer."""

    def add_members(self) -> None:
        """The folder that adds, copies, renames and removes: last in the tab, since it is wanted least."""
        gui = self._server.gui
        with gui.add_folder("Add, copy, rename, remove", expand_by_default=False):
            self._name = gui.add_text("New name", "", hint="Letters, digits, - and _.")
            self._with_chosen = gui.add_button_group("", (DUPLICATE, RENAME, REMOVE), visible=False)
            add = gui.add_button_group("", (ADD_SENSOR, ADD_HUMAN))
            gui.add_html(render("aside", text=WHERE))
            self._member_change = CameraChange(self._server, self._session)
        self._with_chosen.on_click(self._on_member)
        add.on_click(self._on_member)

    # --- asked -----------------------------------------------------------------------------------------

    def _plan_write(self) -> None:
        camera = self._placing.camera
        if camera is not None:
            self._ask(camera.key, camera.now, lambda: self._session.studio.file.plan_write(camera.key), False)

    def _ask(
        self,
        key: CameraKey,
        placed: CameraSettings | None,
        ask: Callable[[], None],
        of_members: bool,
        about: str = "",
    ) -> None:
        """Note what is asked for and where, and then ask: the answer may come at once."""
        self._planned, self._about = (key, placed), about
        self._of_members, self._before = of_members, self._session.view().studio.writing
        change = self._member_change if of_members else self._change
        if change is not None:
            change.arrival.asked(self._before)
        ask()

    def _on_member(self, event: viser.GuiEvent) -> None:
        try:
            self._plan_member(event.target.value, event.client)
        except ValueError as error:
            if event.client is not None:
                event.client.add_notification(
                    "Not possible", str(error), color="orange", auto_close_seconds=6.0
                )

    def _plan_member(self, what: object, client: viser.ClientHandle | None) -> None:
        file, view = self._session.studio.file, self._session.view()
        chosen = view.studio.chosen
        if what in (ADD_SENSOR, ADD_HUMAN) and client is not None:
            kind = "sensor" if what == ADD_SENSOR else "human"
            key = (kind, self._checked_name(view.studio, kind))
            if kind == "sensor":
                place = first_place(self._from_viewer(client, NEW), *objects_in(view))
                settings, about = place.settings, place.words
            else:
                settings, about = self._from_viewer(client, replace(NEW, width=512, height=512)), ""
            self._ask(key, None, lambda: file.plan_add(kind, key[1], settings), True, about)
        elif chosen is None:
            raise ValueError("Choose the camera first.")
        elif what == REMOVE:
            self._ask(chosen.key, chosen.now, lambda: file.plan_remove(chosen.key), True)
        elif what in (DUPLICATE, RENAME):
            name = self._checked_name(view.studio, chosen.key[0])
            plan = file.plan_duplicate if what == DUPLICATE else file.plan_rename
            self._ask(chosen.key, chosen.now, lambda: plan(chosen.key, name), True)

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
            and writing.stage != "written"
            and (writing.stage != "planned" or stale or self._of_members)
        )
        # Not at the place of the button that writes: a second press must not write what was not read.
        show(self._plan, can_place and (writing.stage != "planned" or stale or self._of_members))
        if self._plan.disabled == wants_plan:
            self._plan.disabled = not wants_plan
        for change, here in ((self._change, not self._of_members), (self._member_change, self._of_members)):
            if change is not None:
                shown = here and writing is not self._before
                change.draw(writing if shown else Writing(), stale and shown, self._about)
        if self._with_chosen is not None:
            show(self._with_chosen, chosen is not None)

    def _is_stale(self, studio: StudioView) -> bool:
        """The camera was moved since the plan for it was made."""
        if studio.writing.stage != "planned" or self._planned is None:
            return False
        key, placed = self._planned
        camera = studio.camera(key)
        return placed is not None and camera is not None and camera.now != placed

"""Suggests placements of a camera: objects to see, bounds of the eye, and the best results with pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.core.camera_data import CameraKey, CameraKind, CameraSettings
from workbench.core.cameras.conventions import rotation_matrix, triple
from workbench.core.cameras.report import OfferedPlacement
from workbench.jobs.task import TaskDescription
from workbench.session.cameras.view import StudioCamera
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.ui.cameras.pose_math import FARTHEST
from workbench.ui.scene.env_grid import box_corners, line_set
from workbench.ui.widgets.click_targets import Presses
from workbench.ui.widgets.images import data_address
from workbench.ui.widgets.inputs import refusals_told
from workbench.ui.widgets.progress import JobResult
from workbench.ui.widgets.templates import render

ROOM, ROOM_ON_MOUNT = 0.3, 0.1
"""Metres from the eye to each side of the first box; less for a camera on a body, which has to carry it."""
MOST_LINKS = 12
"""An articulation with more links offers none of them alone."""
OF_THE_ROBOT = 4
"""Links of a robot that are offered at first, its hand's; the others on demand."""
MOST_RESETS = 256
LARGEST = 160
ALIKE = 0.995
"""Scores of at least this are shown as 1.00."""
BOX_COLOUR = (230, 73, 128)

Corner = tuple[float, float, float]


@dataclass(frozen=True)
class VisibleObject:
    """An object or link that a suggestion can be asked to see."""

    name: str
    label: str
    first: bool
    """Chosen by default."""
    robot: str = ""
    """The robot that it is a link of; empty for the task's objects."""


class CameraSuggest:
    """The folder in the present container, and the box of the bounds in the 3D view.

    The bounds are two corners of a box in the env's frame, or in that of the body that carries the camera. They are a
    box around the eye that follows the camera until a person writes into them.
    """

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._session = session
        self._chosen: set[str] | None = None
        self._choices: tuple[VisibleObject, ...] = ()
        self._all_links = False
        self._of: CameraKey | None = None
        self._touched = False
        self._drawn_names: object = None
        with server.gui.add_folder("Suggest a placement", expand_by_default=False) as self.folder:
            self._mounted = server.gui.add_html("", visible=False)
            self._objects = server.gui.add_html("")
            self._low, self._high = (
                server.gui.add_vector3(
                    label,
                    np.zeros(3),
                    min=np.full(3, -FARTHEST),
                    max=np.full(3, FARTHEST),
                    step=0.05,
                    hint=hint,
                )
                for label, hint in (
                    (
                        "Search box from",
                        "Lowest corner of the box that the camera may be placed in, in metres.",
                    ),
                    ("Search box to", "Highest corner of that box, metres."),
                )
            )
            self._show_box = server.gui.add_checkbox(
                "Draw this box", False, hint="In the 3D view, in the selected env."
            )
            self._resets = server.gui.add_number(
                "Resets",
                8,
                min=1,
                max=MOST_RESETS,
                step=1,
                hint="Freshly reset envs in which each placement is measured; at most the number of envs.",
            )
            self._search = server.gui.add_button("Search", icon=viser.Icon.SEARCH, color="gray")
            self._offers = JobResult(server, session)
            self._presses = Presses(server)
        self._search.on_click(self._ask)
        for corner in (self._low, self._high):
            corner.on_update(self._on_touch)
        self._box = line_set(server, "/bounds of the eye", BOX_COLOUR, 2.0)

    # --- requests ------------------------------------------------------------------------------------

    def _on_touch(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            self._touched = True
            self._show_box.value = True

    def _toggle(self, name: str) -> None:
        self._chosen = self._now_chosen() ^ {name}

    def _toggle_links(self) -> None:
        self._all_links = not self._all_links

    def _now_chosen(self) -> set[str]:
        return {c.name for c in self._choices if c.first} if self._chosen is None else set(self._chosen)

    def _bounds(self) -> tuple[Corner, Corner]:
        corners = self._low.value, self._high.value
        return triple(np.minimum(*corners)), triple(np.maximum(*corners))

    def _ask(self, event: viser.GuiEvent) -> None:
        chosen = self._now_chosen()
        wanted = tuple(choice.name for choice in self._choices if choice.name in chosen)
        with refusals_told(event.client):
            if not wanted:
                raise ValueError("Choose at least one object that must be visible.")
            self._offers.asked(self._session.view().studio.results.suggestions)
            self._session.studio.reports.suggest(wanted, *self._bounds(), self._resets.value)

    # --- drawing -------------------------------------------------------------------------------------

    def draw(self, view: SessionView) -> None:
        studio, camera = view.studio, view.studio.chosen
        self._search.disabled = studio.placeable is None
        self._draw_mounted(camera)
        self._draw_bounds(camera)
        self._draw_names(view)
        now = None if camera is None else camera.now
        offered = studio.results.suggestions if studio.results.suggestions_of == studio.selected else ()
        self._offers.draw(studio.progress, offered, now, lambda new: self._offers_html(offered, now, new))

    def _draw_mounted(self, camera: StudioCamera | None) -> None:
        mount = None if camera is None else camera.info.mount
        self._mounted.visible = mount is not None
        if mount is not None:
            text = f"Mounted on {mount}: the box is in that body's frame, as it is after a reset."
            self._mounted.content = render("note", text=text)

    def _draw_bounds(self, camera: StudioCamera | None) -> None:
        if camera is None or camera.now is None:
            return
        if camera.key != self._of:
            self._of, self._touched, self._chosen = camera.key, False, None
        if self._touched:
            return
        room = ROOM if camera.info.mount is None else ROOM_ON_MOUNT
        for handle, sign in ((self._low, -1), (self._high, 1)):
            x, y, z = (round(number + sign * room, 2) for number in camera.now.position)
            handle.value = (x, y, z)

    def _draw_names(self, view: SessionView) -> None:
        key = view.studio.selected
        self._choices = () if view.task is None or key is None else choices_of(view.task, key[0])
        chosen = frozenset(self._now_chosen())
        drawn = (self._choices, chosen, self._all_links)
        if drawn == self._drawn_names:
            return
        self._drawn_names = drawn
        links = [choice for choice in self._choices if choice.robot]
        few = [c for i, c in enumerate(links) if i < OF_THE_ROBOT or self._all_links or c.name in chosen]
        self._objects.content = render(
            "camera_objects",
            objects=[self._pill(choice, chosen) for choice in self._choices if not choice.robot],
            links=[self._pill(choice, chosen) for choice in few],
            rest=len(links) - len(few),
            fewer=self._all_links and len(links) > OF_THE_ROBOT,
            more=self._presses.id_of("links", lambda _: self._toggle_links()),
        )

    def _pill(self, choice: VisibleObject, chosen: frozenset[str]) -> dict[str, object]:
        name = choice.name
        press = self._presses.id_of(("object", name), lambda _: self._toggle(name))
        return {"name": choice.label, "title": name, "on": name in chosen, "press": press}

    def _offers_html(
        self, offered: tuple[OfferedPlacement, ...], now: CameraSettings | None, new: bool
    ) -> str:
        return render(
            "camera_offers",
            new=new,
            alike=len(offered) > 1 and min(offer.score for offer in offered) >= ALIKE,
            offers=[
                {
                    "picture": "" if offer.picture.rgb is None else data_address(offer.picture.rgb, LARGEST),
                    "of": offer,
                    "taken": now is not None
                    and (offer.settings.position, offer.settings.quaternion)
                    == (now.position, now.quaternion),
                    "press": self._presses.id_of(
                        ("take", i), lambda _, i=i: self._session.studio.take_suggestion(i)
                    ),
                }
                for i, offer in enumerate(offered)
            ],
        )

    def draw_in_view(self, view: SessionView, offset: NDArray[np.float32]) -> None:
        """Draw the box of the bounds.

        Args:
            offset: (3,) of the selected env in the view.
        """
        camera = view.studio.chosen
        nowhere = camera is None or (camera.info.mount is not None and camera.mount_pose is None)
        if not self._show_box.value or nowhere or camera is None:
            self._box.draw()
            return
        edges = box_edges(*self._bounds())
        if camera.mount_pose is not None:
            mount = camera.mount_pose.astype(np.float64)
            edges = (edges @ rotation_matrix(mount[3:]).T + mount[:3]).astype(np.float32)
        self._box.draw(edges + offset)


def choices_of(task: TaskDescription, kind: CameraKind) -> tuple[VisibleObject, ...]:
    """The task's objects, their links, and links of the robots, for a camera of this kind.

    Links of several robots alternate, so that no hand comes last.
    """
    found: list[VisibleObject] = []
    robots = [thing for thing in task.objects if thing.robot]
    for thing in task.objects:
        if thing.robot or (thing.hidden and kind == "sensor"):
            continue
        found.append(VisibleObject(thing.name, thing.name, True))
        if len(thing.links) <= MOST_LINKS:
            found += [VisibleObject(name, name, False) for name in thing.links]
    for place in range(max((len(robot.links) for robot in robots), default=0)):
        for robot in robots:
            if place < len(robot.links):
                name = robot.links[place]
                label = name if len(robots) > 1 else name.removeprefix(f"{robot.name}/")
                found.append(VisibleObject(name, label, False, robot.name))
    return tuple(found)


def box_edges(low: Corner, high: Corner) -> NDArray[np.float32]:
    """(12, 2, 3) the edges of a box."""
    # A corner's index has a bit for each axis; along an edge one of them changes.
    pairs = [(i, i ^ bit) for bit in (1, 2, 4) for i in range(8) if i & bit]
    return box_corners(low, high)[np.array(pairs)].astype(np.float32)

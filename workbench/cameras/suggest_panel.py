"""Suggests placements of a camera: objects to see, the search box, and the best results with pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.cameras.commands import (
    ChooseSearchResets,
    SearchPlacements,
    SetSearchBox,
    ShowSearchBox,
    ToggleAllLinks,
    ToggleWantedObject,
    UsePlacement,
)
from workbench.cameras.events import SuggestionsWanted
from workbench.cameras.job_result import JobResult
from workbench.cameras.pose_math import chosen_camera
from workbench.cameras.view import StudioCamera, StudioView
from workbench.envs.camera_data import CameraKey, CameraKind, CameraSettings
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.page.command import Command, Refused
from workbench.page.scene.env_grid import box_corners, line_set
from workbench.page.widgets.fields import Field, tick
from workbench.page.widgets.modality_colours import data_address
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.pictures.camera_conventions import rotation_matrix, triple
from workbench.pictures.camera_report import OfferedPlacement
from workbench.task.description import TaskDescription

BOX_METRES, MOUNTED_BOX_METRES = 0.3, 0.1
"""Distance from the eye to each side of the initial box; less for a mounted camera, which must stay near the
body that carries it."""
MAX_LINKS = 12
"""If an object has at most this many links, the links are offered too; otherwise only the object is
offered."""
FIRST_ROBOT_LINKS = 4
"""Number of links of the robots that are offered at first, beginning with the hands. The others are offered
on demand."""
PICTURE_PIXELS = 160
MIN_PERFECT_SCORE = 0.995
"""Scores of at least this are shown as 1.00. If all offers have such a score, a note says how to choose."""
BOX_COLOUR = (230, 73, 128)

RESETS_HINT = "Number of freshly reset envs in which each placement is measured: at most 16, and at most the number of envs."
LOW_HINT = "Lowest corner of the box that the camera may be placed in, in metres."

Corner = tuple[float, float, float]
Box = tuple[Corner, Corner]


@dataclass(frozen=True)
class VisibleObject:
    """An object or link that suggested placements can be required to see."""

    name: str
    label: str
    first: bool
    """Whether it is chosen by default."""
    robot: str = ""
    """The robot to which the link belongs; empty for the task's objects."""


class CameraSuggest(PagePart[SessionView]):
    """The folder "Suggest a placement", in the present container, and the search box in the 3D view.

    The search box is given by two corners, in the env's frame or in the frame of the body that carries the
    camera. It is centred on the eye and follows the camera until the user edits it.
    """

    does = (
        ToggleWantedObject,
        ToggleAllLinks,
        SetSearchBox,
        ShowSearchBox,
        ChooseSearchResets,
        SearchPlacements,
    )

    def __init__(self, server: viser.ViserServer, session: LiveSession) -> None:
        self._session = session
        self._wanted: dict[CameraKey, frozenset[str]] = {}
        """Names of the objects that a camera must see, if the user chose objects for this camera."""
        self._boxes: dict[CameraKey, Box] = {}
        """Search box of each camera whose box the user edited."""
        self._all_links, self._draws_box, self._resets = False, False, 8
        self._drawn_names: object = None
        gui = server.gui
        with gui.add_folder("Suggest a placement", expand_by_default=False) as self.folder:
            self._mounted = gui.add_html("", visible=False)
            self._objects = gui.add_html("")
            self._low = self._corner_field(server, "Search box from", "from", LOW_HINT)
            self._high = self._corner_field(
                server, "Search box to", "to", "Highest corner of the box, in metres."
            )
            self._box_tick = tick(
                server,
                "Draw this box",
                ShowSearchBox,
                "on",
                self._draws_box,
                hint="In the 3D view, in the selected env.",
            )
            self._seeds = Field(
                server, "Resets", ChooseSearchResets, "resets", self._resets, hint=RESETS_HINT
            )
            self._search = gui.add_html("")
            self._offers = JobResult(server)
        self._box = line_set(server, "/bounds of the eye", BOX_COLOUR, 2.0)

    def _corner_field(self, server: viser.ViserServer, label: str, corner: str, hint: str) -> Field:
        given = [{"corner": corner, "axis": axis} for axis in range(3)]
        return Field(
            server, label, SetSearchBox, "metres", (0.0, 0.0, 0.0), given=given, hint=hint, step=0.05
        )

    # --- requests ------------------------------------------------------------------------------------

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ToggleWantedObject(name=name):
                view = self._session.view()
                camera, _ = chosen_camera(self._session)
                self._wanted[camera.key] = self._wanted_of(camera.key, choices_in(view)) ^ {name}
            case ToggleAllLinks():
                self._all_links = not self._all_links
            case SetSearchBox(corner=corner, axis=axis, metres=metres):
                camera, now = chosen_camera(self._session)
                low, high = map(list, self._box_of(camera, now))
                (low if corner == "from" else high)[axis] = metres
                self._boxes[camera.key] = triple(low), triple(high)
                self._draws_box = True
            case ShowSearchBox(on=on):
                self._draws_box = on
            case ChooseSearchResets(resets=resets):
                self._resets = resets
            case SearchPlacements():
                self._search_placements()

    def _search_placements(self) -> None:
        view = self._session.view()
        camera, now = chosen_camera(self._session)
        choices = choices_in(view)
        chosen = self._wanted_of(camera.key, choices)
        wanted = tuple(choice.name for choice in choices if choice.name in chosen)
        if not wanted:
            raise Refused("Choose at least one object that must be visible.")
        self._offers.asked(view.of(StudioView).results.suggestions)
        low, high = ordered(self._box_of(camera, now))
        self._session.dispatch(SuggestionsWanted(wanted, low, high, self._resets))

    def _wanted_of(self, key: CameraKey | None, choices: tuple[VisibleObject, ...]) -> frozenset[str]:
        by_default = frozenset(choice.name for choice in choices if choice.first)
        return by_default if key is None else self._wanted.get(key, by_default)

    def _box_of(self, camera: StudioCamera, now: CameraSettings) -> Box:
        """The search box that the user entered for this camera, or a box around its eye."""
        room = BOX_METRES if camera.info.mount is None else MOUNTED_BOX_METRES
        low, high = (np.round(np.add(now.position, by), 2) for by in (-room, room))
        return self._boxes.get(camera.key, (triple(low), triple(high)))

    # --- drawing -------------------------------------------------------------------------------------

    def draw(self, view: SessionView) -> None:
        studio, camera = view.of(StudioView), view.of(StudioView).chosen
        search = tool("Search", SearchPlacements(), off=studio.placeable is None)
        self._search.content = tools_html([search])
        self._seeds.show(self._resets)
        self._box_tick.show(self._draws_box)
        self._draw_mounted(camera)
        if camera is not None and camera.now is not None:
            low, high = self._box_of(camera, camera.now)
            self._low.show(low)
            self._high.show(high)
        self._draw_names(view)
        now = None if camera is None else camera.now
        offered = studio.results.suggestions if studio.results.suggestions_of == studio.selected else ()
        self._offers.draw(studio.progress, offered, now, lambda new: self._offers_html(offered, now, new))

    def _draw_mounted(self, camera: StudioCamera | None) -> None:
        mount = None if camera is None else camera.info.mount
        self._mounted.visible = mount is not None
        if mount is not None:
            text = f"Mounted on {mount}: the box is in this body's frame. The search uses freshly reset envs."
            self._mounted.content = render("note", text=text)

    def _draw_names(self, view: SessionView) -> None:
        choices = choices_in(view)
        chosen = self._wanted_of(view.of(StudioView).selected, choices)
        drawn = (choices, chosen, self._all_links)
        if drawn == self._drawn_names:
            return
        self._drawn_names = drawn
        links = [choice for choice in choices if choice.robot]
        few = [c for i, c in enumerate(links) if i < FIRST_ROBOT_LINKS or self._all_links or c.name in chosen]
        self._objects.content = render(
            "camera_objects",
            objects=[self._pill(choice, chosen) for choice in choices if not choice.robot],
            links=[self._pill(choice, chosen) for choice in few],
            rest=len(links) - len(few),
            fewer=self._all_links and len(links) > FIRST_ROBOT_LINKS,
            more=ToggleAllLinks(),
        )

    def _pill(self, choice: VisibleObject, chosen: frozenset[str]) -> dict[str, object]:
        name = choice.name
        press = ToggleWantedObject(name=name)
        return {"name": choice.label, "title": name, "on": name in chosen, "press": press}

    def _offers_html(
        self, offered: tuple[OfferedPlacement, ...], now: CameraSettings | None, new: bool
    ) -> str:
        return render(
            "camera_offers",
            new=new,
            alike=len(offered) > 1 and min(offer.score for offer in offered) >= MIN_PERFECT_SCORE,
            offers=[
                {
                    "picture": ""
                    if offer.picture.rgb is None
                    else data_address(offer.picture.rgb, PICTURE_PIXELS),
                    "of": offer,
                    "taken": now is not None
                    and (offer.settings.position, offer.settings.quaternion)
                    == (now.position, now.quaternion),
                    "press": UsePlacement(number=i),
                }
                for i, offer in enumerate(offered)
            ],
        )

    def draw_in_view(self, view: SessionView, offset: NDArray[np.float32]) -> None:
        """Draw the box that bounds the search for the camera's position.

        Args:
            offset: (3,) position of the selected env in the view, metres.
        """
        camera = view.of(StudioView).chosen
        nowhere = camera is None or (camera.info.mount is not None and camera.mount_pose is None)
        if not self._draws_box or nowhere or camera is None or camera.now is None:
            self._box.draw()
            return
        edges = box_edges(*ordered(self._box_of(camera, camera.now)))
        if camera.mount_pose is not None:
            mount = camera.mount_pose.astype(np.float64)
            edges = (edges @ rotation_matrix(mount[3:]).T + mount[:3]).astype(np.float32)
        self._box.draw(edges + offset)


def ordered(box: Box) -> Box:
    """The box as its lowest and its highest corner."""
    return triple(np.minimum(*box)), triple(np.maximum(*box))


def choices_in(view: SessionView) -> tuple[VisibleObject, ...]:
    """Objects that the chosen camera can be required to see."""
    key = view.of(StudioView).selected
    return () if view.task is None or key is None else choices_of(view.task, key[0])


def choices_of(task: TaskDescription, kind: CameraKind) -> tuple[VisibleObject, ...]:
    """The task's objects, their links, and links of the robots, for a camera of this kind.

    Links of several robots alternate, so that no robot's hand comes last.
    """
    found: list[VisibleObject] = []
    robots = [thing for thing in task.objects if thing.robot]
    for thing in task.objects:
        if thing.robot or (thing.hidden and kind == "sensor"):
            continue
        found.append(VisibleObject(thing.name, thing.name, True))
        if len(thing.links) <= MAX_LINKS:
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
    # A corner's index has a bit for each axis; along an edge one bit changes.
    pairs = [(i, i ^ bit) for bit in (1, 2, 4) for i in range(8) if i & bit]
    return box_corners(low, high)[np.array(pairs)].astype(np.float32)

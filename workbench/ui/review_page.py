"""The review: recordings in place of a live env, on the same page, with the same timeline and keys.

It is put together as the live page is: one loop waits until the review has something new, takes a snapshot, and every
part draws what is new to it. There is no worker and no task file; what is shown comes from the recordings. What
other parts of the program add to it (judging again, sharing) are `Part`s, which put themselves into the tab that they
belong in and are drawn with the rest.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import viser

from workbench.core.camera_settings import CameraKey
from workbench.core.pictures import Picture
from workbench.recording.library import Library
from workbench.session.messages import CameraRequest
from workbench.session.review import MOST_OPEN, Review
from workbench.session.review_events import success_words
from workbench.session.review_pictures import PictureReader
from workbench.session.review_view import ReviewView
from workbench.ui.camera_frustums import SMALL, CameraFrustums, without_the_viewpoint
from workbench.ui.cameras_panel import CamerasPanel
from workbench.ui.changed import fill
from workbench.ui.commands import Command, register
from workbench.ui.env_layout import env_under_ray
from workbench.ui.fragments import render, style_sheet
from workbench.ui.framing import Framing
from workbench.ui.library_panel import LibraryPanel
from workbench.ui.lights import light
from workbench.ui.review_as_session import as_session_view
from workbench.ui.review_compare_panel import ReviewComparePanel
from workbench.ui.review_curves import ReviewCurves
from workbench.ui.review_panel import ReviewPanel
from workbench.ui.review_scene import ReviewScene, letter, review_scene
from workbench.ui.review_timeline import ReviewTimeline
from workbench.ui.scene_view import SceneView
from workbench.ui.selection_mark import SelectionMark
from workbench.ui.timeline_panel import HEIGHT as TIMELINE_HEIGHT
from workbench.ui.view_panel import ViewPanel
from workbench.ui.viewpoint import FOV, Viewpoint, frame_all, frame_one

log = logging.getLogger(__name__)

FRAME = 1 / 30
"""Seconds, as the live page's."""
STATUS_EVERY = 0.1
"""Seconds. Faster, its numbers cannot be read."""
PANEL_WIDTH = 340
LIBRARY_WIDTH = 520
NARROW = 700
"""Pixels of the view beside the library, from which on there is room for both."""
BACK = "Back to the live env"


class Drawn(Protocol):
    def draw(self, view: ReviewView) -> None: ...


@dataclass(frozen=True)
class Places:
    """Where a `Part` may put itself: tabs, to be entered with ``with``, and the table of recordings."""

    review: viser.GuiTabHandle
    compare: viser.GuiTabHandle
    share: viser.GuiTabHandle
    tabs: viser.GuiTabGroupHandle
    """For a tab of its own."""
    library: LibraryPanel | None
    """Says which recordings are selected, and takes further buttons for them (`LibraryPanel.add_action`)."""
    make_way: Callable[[], int] = lambda: 0
    """Folds the table of recordings, for a part that opens a panel of its own; says how many pixels of the smallest
    page are between the panels then."""


Part = Callable[[viser.ViserServer, Places], "Drawn | None"]
"""Builds itself into the page; what it gives back is drawn with every new view."""


@dataclass(frozen=True)
class ReviewOffers:
    """What the review offers besides looking; what is None is not on the page."""

    on_step_back: Callable[[str, int], None] | None = None
    """Go on live from a state of a recording: its id and the state."""
    on_back: Callable[[], None] | None = None
    """Back to the live page."""
    on_rescore: Callable[[tuple[str, ...]], None] | None = None
    """Judge recordings again: their ids."""
    parts: tuple[Part, ...] = ()
    commands: tuple[Command, ...] = ()


class ReviewPage:
    """The review's page on this server.

    Args:
        server: Of viser, already behind its door.
        review: What is shown and asked.
        library: The recordings that can be opened; None leaves their table out.
        offers: What else there is on the page.
        dark: How it begins.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        review: Review,
        library: Library | None = None,
        offers: ReviewOffers | None = None,
        dark: bool = True,
    ) -> None:
        self._server, self._review = server, review
        offers = offers or ReviewOffers()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._framing = Framing(server)
        self._reader = PictureReader()
        self._requests: tuple[CameraRequest, ...] = ()
        self._pictures: dict[CameraKey, Picture] = {}
        self._pictures_serial = 0
        self._drawn_scene: ReviewScene | None = None
        self._scene_of: object = None
        self._framed: object = None
        self._labels: list[viser.LabelHandle] = []
        self._labelled: object = None
        self._had_opened = tuple(one.id for one in review.view().opened)
        self._status_at = 0.0
        self._built_for = 0
        """How many triangles the scene was built for."""

        server.scene.set_up_direction("+z")
        light(server)
        server.initial_camera.fov = FOV
        server.initial_camera.near = 0.05
        server.initial_camera.far = 300.0
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(PANEL_WIDTH)
        server.gui.set_panel_label("Recordings")

        server.gui.add_html(style_sheet())
        self._status = server.gui.add_html("")
        if offers.on_back is not None:
            go_back = server.gui.add_button(BACK, icon=viser.Icon.ARROW_BACK_UP, color="gray")
            go_back.on_click(lambda _: offers.on_back() if offers.on_back else None)
        tabs = server.gui.add_tab_group()
        review_tab = tabs.add_tab("Review", viser.Icon.PLAYER_PLAY)
        with review_tab:
            self._panel = ReviewPanel(server, review, offers.on_step_back)
        with tabs.add_tab("Cameras", viser.Icon.CAMERA):
            self._cameras_note = server.gui.add_html("")
            self._cameras = CamerasPanel(server, self, "This recording has no pictures.")
        with tabs.add_tab("Curves", viser.Icon.CHART_LINE):
            self._curves = ReviewCurves(server)
        compare_tab = tabs.add_tab("Compare", viser.Icon.ARROWS_DIFF)
        with compare_tab:
            self._compare = ReviewComparePanel(server, review)
        share_tab = tabs.add_tab("Share", viser.Icon.SHARE) if offers.parts else review_tab
        self._library_window: viser.PanelHandle | None = None
        self._library: LibraryPanel | None = None
        if library is not None:
            self._library_window = server.gui.add_panel(order=5.0)
            with self._library_window.add_tab("Library", viser.Icon.LIST_DETAILS):
                self._library = LibraryPanel(server, library, review.open)
            self._library.add_action(
                "Side by side", "Watch them all at once, each at its own place", review.open, MOST_OPEN
            )
            if offers.on_rescore is not None:
                self._library.add_action(
                    "Judge again", "Run today's reward and evaluate over them", offers.on_rescore
                )
            self._library_window.dock_left()
            self._library_window.set_width(LIBRARY_WIDTH)
        self._library_open = True
        if self._had_opened:
            self._show_library(False)
        places = Places(review_tab, compare_tab, share_tab, tabs, self._library, self._make_way)
        made = [part(server, places) for part in offers.parts]
        self._parts = tuple(part for part in made if part is not None)
        with review_tab:
            self._view_panel = ViewPanel(server, dark)
        self._timeline = ReviewTimeline(server, review)

        self._scene = SceneView(server)
        self._mark = SelectionMark(server)
        self._frustums = CameraFrustums(server)
        commands = [*self._commands(offers), *offers.commands]
        if self._library is not None:
            commands += self._library.commands()
        register(server, commands)
        with review_tab, server.gui.add_folder("Keys", expand_by_default=False):
            server.gui.add_html(render("keys", commands=commands))
        server.scene.on_click()(self._on_scene_click)

    # --- life ------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to redraw, in a thread of its own."""
        if self._thread is not None:
            raise RuntimeError("The page was started already.")
        self._thread = threading.Thread(target=self._redraw_for_ever, name="review-page", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop to redraw; returns when the loop has ended."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
        if self._library is not None:
            self._library.close()

    @property
    def dark(self) -> bool:
        return self._view_panel.dark

    def _redraw_for_ever(self) -> None:
        seen = -1
        while not self._stopping.is_set():
            began = time.monotonic()
            seen = self._review.wait(seen, timeout=0.1)
            if self._framing.follow():
                try:
                    self._review.look_at_files()
                    self.redraw()
                except Exception:
                    # A page that stands still and looks alive is worse than one that says so.
                    log.exception("The review could not be drawn; trying again.")
                    self._say_broken()
                    self._stopping.wait(1.0)
            self._stopping.wait(max(0.0, FRAME - (time.monotonic() - began)))

    def _say_broken(self) -> None:
        for client in self._server.get_clients().values():
            client.add_notification(
                "This page could not be drawn",
                "The reason is in the terminal of the workbench. It is tried again.",
                color="red",
                auto_close_seconds=5.0,
            )

    def redraw(self) -> None:
        """Draw the review as it is now."""
        view = self._review.view()
        self._take_pictures(view)
        with self._server.atomic():
            self._draw_scene(view)
        self._server.flush()
        self._make_way_for_the_first(view)
        if time.monotonic() - self._status_at >= STATUS_EVERY:
            self._status_at = time.monotonic()
            fill(self._status, status_html(view))
        self._panel.draw(view)
        self._timeline.draw(view)
        self._draw_cameras(view)
        self._curves.draw(view)
        self._compare.draw(view)
        if self._library is not None:
            self._library.draw()
        for part in self._parts:
            part.draw(view)

    def _make_way_for_the_first(self, view: ReviewView) -> None:
        """The library takes half of a small screen: once a recording is open it is a strip at the edge there."""
        ids = tuple(one.id for one in view.opened)
        if ids != self._had_opened:
            self._had_opened = ids
            if not ids or self._smallest_view() < NARROW:
                self._show_library(not ids)

    def _make_way(self) -> int:
        width = self._smallest_view() + (LIBRARY_WIDTH if self._library_open else 0)
        self._show_library(False)
        return width

    def _smallest_view(self) -> int:
        """Pixels that the view is wide, on the page on which it is smallest; 0 where nobody looks."""
        widths = [client.camera.image_width for client in self._server.get_clients().values()]
        return min((width for width in widths if width), default=0)

    def _show_library(self, shown: bool) -> None:
        self._library_open = shown
        if self._library_window is None:
            return
        if shown:
            self._library_window.expand()
        else:
            self._library_window.minimize()

    # --- cameras -----------------------------------------------------------------------------------

    def watch_cameras(self, cameras: tuple[CameraRequest, ...]) -> None:
        """Which pictures to decode: the Cameras tab asks as it asks the session."""
        self._requests = cameras

    def _take_pictures(self, view: ReviewView) -> None:
        chosen = view.chosen
        pictures = (
            {}
            if chosen is None
            else self._reader.pictures(
                chosen.episode, view.states[view.selected], self._requests, view.selected
            )
        )
        if pictures.keys() != self._pictures.keys() or any(
            pictures[key] is not known for key, known in self._pictures.items()
        ):
            self._pictures, self._pictures_serial = pictures, self._pictures_serial + 1

    def _draw_cameras(self, view: ReviewView) -> None:
        chosen = view.chosen
        fill(self._cameras_note, render("note", text=self._reader.problem) if self._reader.problem else "")
        if chosen is None:
            return
        cameras = self._reader.cameras(chosen.episode)
        self._cameras.draw(as_session_view(view, cameras, self._pictures, self._pictures_serial))

    # --- the 3-D view ------------------------------------------------------------------------------

    def _draw_scene(self, view: ReviewView) -> None:
        wanted = (view.opened_serial, self._panel.ghosts, len(view.opened))
        if wanted != self._scene_of:
            self._scene_of = wanted
            self._drawn_scene = review_scene(view.opened, self._panel.ghosts)
            if self._drawn_scene is not None:
                self._build(view, self._drawn_scene)
        scene = self._drawn_scene
        if scene is None:
            self._scene.clear()
            self._mark.clear()
            self._frustums.clear()
            self._draw_labels(view, None)
            self._framed = None
            return
        if self._built_for != self._view_panel.triangles:
            self._build(view, scene)
        self._scene.move(scene.poses(view.states), scene.layout, None)
        in_grid = len(view.opened) > 1 and not scene.ghosts
        self._mark.draw(scene.layout, view.selected, shown=in_grid, name=caption(view, view.selected))
        self._draw_labels(view, scene if in_grid else None)
        self._draw_frustums(view, scene)
        size = np.round(np.concatenate([scene.layout.low, scene.layout.high]), 0).tobytes()
        framing = (len(view.opened), scene.ghosts, size)
        if framing != self._framed:
            self._framed = framing
            self.frame()
        self._framing.frame_arrivals(self._viewpoint)

    def _build(self, view: ReviewView, scene: ReviewScene) -> None:
        self._built_for = self._view_panel.triangles
        self._scene.build(scene.geometry, scene.layout, scene.poses(view.states), None, self._built_for)

    def _draw_frustums(self, view: ReviewView, scene: ReviewScene) -> None:
        chosen = view.chosen
        if chosen is None:
            return
        alone = len(view.opened) == 1 or scene.ghosts
        pictures = self._pictures if self._cameras.show_frustums else {}
        if alone:
            human = self._human_picture()
            pictures = without_the_viewpoint(
                pictures, {} if human is None else {("human", human.camera): human}
            )
        self._frustums.draw(
            self._reader.cameras(chosen.episode), pictures, scene.layout.offsets[view.selected], SMALL
        )

    def _draw_labels(self, view: ReviewView, scene: ReviewScene | None) -> None:
        """The names of those that are not selected; the selected one's is on its frame."""
        wanted = (view.opened_serial, view.selected, None if scene is None else id(scene))
        if wanted == self._labelled:
            return
        self._labelled = wanted
        for label in self._labels:
            label.remove()
        self._labels = []
        if scene is None:
            return
        for index in range(len(view.opened)):
            if index != view.selected:
                x = scene.layout.high[0] + scene.layout.offsets[index][0]
                y = (scene.layout.low[1] + scene.layout.high[1]) / 2 + scene.layout.offsets[index][1]
                z = max(scene.layout.floor_height, min(0.0, float(scene.layout.high[2]))) + 0.01
                self._labels.append(
                    self._server.scene.add_label(
                        f"/labels/{index}", letter(index), position=(x, y, z), anchor="top-center"
                    )
                )

    def frame(self) -> None:
        """Point every open page, and those to come, at the scene."""
        if self._drawn_scene is not None:
            self._framing.frame(self._viewpoint)

    def _viewpoint(self, aspect: float, height: float) -> Viewpoint:
        scene = self._drawn_scene
        assert scene is not None, "asked only where a scene is drawn"
        if len(scene.layout.offsets) > 1 and not scene.ghosts:
            return frame_all(scene.layout, aspect, TIMELINE_HEIGHT / height)
        return frame_one(scene.layout, self._human_picture(), aspect, TIMELINE_HEIGHT / height)

    def _human_picture(self) -> Picture | None:
        """Where the recording's own camera for people stood at its start; the picture itself is not looked at."""
        chosen = self._review.view().chosen
        tracks = [] if chosen is None else chosen.episode.cameras
        return next(
            (
                Picture(t.info.name, "human", 0, t.pose[0])
                for t in tracks
                if t.info.kind == "human" and len(t.pose)
            ),
            None,
        )

    def _on_scene_click(self, event: viser.SceneClickEvent) -> None:
        scene, view = self._drawn_scene, self._review.view()
        if scene is None or scene.ghosts or len(view.opened) < 2:
            return
        index = env_under_ray(scene.layout, np.array(event.ray_origin), np.array(event.ray_direction))
        if index is not None:
            self._review.select(index)

    # --- keys --------------------------------------------------------------------------------------

    def _commands(self, offers: ReviewOffers) -> Sequence[Command]:
        review, timeline = self._review, self._timeline
        commands = [
            Command("Play or pause", review.toggle_play, "space"),
            Command("A step back in time", lambda: timeline.step_by(-1), "arrowleft"),
            Command("A step on in time", lambda: timeline.step_by(1), "arrowright"),
            Command("To the event before", lambda: timeline.to_event(-1), "arrowleft", "shift"),
            Command("To the next event", lambda: timeline.to_event(1), "arrowright", "shift"),
            Command("The first moment", review.to_first, "home"),
            Command("The last moment", review.to_last, "end"),
            Command("Next recording", lambda: self._panel.select_neighbour(1), "N"),
            Command("Previous recording", lambda: self._panel.select_neighbour(-1), "P"),
            Command("Over each other or side by side", self._panel.toggle_arrangement, "O"),
            Command("Frame what is shown", self.frame, "F"),
            Command("Open or close the library", lambda: self._show_library(not self._library_open), "B"),
            Command("Dark or light", self._view_panel.toggle_dark, "D"),
        ]
        if offers.on_step_back is not None:
            commands.append(Command("Go on live from here", self._panel.step_back, "G"))
        if offers.on_back is not None:
            commands.append(Command(BACK, offers.on_back, "V"))
        return commands


def caption(view: ReviewView, index: int) -> str:
    """The name of a recording in the view."""
    one = view.opened[index]
    seed = f", seed {one.episode.info.seed}" if one.episode.info.seed >= 0 else ""
    return f"{letter(index)}{seed}"


def status_html(view: ReviewView) -> str:
    chosen = view.chosen
    ended, mood = ("", "") if chosen is None else success_words(chosen.episode)
    return render(
        "review_status",
        loading=view.loading,
        playing=view.playing,
        word="playing" if view.playing else "paused" if view.opened else "nothing open",
        speed=f"{view.speed:g}",
        task=None if chosen is None else chosen.episode.info.task,
        name="" if chosen is None else chosen.name,
        scene="" if chosen is None or not chosen.making else chosen.scene,
        ended=ended,
        mood=mood,
        where="" if chosen is None else f"step {view.states[view.selected]} / {chosen.length}",
    )

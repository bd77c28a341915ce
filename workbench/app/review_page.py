"""The review page: shows recordings in place of a live env, with the same timeline and keys."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import viser

from workbench.app.go_live import GoLive, GoLivePart
from workbench.app.open_task import OpenTask
from workbench.app.pages import draw_apart
from workbench.app.palette_entries import add_help_topics
from workbench.app.shared import Shared
from workbench.cameras.panel import CamerasPanel
from workbench.cameras.view import ShownCameras
from workbench.envs.camera_data import CameraKey, Picture
from workbench.library.commands import OpenSideBySide, RescoreSelected
from workbench.library.folder import Library
from workbench.library.listing import Action
from workbench.library.panel import LibraryPanel
from workbench.library.rows import OpenVersion
from workbench.live.commands import TogglePlay
from workbench.live.messages import CameraRequest
from workbench.live.panels.timeline_panel import MAX_MARKS, TimeBar, event_tools, play_tool, strip_values
from workbench.live.panels.view_panel import ViewIcons, ViewPanel
from workbench.live.timeline_commands import (
    GoToFirst,
    GoToLast,
    NextEvent,
    PreviousEvent,
    Seek,
    StepBack,
    StepForward,
)
from workbench.page.command import Command, Refused
from workbench.page.commands import (
    CloseDialog,
    FrameScene,
    ShowLive,
    ShowTab,
    TellDrawnInSoftware,
    TellUnfolded,
    ToggleTable,
    ToggleTimeline,
)
from workbench.page.widgets.fields import Field, choice
from workbench.page.widgets.frame import add_bar
from workbench.page.widgets.keys_and_palette import register
from workbench.page.widgets.open_tabs import OpenTabs
from workbench.page.widgets.parts import Clock, DrawThrottle, PagePart, Parts
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Done, Visitor
from workbench.rescore.recording_jobs import Rescorer
from workbench.rescore.recordings_panel import RescoreChoices, RescorePanel
from workbench.review.body_panel import ReviewBodyPanel
from workbench.review.commands import ChoosePlaybackSpeed, RescoreChosen
from workbench.review.compare_panel import ReviewComparePanel
from workbench.review.curves_panel import ReviewCurves, ReviewNumbers
from workbench.review.panel import ReviewPanel
from workbench.review.playback import SPEEDS, Review
from workbench.review.scene_view import ReviewIn3D, shown_together
from workbench.review.state import MAX_OPEN
from workbench.review.view import PictureReader, ReviewView, column_at, outcome_text
from workbench.share.panel import Sharing
from workbench.start.panel import OpenDialog
from workbench.sweep.panel import SweepPanel

PANELS_PERIOD_SECONDS = 0.1
"""Interval at which the panels are drawn while a recording plays. Numbers that change faster cannot be
read."""
PANEL_WIDTH_PIXELS = 340
LIBRARY_WIDTH_PIXELS = 520
MIN_VIEW_PIXELS = 240
"""Minimum width of the view between the library and another panel."""
MIN_VIEW_BY_SWEEP_PIXELS = 400
"""Minimum width of the view at which the table of a sweep stays open while one of its episodes is watched;
the timeline needs most of this width."""
NARROW_VIEW_PIXELS = 700
"""Minimum width of the view at which the library stays open when a recording is opened."""
WIDTH_TIMEOUT_SECONDS = 20.0
"""Time within which a page reports the new width of its view."""
BACK = "Back to the live env"
LIBRARY = "library"
"""Name of the library panel in `TellUnfolded`."""
DOES: frozenset[type[Command]] = frozenset(
    {
        ShowLive,
        ShowTab,
        TellUnfolded,
        TellDrawnInSoftware,
        ToggleTable,
        ToggleTimeline,
        FrameScene,
        RescoreChosen,
        CloseDialog,
        *CamerasPanel.does,
    }
)
"""Commands that the page itself carries out; its parts carry out the others."""


@dataclass(frozen=True)
class ReviewTools:
    """Objects that outlive a review page."""

    go_live: GoLive
    rescorer: Rescorer
    rescore_choices: RescoreChoices
    sharing: Sharing


class ReviewPage:
    """The review page, built and redrawn like the live page, without a worker or a task file.

    Args:
        shared: The recordings and the other objects that all pages share.
        open_task: The list of tasks.
        tools: Objects that outlive the page.
        also: Further commands that all pages have.
        dark: Whether the first theme is dark.
        first_tab: Show the first tab, even in a browser that left the page on another tab.
        clock: Clock of all parts of the page.
    """

    def __init__(
        self,
        shared: Shared,
        open_task: OpenTask,
        tools: ReviewTools,
        also: frozenset[type[Command]],
        dark: bool = True,
        first_tab: bool = False,
        clock: Clock = time.monotonic,
    ) -> None:
        self._shared, self._tools, self._clock = shared, tools, clock
        self._server, self._review = server, review = shared.server, shared.recordings.review
        self._reader = PictureReader()
        self._requests: tuple[CameraRequest, ...] = ()
        self._pictures: dict[CameraKey, Picture] = {}
        self._pictures_serial = 0
        self._had_opened = tuple(one.id for one in review.view().opened)
        self._fold_other: Callable[[bool], None] = lambda folded: None
        """Folds and unfolds rerun's panel."""
        self._other_folded = False
        self._unfolded = "", 0.0
        """(name of the panel that was unfolded last, time of the unfolding); ("", 0) once the width of the
        view has been checked."""
        self._panels_due = DrawThrottle(PANELS_PERIOD_SECONDS, clock)

        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(PANEL_WIDTH_PIXELS)
        server.gui.set_panel_label(" ")  # viser's header is in the bar
        self._opening = OpenDialog(server, open_task)
        with add_bar(server):
            self._opening.add_button()
            if shared.session is not None:
                server.gui.add_html(tools_html([tool(BACK, ShowLive())]))
            self._status = server.gui.add_html("")
            server.gui.add_html(render("help_link"))
        self._open_tabs = OpenTabs(shared.visitors)
        server.gui.add_html(render("which", which="review", first_tab=first_tab, says=False))
        shared.stage.in_software.ask()
        review_tab, in_tabs = self._add_tabs(dark)
        self._timeline = ReviewTimeline(server, review)
        icons = ViewIcons(server, shared.stage.choice)
        self._in_3d = ReviewIn3D(server, review, shared.stage, self._body.select)
        self._parts = Parts((self._panel, self._timeline, icons, *in_tabs, self._opening), clock)
        if self._sweep is not None:
            self._parts.add(self._sweep)
        kinds = DOES | self._parts.does | also
        register(
            server,
            shared.visitors,
            kinds if shared.session is not None else kinds - {ShowLive},
            "review page",
        )
        add_help_topics(server, shared.visitors)

    def _add_tabs(self, dark: bool) -> tuple[viser.GuiTabHandle, list[PagePart[ReviewView]]]:
        """Add the tabs. Returns the Review tab, and the parts of all tabs."""
        server, review, shared = self._server, self._review, self._shared
        library, go_live = shared.recordings.library, self._tools.go_live
        tabs = server.gui.add_tab_group()
        review_tab = tabs.add_tab("Review", viser.Icon.PLAYER_PLAY)
        with review_tab:
            self._body = ReviewBodyPanel(server)
            self._panel = ReviewPanel(server, review, go_live.go, go_live.going)
        with tabs.add_tab("Cameras", viser.Icon.CAMERA):
            self._cameras_note = server.gui.add_html("")
            self._cameras = CamerasPanel(server, "This recording has no pictures.", clock=self._clock)
        with tabs.add_tab("Curves", viser.Icon.CHART_LINE):
            numbers, curves = ReviewNumbers(server), ReviewCurves(server)
        with tabs.add_tab("Compare", viser.Icon.ARROWS_DIFF):
            compare = ReviewComparePanel(server, review)
        share_tab = tabs.add_tab("Share", viser.Icon.SHARE)
        with tabs.add_tab("Rescore", viser.Icon.GAVEL):
            self._rescore = RescorePanel(
                server,
                self._tools.rescorer,
                review,
                library,
                self._tools.rescore_choices,
                shared.task_files,
            )
        self._add_library(library)
        with share_tab:
            sharing = self._tools.sharing
            self._share = sharing.part(server, library, self._library, self._make_way)
        with review_tab:
            going = GoLivePart(server, go_live)
            self._view_panel = ViewPanel(server, dark, shared.stage.choice)
        return review_tab, [
            self._body,
            numbers,
            curves,
            compare,
            self._library,
            self._share,
            going,
            self._view_panel,
            self._rescore,
        ]

    def _running(self) -> OpenVersion | None:
        session = self._shared.session
        task = None if session is None else session.view().task
        return None if task is None else OpenVersion(task.env_id, task.source_hash)

    def _add_library(self, library: Library) -> None:
        """Add the table of recordings in its own panel."""
        self._library_window = self._server.gui.add_panel(order=5.0)
        self._sweep = self._sweep_of(library)
        with self._library_window.add_tab("Library", viser.Icon.LIST_DETAILS):
            self._library = LibraryPanel(self._server, library, self._review.open, self._running)
            self._server.gui.add_html(render("tell", command=TellUnfolded(panel=LIBRARY)))
        self._library.add_action(
            Action(
                "Side by side",
                OpenSideBySide(),
                "Show them side by side (Shift+Enter)",
                self._open_side_by_side,
                MAX_OPEN,
            )
        )
        self._library.add_action(
            Action(
                "Rescore",
                RescoreSelected(),
                "Run the current reward and evaluate over them (J)",
                self._rescore.rescore_and_notify,
            )
        )
        self._library_window.dock_left()
        self._library_window.set_width(LIBRARY_WIDTH_PIXELS)
        self._library_open = True
        if self._had_opened and not self._review.view().library_stays:
            self._show_library(False)

    def _sweep_of(self, library: Library) -> SweepPanel | None:
        """Add the tab with the results of a sweep; returns None if the folder has no such results."""
        if library.view().sweep is None:
            return None
        with self._library_window.add_tab("Sweep", viser.Icon.ADJUSTMENTS_HORIZONTAL):
            return SweepPanel(self._server, library, self._open_of_sweep)

    def _add_late_sweep(self) -> None:
        """Add the tab of a sweep whose results arrived after the page was built."""
        if self._sweep is None and (sweep := self._sweep_of(self._shared.recordings.library)) is not None:
            self._sweep = sweep
            self._parts.add(sweep)

    def _open_of_sweep(self, ids: tuple[str, ...]) -> None:
        # If there is room, the sweep's table stays open: the user compares several of its episodes.
        self._review.open(ids, library_stays=self._smallest_view() >= MIN_VIEW_BY_SWEEP_PIXELS)

    # --- drawing ---------------------------------------------------------------------------------

    @property
    def dark(self) -> bool:
        """Whether the theme is dark."""
        return self._view_panel.dark

    def wait(self, seen: int, timeout: float) -> int:
        """See `ShownPage`."""
        return self._review.wait(seen, timeout)

    def counted(self, visitors: int) -> None:
        """Ignored: a review plays with or without viewers."""

    def close(self) -> None:
        """Release the page: it will not be shown again."""
        self._library.end()
        self._share.close()
        if self._sweep is not None:
            self._sweep.end()

    def redraw(self) -> None:
        """Draw the present state of the review."""
        view = self._review.view()
        self._take_pictures(view)
        draw_apart(self._server, lambda: self._draw_panels(view), lambda: self._draw_scene(view))

    def _draw_panels(self, view: ReviewView) -> None:
        """Draw all panels from one view; while a recording plays, less often than the 3-D view."""
        if not self._panels_due.is_due(object(), urgent=None if view.playing else object()):
            return
        self._add_late_sweep()
        self._make_way_for_the_first(view)
        self._fold_what_crowds()
        self._status.content = render(
            "review_status",
            view=view,
            going=self._tools.go_live.going(),
            outcome_text=outcome_text,
        )
        self._draw_cameras(view)
        self._parts.draw(view)

    def _draw_scene(self, view: ReviewView) -> None:
        chosen = view.chosen
        cameras = () if chosen is None else self._reader.cameras(chosen.episode)
        pictures = self._pictures if self._shared.stage.choice.frustums else {}
        self._in_3d.draw(view, self._panel.ghosts, self._view_panel.looks, cameras, pictures, self._body.body)

    def _make_way_for_the_first(self, view: ReviewView) -> None:
        """Minimize the library when a recording is opened on a small screen. On any screen, expand the
        library when all recordings are closed."""
        ids = tuple(one.id for one in view.opened)
        if view.library_stays and (ids or view.loading):
            self._had_opened = ids
            return
        if ids != self._had_opened:
            self._had_opened = ids
            if not ids or self._smallest_view() < NARROW_VIEW_PIXELS:
                self._show_library(not ids)

    def _make_way(self, fold: Callable[[bool], None]) -> int:
        self._fold_other = fold
        width = self._smallest_view() + (LIBRARY_WIDTH_PIXELS if self._library_open else 0)
        self._show_library(False)
        return width

    def _smallest_view(self) -> int:
        """Width in pixels of the smallest view of all pages; 0 without viewers."""
        widths = [client.camera.image_width for client in self._server.get_clients().values()]
        return min((width for width in widths if width), default=0)

    def _show_library(self, shown: bool) -> None:
        self._library_open = shown
        self._unfolded = "", 0.0
        if shown:
            # The folded library left its width to the view. If the view would now get too narrow, fold
            # rerun's panel.
            self._other_folded = 0 < self._smallest_view() < LIBRARY_WIDTH_PIXELS + MIN_VIEW_PIXELS
            if self._other_folded:
                self._fold_other(True)
            self._library_window.expand()
        else:
            self._library_window.minimize()
            if self._other_folded:
                self._other_folded = False
                self._fold_other(False)

    def _panel_unfolded(self, panel: str) -> None:
        """Handle a page's report: the user has unfolded this panel."""
        if panel == LIBRARY:
            self._library_open = True
        self._unfolded = panel, self._clock()

    def _fold_what_crowds(self) -> None:
        """If library and rerun leave no room for the view, fold the one that was unfolded first.

        A page reports the new width of its view late (by seconds while rerun loads), so the width is checked
        for `WIDTH_TIMEOUT_SECONDS` after a panel was unfolded.
        """
        last, since = self._unfolded
        if not last or not 0 < self._smallest_view() < MIN_VIEW_PIXELS:
            return
        self._unfolded = "", 0.0
        if self._clock() - since > WIDTH_TIMEOUT_SECONDS or not self._library_open:
            return
        if last == LIBRARY:
            self._other_folded = True
            self._fold_other(True)
        else:
            self._other_folded = False
            self._show_library(False)

    # --- cameras -----------------------------------------------------------------------------------

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
        episode = None if view.chosen is None else view.chosen.episode
        self._cameras_note.content = render("note", text=self._reader.problem) if self._reader.problem else ""
        shown = episode and ShownCameras(
            self._reader.cameras(episode),
            # A different number for each recording, since each has its own cameras.
            view.opened_serial * 1000 + view.selected,
            self._pictures,
            self._pictures_serial,
            episode.segmentation,
            view.selected,
            hidden=() if episode.geometry is None else episode.geometry.hidden_names,
        )
        self._cameras.draw(shown)
        self._requests = self._cameras.wanted(shown)

    # --- commands ----------------------------------------------------------------------------------

    def do(self, command: Command, visitor: Visitor) -> Done:
        """Carry out a command of a page. Raises `Refused`."""
        match command:
            case ShowLive():
                if self._shared.session is None:
                    raise Refused("No task is open.")
                self._shared.pages.show("live")
            case ShowTab(tab=tab, fold=fold):
                self._open_tabs.open(visitor, tab, fold)
            case TellUnfolded(panel=panel):
                self._panel_unfolded(panel)
            case TellDrawnInSoftware():
                self._shared.stage.in_software.report_arrived(visitor)
            case ToggleTable():
                self._show_library(not self._library_open)
            case ToggleTimeline():
                visitor.send(render("toggle_timeline"))
            case FrameScene():
                self._in_3d.frame()
            case RescoreChosen():
                self._rescore_chosen()
            case CloseDialog():
                if not self._opening.close():
                    self._library.close()
            case _ if isinstance(command, CamerasPanel.does):
                self._cameras.do(command, visitor)
            case _:
                return self._parts.do(command, visitor)
        return None

    def _rescore_chosen(self) -> None:
        opened = tuple(one.id for one in self._review.view().opened)
        self._rescore.rescore_and_notify(self._library.selected() or opened)

    def _open_side_by_side(self, ids: tuple[str, ...]) -> None:
        self._panel.lay_side_by_side()
        self._review.open(ids)


# --- The timeline of a review -------------------------------------------------------------------------

SPEED_NAMES = {f"{speed:g} ×": speed for speed in SPEEDS}


class ReviewTimeline(TimeBar[ReviewView]):
    """A timeline like that of the live page, but it counts steps forwards from the start of the recordings.

    If several recordings are open, each has its own line on the strip, shifted by its alignment.
    """

    does = (
        TogglePlay,
        ChoosePlaybackSpeed,
        StepBack,
        StepForward,
        PreviousEvent,
        NextEvent,
        Seek,
        GoToFirst,
        GoToLast,
    )

    def __init__(self, server: viser.ViserServer, review: Review) -> None:
        super().__init__(server, "step of the timeline", Seek, "step")
        self._review = review
        self._drawn: tuple[object, ...] = ()
        self._fixed: dict[str, object] = {}

    def _add_speed(self, server: viser.ViserServer) -> Field:
        return choice(server, "Speed", ChoosePlaybackSpeed, "speed", SPEED_NAMES, 1.0)

    def do(self, command: Command, visitor: Visitor) -> None:
        self._review.do(command, visitor.name)

    def draw(self, view: ReviewView) -> None:
        if not self._draw_panel(bool(view.opened)):
            return
        self._show_slider(view.first, view.last, view.position)
        buttons = [
            ("first", tool("First step", GoToFirst())),
            ("back", tool("Step back", StepBack())),
            play_tool(view.playing),
            ("step", tool("Step forward", StepForward())),
            ("last", tool("Last step", GoToLast())),
        ]
        self._transport.content = render("toolbar", kind="transport", label="Transport", tools=buttons)
        self._speed.show(view.speed)
        self._walk.content = tools_html(event_tools())
        wanted = (view.position, view.selected, view.opened_serial, view.anchors, view.align)
        if wanted == self._drawn:
            return
        # Only the cursor and the texts depend on the position.
        if wanted[1:] != self._drawn[1:]:
            self._fixed = fixed_values(view)
        self._drawn = wanted
        one, state = view.opened[view.selected], view.states[view.selected]
        values = {"view": view, "one": one, "state": state, "seek": lambda at: Seek(step=at), **self._fixed}
        self._strip.content, self._legend.content = (
            render(name, **values) for name in ("review_strip", "review_legend")
        )


def fixed_values(view: ReviewView) -> dict[str, object]:
    """The values of the strip that do not depend on the position."""
    rows = [
        (index, [h for h in view.opened[index].events if h.style != "reset"][:MAX_MARKS])
        for index in shown_together(view)
    ]
    episode = view.opened[view.selected].episode
    reward = np.asarray(episode.reward, np.float64)
    if not episode.info.has_reward:
        reward = np.full_like(reward, np.nan)  # ManiSkill reports 0 if the task has no reward
    after, anchor = np.arange(1, len(reward) + 1), view.anchors[view.selected]
    over = column_at(after, reward, anchor, np.arange(view.first, view.last + 1)).astype(np.float32)
    styles = {h.style for _, marks in rows for h in marks}
    return {"rows": rows, **strip_values(view.first, view.last, over, styles)}

"""The live page: builds its parts and redraws them when the session has something new."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import viser

from workbench.app import state
from workbench.app.marks import EPISODES, Marks
from workbench.app.pages import draw_apart
from workbench.app.palette_entries import TaskCommands, add_help_topics
from workbench.app.session import Session
from workbench.app.status_line import StatusLine
from workbench.cameras.commands import SelectCamera
from workbench.cameras.events import CameraChosen
from workbench.cameras.frustums import LARGE_METRES, SMALL_METRES, CameraFrustums, without_the_viewpoint
from workbench.cameras.panel import CamerasPanel
from workbench.cameras.studio_panel import TAB as CAMERAS
from workbench.cameras.studio_panel import StudioPanel
from workbench.cameras.view import shown_cameras
from workbench.checks.panel import TAB as CHECKS
from workbench.checks.panel import ChecksPanel
from workbench.checks.profile_panel import StepProfilePanel
from workbench.envs.camera_data import Picture
from workbench.hands.drive_panel import DrivePanel, DrivingSign
from workbench.hands.joints_panel import TITLE as JOINTS
from workbench.hands.joints_panel import JointsPanel, with_dragged_joint
from workbench.hands.look import BodyView
from workbench.hands.panel import HandsPanel
from workbench.hands.reach_panel import ReachPanel
from workbench.hands.reset_until_panel import ResetUntilPanel
from workbench.hands.resets_panel import ResetsPanel
from workbench.hands.state import Hands
from workbench.live.commands import ChoosePictures
from workbench.live.events import PagesCounted
from workbench.live.messages import CameraRequest
from workbench.live.panels.banners import Banner, BusyBanner
from workbench.live.panels.env_options import EnvOptionsPanel
from workbench.live.panels.env_panel import TABLE as ENVS
from workbench.live.panels.env_panel import EnvPanel
from workbench.live.panels.inspect_panel import TAB as INSPECT
from workbench.live.panels.inspect_panel import ForceArrows, InspectPanel
from workbench.live.panels.log_panel import LogPanel
from workbench.live.panels.reward_panel import CurvesPanel, NumbersPanel
from workbench.live.panels.run_panel import RunPanel
from workbench.live.panels.timeline_panel import TimelinePanel
from workbench.live.panels.version_panel import VersionPanel
from workbench.live.panels.view_panel import ViewIcons, ViewPanel
from workbench.live.view import SessionView
from workbench.machine.loop import BlockingPool, post
from workbench.machine.preferences import close_hints
from workbench.page.command import Command, Refused
from workbench.page.commands import (
    CloseDialog,
    CloseHints,
    FrameScene,
    OpenInEditor,
    ShowRecordings,
    ShowTab,
    TellDrawnInSoftware,
    TellOpenTab,
    TellUnfolded,
    ToggleTable,
    ToggleTimeline,
)
from workbench.page.scene.bodies import DrawStyle
from workbench.page.scene.body_pick import HOVER_COLOUR, BodyMark, body_under_ray
from workbench.page.scene.env_grid import EnvLayout, SelectionMark, acting_box, env_under_ray, lay_out
from workbench.page.scene.frames import BodyFrames
from workbench.page.scene.task_drawings import TaskDrawingsView
from workbench.page.scene.viewpoint import View3D, Viewpoint, frame_all, frame_one
from workbench.page.widgets.editor_links import editor_link
from workbench.page.widgets.fields import choice
from workbench.page.widgets.frame import add_bar
from workbench.page.widgets.keys_and_palette import add_hints, register
from workbench.page.widgets.open_tabs import OpenTabs
from workbench.page.widgets.parts import Clock, DrawThrottle, PagePart, Parts
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Done, Visitor, Visitors
from workbench.record.panel import RecordPanel, record_tool
from workbench.rescore.past_panel import PastRescorePanel, RescoredAbove
from workbench.solve.panel import TAB as TRY
from workbench.solve.panel import SolvePanel
from workbench.solve.seeds_panel import SolveSeedsPanel
from workbench.start.panel import Chooser, OpenDialog
from workbench.task.reference import named_file

DOES: frozenset[type[Command]] = frozenset(
    {
        ShowRecordings,
        ShowTab,
        TellOpenTab,
        TellUnfolded,
        TellDrawnInSoftware,
        ToggleTable,
        ToggleTimeline,
        FrameScene,
        CloseHints,
        CloseDialog,
        OpenInEditor,
        *CamerasPanel.does,
    }
)
"""Commands that the page itself carries out; the session and the parts of the page carry out the others."""
PANELS_PERIOD_SECONDS = 0.06
"""Interval at which the panels are drawn while the envs play: every second frame. Numbers that change faster
cannot be read."""
PICTURES_HINT = (
    "Exact pictures are SAPIEN's own. Fast pictures show simplified meshes and take a fraction of the time without a graphics "
    "card. Auto: fast while something moves, exact when nothing moves. This page records exact pictures only."
)
PANEL_WIDTH_PIXELS = 372
RUN, ENVS_TAB, REWARD, LOG, ALL_PICTURES = "Run", "Envs", "Reward", "Log", "All pictures"
ENVS_WIDTHS_PIXELS = 220, 640
"""Minimum and maximum width of the table of envs."""
ENVS_SHARE = 0.2
"""Maximum share of the page's width for the table of envs. The table omits columns that do not fit; the user
can drag its edge."""
WIDE_PIXELS = 1200
"""Minimum width of a page on which the table of envs opens without an action of the user."""


class Page:
    """The live page of a session.

    Each redraw takes one immutable snapshot of the session, and every part compares it with the snapshot that
    the part drew last. Callbacks of the page run in any thread and order, and only send requests to the
    session. While no browser shows the page, nothing is drawn or rendered.

    Args:
        server: The viser server.
        visitors: The open pages.
        session: The session.
        dark: Whether the first theme is dark.
        on_review: Called when the user opens the recordings.
        on_look: Called with the recording that the user opens.
        stage: The 3-D view; with None the page makes one.
        also: Further commands for the palette, which the caller carries out.
        clock: Clock of all parts of the page.
        editor: URL template that opens a line in the author's editor, from `parse_editor`.
        chooser: Opens another task; None for a page that cannot change its task.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        visitors: Visitors,
        session: Session,
        dark: bool = True,
        on_review: Callable[[], object] = lambda: None,
        on_look: Callable[[Path], None] = lambda path: None,
        stage: View3D | None = None,
        also: frozenset[type[Command]] = frozenset(),
        clock: Clock = time.monotonic,
        editor: str = "",
        chooser: Chooser | None = None,
    ) -> None:
        self._server, self._visitors = server, visitors
        self._session = session
        self._clock = clock
        self._link = partial(editor_link, editor, known=session.knows_file)
        self._on_review, self._on_look = on_review, on_look
        self._visitors_counted = -1
        self._watched: tuple[CameraRequest, ...] = ()
        """Pictures requested from the session."""
        self._choices = BlockingPool("choices")
        """Saves the user's choices for later runs."""
        self._panels_due = DrawThrottle(PANELS_PERIOD_SECONDS, clock)
        self._layout: EnvLayout | None = None
        self._scene_serial = -1
        self._built: tuple[bool, DrawStyle, bool] | None = None
        self._human: Picture | None = None
        """Newest picture of the human camera in this scene. An env that was just selected has no picture yet, and its view
        would turn away from that camera."""
        stage = stage or View3D(server)
        self._scene, self._framing, self._view_choice = stage.scene, stage.framing, stage.choice

        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(PANEL_WIDTH_PIXELS)
        file = named_file(session.reference)
        # viser's header is in the bar, and the bar already shows the name.
        server.gui.set_panel_label(" ")

        # A hash, since the path may be long.
        which = hashlib.sha256(str(session.reference).encode(errors="replace")).hexdigest()[:16]
        self._open_tabs = OpenTabs(visitors)
        server.gui.add_html(render("which", which=which, first_tab=False, says=True))
        self._opening = None if chooser is None else OpenDialog(server, chooser)
        with add_bar(server):
            name = str(session.reference) if file is None else file.name
            if self._opening is not None:
                self._opening.add_button(name)
            status = StatusLine(server, clock)
            marks = Marks(server, session, self._open_tabs)
            sign = DrivingSign(server)
            server.gui.add_html(render("help_link"))
        self._in_software = stage.in_software
        self._in_software.ask()
        in_tabs = self._add_tabs(dark)
        self._timeline = TimelinePanel(server, session, clock, record_tool)
        with self._timeline.add_tab(LOG):
            log = LogPanel(server, session.clear_printed)
        self._icons = ViewIcons(server, self._view_choice, str(session.reference))
        self._add_left_dock()
        banner = Banner(server, self._link, self._is_own)
        busy_banner = BusyBanner(server, self._link)
        floating = self._envs, self._record, log, self._icons, banner, busy_banner
        opening = () if self._opening is None else (self._opening,)
        # The transport first: a press on Play must not wait for the table of envs.
        self._parts = Parts((status, self._timeline, marks, sign, *in_tabs, *floating, *opening), clock)
        for part in self._reward:
            self._parts.add(part, lambda view: self._is_shown(REWARD, view))
        self._parts.add(self._studio, lambda view: self._is_shown(CAMERAS, view))
        self._parts.add(self._joints, lambda view: self._is_shown(RUN, view))

        self._mark, self._body_mark = SelectionMark(server), BodyMark(server)
        self._hover_mark = BodyMark(server, "/hovered_body", HOVER_COLOUR)
        self._frames, self._frustums = BodyFrames(server), CameraFrustums(server)
        self._forces, self._drawn = ForceArrows(server), TaskDrawingsView(server)
        self._parts.add(TaskCommands(server, visitors))
        kinds = DOES | state.DOES | self._parts.does | also
        register(server, visitors, kinds, "live page", (ENVS_TAB, EPISODES, "Timeline", LOG))
        add_help_topics(server, visitors)
        # viser awaits coroutines, although its types do not say so.
        server.scene.on_click()(self._on_scene_click)  # type: ignore[arg-type]

    def _is_shown(self, tab: str, view: SessionView) -> bool:
        """Whether this tab counts as shown. While playing, only if a page may have it open. While paused,
        always: there is little to send, and a tab that is opened then must not show an earlier moment."""
        return not view.playing or self._open_tabs.may_show(tab)

    def _is_own(self, file: str) -> bool:
        return isinstance(self._session.reference, str) and self._session.knows_file(file)

    def _add_tabs(self, dark: bool) -> list[PagePart[SessionView]]:
        """Add the tabs of the right dock; returns their parts, except those that are drawn only while their
        tab is shown."""
        server, session, clock = self._server, self._session, self._clock
        tabs = server.gui.add_tab_group()
        with tabs.add_tab(RUN, viser.Icon.PLAYER_PLAY):
            self._hints = add_hints(server)
            self._run = RunPanel(server, session, lambda view: view.of(Hands).driving)
            with self._run.actions:
                drive = DrivePanel(server, session, self._run.below_mode)
                self._reach = ReachPanel(server, session, self._run.below_mode + 0.1)
            with self._run.episode:
                until = ResetUntilPanel(server, self._run.below_resets)
            self._joints = JointsPanel(server, self._run.actions.order + 0.5)
            version = VersionPanel(server, self._link)
            options = EnvOptionsPanel(server, session)
            self._view_panel = ViewPanel(server, dark, self._view_choice)
        with tabs.add_tab(CAMERAS, viser.Icon.CAMERA):
            self._studio = StudioPanel(server, session, lambda: self._open_tabs.pages_at(CAMERAS), clock)
            with server.gui.add_folder(ALL_PICTURES, expand_by_default=False):
                degrees = "auto", "exact", "fast"
                self._degree = choice(
                    server, "Pictures", ChoosePictures, "pictures", degrees, "auto", hint=PICTURES_HINT
                )
                self._cameras = CamerasPanel(
                    server,
                    studio_shows=lambda: self._studio.shows,
                    is_shown=lambda: self._open_tabs.may_show(CAMERAS),
                    clock=clock,
                )
        with tabs.add_tab(REWARD, viser.Icon.CHART_LINE):
            self._reward = (
                NumbersPanel(server),
                RescoredAbove(server),
                CurvesPanel(server, session),
                PastRescorePanel(server, session, lambda name, env: session.rescored_curve(name, env)),
            )
        with tabs.add_tab(INSPECT, viser.Icon.ZOOM_IN):
            self._inspect = InspectPanel(server, session, self._open_tabs, clock)
            below = self._inspect.below_body
            self._hands = HandsPanel(server, session, lambda: self._inspect.body, below)
            self._body_view = BodyView(
                server, lambda: self._inspect.body, lambda: self._hands.selected, below - 0.25
            )
            self._resets = ResetsPanel(server, session, lambda: self._hands.selected, below + 0.25)
        with tabs.add_tab(TRY, viser.Icon.FLASK):
            self._solve = SolvePanel(server, session, self._open_tabs, self._link)
            seeds = SolveSeedsPanel(server, session, self._on_look, self._link)
            profile = StepProfilePanel(server, self._link)
        with (checks_tab := tabs.add_tab(CHECKS, viser.Icon.CHECKLIST)):
            checks = ChecksPanel(server, checks_tab, self._link)
        of_run = self._run, until, drive, self._reach, version, options, self._view_panel
        return [
            *of_run,
            self._inspect,
            self._hands,
            self._body_view,
            self._resets,
            self._solve,
            seeds,
            profile,
            checks,
        ]

    def _add_left_dock(self) -> None:
        self._env_window = self._server.gui.add_panel(order=5.0)
        with self._env_window.add_tab(ENVS_TAB, viser.Icon.LIST_DETAILS):
            self._envs = EnvPanel(self._server, self._session)
        with self._env_window.add_tab(EPISODES, viser.Icon.MOVIE):
            self._record = RecordPanel(self._server)
            self._server.gui.add_html(tools_html([tool("Review recordings", ShowRecordings())]))
        self._env_window.dock_left()
        self._envs_open = bool(self._view_choice.table)
        if not self._envs_open:
            self._env_window.minimize()
        self._envs_fitted = 0
        """Width of the page in pixels for which the width of the table was set last."""

    # --- drawing ---------------------------------------------------------------------------------

    @property
    def dark(self) -> bool:
        """Whether the theme is dark."""
        return self._view_panel.dark

    def wait(self, seen: int, timeout: float) -> int:
        """See `ShownPage`."""
        return self._session.wait(seen, timeout)

    def counted(self, visitors: int) -> None:
        """Set the number of browsers that show the page. At 0, nothing is rendered."""
        if visitors != self._visitors_counted:
            self._visitors_counted = visitors
            self._session.dispatch(PagesCounted(visitors))
            self._hands.follow(self._session.view())
            self._reach.follow()

    def close(self) -> None:
        """Release the page. The session may continue under another page, and must not render for this one."""
        self._hands.let_go()
        self._reach.let_go()
        self.counted(0)
        self._choices.end()

    def redraw(self) -> None:
        """Draw the present state of the session. If only steps advance, the panels are drawn less often than the view."""
        view = self._session.view()
        panels = (lambda: self._draw_panels(view)) if self._panels_due.is_due(*_shown_of(view)) else None
        draw_apart(self._server, panels, lambda: self._draw_scene(view))
        self._watch(view)
        self._hands.follow(view)
        self._reach.follow()

    def _watch(self, view: SessionView) -> None:
        """Request from the session the pictures that the page shows."""
        wanted = self._cameras.wanted(shown_cameras(view))
        if wanted != self._watched:
            self._watched = wanted
            self._session.change(cameras=wanted)

    def _draw_panels(self, view: SessionView) -> None:
        self._open_envs_at_first(view)
        self._parts.draw(view)
        self._degree.show(view.settings.pictures)
        self._cameras.draw(shown_cameras(view))

    # --- commands --------------------------------------------------------------------------------

    def do(self, command: Command, visitor: Visitor) -> Done:
        """Carry out a command of a page. Raises `Refused`."""
        session = self._session
        match command:
            case ShowRecordings():
                self._on_review()
            case ShowTab(tab=tab, fold=fold):
                if tab in (ENVS_TAB, EPISODES):
                    self._open_envs()
                self._open_tabs.open(visitor, tab, fold)
            case TellOpenTab(tab=tab):
                self._open_tabs.said(visitor, tab)
                self._inspect.choose_sections()
            case TellUnfolded(panel=panel):
                self._unfolded(panel)
            case TellDrawnInSoftware():
                self._in_software.report_arrived(visitor)
            case ToggleTable():
                self._toggle_envs()
            case ToggleTimeline():
                visitor.send(render("toggle_timeline"))
            case FrameScene():
                self.frame(session.view())
            case CloseHints():
                self._hints.content = ""
                self._choices.begin(close_hints)
            case OpenInEditor(file=file):
                self._open_file(file, visitor)
            case SelectCamera():
                session.do(command, visitor.name)
                self._open_tabs.open(visitor, CAMERAS)
            case CloseDialog():
                if self._opening is not None:
                    self._opening.close()
            case _ if type(command) in state.DOES:
                session.do(command, visitor.name)
            case _ if isinstance(command, CamerasPanel.does):
                self._cameras.do(command, visitor)
            case _:
                return self._parts.do(command, visitor)
        return None

    def _open_file(self, file: str, visitor: Visitor) -> None:
        """Open a file in the user's editor. Raises `Refused` if no editor is set, or the file is not a file of
        the task."""
        link = self._link(file, None)
        if not link.address:
            raise Refused(f"No editor opens {file}: it is not a file of the task, or --editor is none.")
        visitor.send(render("open_address", link=link))

    def _unfolded(self, panel: str) -> None:
        """Handle a page's report: the user has unfolded this panel."""
        if panel == ENVS:
            self._envs_open = True
            self._fit_envs()
            self._envs.unfold()
        elif panel == CAMERAS:
            self._studio.unfold()
        elif panel == JOINTS:
            self._joints.unfold()

    def _fit_envs(self) -> None:
        """Set the table's width to the width of its columns. Done once for each page width, because the user
        may have dragged the table's edge."""
        wanted = self._envs.wanted_width()
        page = self._narrowest()
        if page in (0, self._envs_fitted) or not wanted:
            return
        least, most = ENVS_WIDTHS_PIXELS
        self._env_window.set_width(max(least, min(wanted, most, page * ENVS_SHARE)))
        self._envs_fitted = page

    def _narrowest(self) -> int:
        """Width in pixels of the narrowest page; 0 if none is known."""
        return min((visitor.page_width for visitor in self._visitors.all() if visitor.page_width), default=0)

    def _open_envs_at_first(self, view: SessionView) -> None:
        """Open the table of envs if there are several envs, the page is wide enough, and the user has not yet
        opened or closed the table."""
        several = view.task is not None and view.task.num_envs > 1
        if self._view_choice.table is None and several and self._narrowest() >= WIDE_PIXELS:
            self._open_envs()

    def _toggle_envs(self) -> None:
        if self._envs_open:
            self._envs_open = self._view_choice.table = False
            self._envs.fold()
            self._env_window.minimize()
        else:
            self._open_envs()

    def _open_envs(self) -> None:
        """Open the left dock."""
        self._envs_open = self._view_choice.table = True
        self._fit_envs()
        self._envs.unfold()
        self._env_window.expand()

    # --- the 3-D view ----------------------------------------------------------------------------

    def _draw_scene(self, view: SessionView) -> None:
        task, step, seen = view.task, view.step, shown_cameras(view)
        if task is None:
            # The 3-D view still has the bodies of the previous page.
            self._scene.hide()
            return
        if (
            step is None
            or seen is None
            or step.poses.shape[:2]
            != (
                task.num_envs,
                len(task.geometry.body_names),
            )
        ):
            # While one version replaces another, the view may hold the new task with a step of the old
            # version.
            return
        one = self._icons.only_selected and task.num_envs > 1
        env = min(view.selected_env, task.num_envs - 1)
        if view.scene_serial != self._scene_serial or self._layout is None:
            self._scene_serial = view.scene_serial
            self._layout = lay_out(task.geometry, step.poses)
            self._built = None
        geometry = task.geometry
        if collisions := self._view_choice.collisions and len(geometry.collisions) > 0:
            geometry = geometry.as_collisions
        looks = self._in_software.looks(self._view_panel.looks, geometry, self._layout, one)
        poses = with_dragged_joint(view, self._hands.moved(geometry, step.poses))
        poses = self._reach.moved(view, poses)
        built = (one, looks, collisions)
        if built != self._built:
            self._built = built
            self._scene.build(geometry, self._layout, poses, env if one else None, looks)
        self._scene.move(self._body_view.without_hidden(geometry, poses), self._layout, env if one else None)
        self._mark.draw(self._layout, env, shown=task.num_envs > 1 and not one)
        pictures = self._cameras.shown_pictures(seen) if self._view_choice.frustums else {}
        alone = one or task.num_envs == 1
        if alone:
            pictures = without_the_viewpoint(pictures, view.pictures)
        offset = np.zeros(3, np.float32) if one else self._layout.offsets[env]
        placed = self._studio.draw_in_view(view, offset)
        self._frustums.draw(task.cameras, pictures, offset, SMALL_METRES if alone else LARGE_METRES, placed)
        self._forces.draw(self._inspect.forces(view), offset)
        self._drawn.draw(step.drawn, env, offset)
        selected = task.geometry, poses, env, self._inspect.body, offset
        self._body_mark.draw(*selected)
        hovered = self._inspect.hovered if self._inspect.hovered != self._inspect.body else ""
        self._hover_mark.draw(task.geometry, poses, env, hovered, offset)
        self._hands.draw_in_view(view, poses, offset)
        self._resets.draw_in_view(view)
        read = self._inspect.body_reading(view) if self._view_choice.frames else None
        self._body_view.draw_in_view(view, poses, offset, read)
        self._reach.draw_in_view(view, poses, offset)
        if self._view_choice.frames:
            self._frames.draw(*selected)
        else:
            self._frames.clear()
        self._solve.draw_in_view(view, offset)
        # A scene of another size is framed again; a reload that keeps the size never moves the view.
        size = np.round(np.concatenate([self._layout.low, self._layout.high]), 0).tobytes()
        is_new = self._framing.is_new((task.env_id, 1 if alone else task.num_envs, size))
        human = next((p for (kind, _), p in view.pictures.items() if kind == "human"), None)
        came = human is not None and self._human is None
        if human is not None or is_new:
            self._human = human
        if is_new:
            self._framing.frame_new(lambda aspect: self._viewpoint(view, aspect))
        elif came and alone:
            # The human camera's pose arrives with its first picture, after the scene.
            self.frame(view, untouched_only=True)
        self._framing.frame_untouched(lambda aspect: self._viewpoint(view, aspect))

    def frame(self, view: SessionView, untouched_only: bool = False) -> None:
        """Frame the scene in every open page, and in pages opened later.

        Args:
            untouched_only: of the open pages, frame only those in which the user has not moved the view.
        """
        if self._layout is not None and view.task is not None:
            self._framing.frame(lambda aspect: self._viewpoint(view, aspect), untouched_only)

    def _viewpoint(self, view: SessionView, aspect: float) -> Viewpoint:
        assert self._layout is not None and view.task is not None, "asked only where a scene is drawn"
        if self._icons.only_selected or view.task.num_envs == 1:
            human, camera = self._human, None
            if human is not None:
                camera = next((c for c in view.task.cameras if c.key == human.key), None)
            if camera is not None:
                return frame_one(self._layout, human, aspect, camera.fovy)
            acting = None
            if view.step is not None:
                acting = acting_box(view.task.geometry, view.step.poses, self._layout)
            return frame_one(self._layout, None, aspect, acting=acting)
        return frame_all(self._layout, aspect)

    async def _on_scene_click(self, event: viser.SceneClickEvent) -> None:
        post(lambda: self._clicked(event))

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        layout, view = self._layout, self._session.view()
        if layout is None or view.task is None:
            return
        ray = np.array(event.ray_origin), np.array(event.ray_direction)
        if (camera := self._frustums.under_ray(*ray)) is not None:
            self._session.dispatch(CameraChosen(camera))
            return
        if (reset := self._resets.reset_under_ray(*ray)) is not None:
            self._session.do(reset)
            return
        alone = self._icons.only_selected or view.task.num_envs == 1
        env = view.selected_env if alone else env_under_ray(layout, *ray)
        if env is None or env >= view.task.num_envs or view.step is None:
            return
        if not alone:
            self._session.change(selected_env=env)
        geometry, poses = view.task.geometry, view.step.poses
        if poses.shape[:2] == (geometry.num_envs, len(geometry.body_names)):
            origin = ray[0] - (0 if alone else layout.offsets[env])
            body = body_under_ray(geometry, poses, env, origin, ray[1])
            self._inspect.select("" if body is None else geometry.body_names[body])


def _shown_of(view: SessionView) -> tuple[object, object]:
    """Arguments for `DrawThrottle.is_due`: a key of the panels' content, and a key of what must be drawn at
    once."""
    steps_go_on = view.playing and view.state == "running" and view.timeline.shown is None
    waited_for = (
        view.settings,
        view.busy,
        view.task_serial,
        view.problem_serial,
        view.stale,
        view.activity,
        view.pictures_serial,
    )
    # Each snapshot counts as new content. While no steps are made, it must also be drawn at once.
    return object(), (waited_for if steps_go_on else object())

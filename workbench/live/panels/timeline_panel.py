"""The timeline under the view: a slider over the past, a strip with reward and events, and buttons."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection
from typing import TypeVar

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.live.commands import SetSpeed, Step, TogglePlay
from workbench.live.events import MomentShown
from workbench.live.history.curves import REWARD, Column, columns_by_label
from workbench.live.history.moments import (
    BY_HAND,
    FAIL,
    RESET,
    REWARD_NONFINITE,
    SUCCESS,
    TRUNCATED,
    WENT_BACK,
)
from workbench.live.panels.moment import MomentPart
from workbench.live.past import Strip, TimelineView
from workbench.live.session_protocol import LiveSession
from workbench.live.timeline_commands import (
    ChooseStripCurve,
    ContinueFromHere,
    GoToFirst,
    GoToLast,
    NextEvent,
    PreviousEvent,
    Seek,
    SeekBack,
    StepBack,
    StepForward,
    UndoReset,
    ZoomTimeline,
)
from workbench.live.view import SessionView
from workbench.machine.text import number_text
from workbench.page.command import Command
from workbench.page.commands import ToggleTimeline
from workbench.page.widgets.fields import Field, by_name, choice, slider
from workbench.page.widgets.keys_and_palette import with_key
from workbench.page.widgets.line_chart import drawn_span, polylines
from workbench.page.widgets.parts import Clock, PagePart
from workbench.page.widgets.templates import counted, render
from workbench.page.widgets.tools import Tool, tool, tools_html
from workbench.page.widgets.visitors import Visitor

RANGE_PERIOD_SECONDS = 0.5
"""Interval at which the slider's range changes. A slider whose ends move at every step cannot be dragged."""
LAST_EVENT, NEXT_EVENT = "‹ event", "event ›"
SPEEDS: dict[str, float | None] = {
    "0.1 ×": 0.1,
    "0.25 ×": 0.25,
    "0.5 ×": 0.5,
    "1 ×": 1.0,
    "2 ×": 2.0,
    "4 ×": 4.0,
    "8 ×": 8.0,
    "unlimited": None,
}
EPISODE, EVERYTHING = "this episode", "all episodes"
GO_ON = "Continue from here"
UNDO = "undo"
"""Start of the undo button's label; the name of the undone change follows."""
View = TypeVar("View", contravariant=True)


class TimeBar(PagePart[View]):
    """The transport, a row of 60 px under the view, and the drawer that opens below it.

    The row has buttons, the speed and the strip. The drawer's first tab, *Timeline*, has a legend, a slider and further
    buttons. Each page opens and closes the drawer on its own (`ToggleTimeline`).

    Args:
        name: Name of the slider.
        kind: Command that the slider sends, with its value in the field `field`.
    """

    def __init__(self, server: viser.ViserServer, name: str, kind: type[Command], field: str) -> None:
        self._server, gui = server, server.gui
        self._panel = gui.add_panel(visible=False, order=10.0)
        with self._panel.add_tab(""):
            self._transport = gui.add_html("")
            self._speed = self._add_speed(server)
            self._strip = gui.add_html("")
            self._add_entry(server)
            hint = with_key(ToggleTimeline)
            gui.add_html(render("unfold_timeline", command=ToggleTimeline(), hint=hint))
        self._drawer = gui.add_panel(visible=False, order=11.0)
        with self._drawer.add_tab("Timeline"):
            gui.add_html(render("drawer"))
            self._legend = gui.add_html("")
            self._slider = slider(server, name, kind, field, (-1, 0))
            self._add_rows(gui)
            self._walk = gui.add_html("")
        # The style sheet puts them under the view: viser docks panels at the sides only.
        self._panel.float(x=0, y=-1)
        self._drawer.float(x=0, y=-1)

    def add_tab(self, name: str) -> viser.GuiTabHandle:
        """Add an empty tab to the drawer."""
        tab = self._drawer.add_tab(name)
        with tab:
            self._server.gui.add_html(render("drawer"))
        return tab

    def _add_speed(self, server: viser.ViserServer) -> Field:
        """Add the choice of speed to the row."""
        raise NotImplementedError

    def _add_entry(self, server: viser.ViserServer) -> None:
        """Add the choice of the strip's curve to the row."""

    def _add_rows(self, gui: viser.GuiApi) -> None:
        """Add rows between the slider and the buttons."""

    def _draw_panel(self, there: bool) -> bool:
        self._panel.visible = self._drawer.visible = there
        return there

    def _show_slider(self, low: int, high: int, value: int) -> None:
        # The range must not be empty. Without steps, the slider is disabled and not hidden: else the panel
        # would grow at the first step.
        self._slider.show(value, bounds=(min(low, high - 1), high), off=low >= high)


class TimelinePanel(TimeBar[SessionView], MomentPart):
    """The live page's timeline. It counts control steps backwards: 0 is live and -37 is 37 steps ago. So the
    slider stays at its right end while the simulation runs, and its value need not be sent. Dragging shows
    moments that the session has in memory; the worker draws pictures only after the slider has rested at one
    moment.
    """

    does = (SeekBack, ZoomTimeline, GoToFirst, ChooseStripCurve)

    def __init__(
        self,
        server: viser.ViserServer,
        session: LiveSession,
        clock: Clock = time.monotonic,
        record: Callable[[SessionView], Tool] | None = None,
    ) -> None:
        """
        Args:
            record: returns the button that records.
        """
        super().__init__(server, "step of the past", SeekBack, "steps")
        self._session, self._clock, self._record = session, clock, record
        self._episode_only = False
        self._curve = REWARD.label
        """Name of the chosen entry. If the task has no such entry, the strip shows the reward."""
        self._range = (0, 0)
        """Ticks at the slider's ends."""
        self._newest = 0
        """Tick that the slider shows as 0."""
        self._range_at = -math.inf
        self._strip_of: object = None
        """Key of the data that the strip was drawn for."""

    def _add_speed(self, server: viser.ViserServer) -> Field:
        hint = "Simulated seconds per real second."
        return choice(server, "Speed", SetSpeed, "speed", SPEEDS, 1.0, hint=hint)

    def _add_entry(self, server: viser.ViserServer) -> None:
        name = REWARD.label
        self._entry = choice(
            server, "Curve", ChooseStripCurve, "curve", (name,), name, hint="What the strip shows"
        )

    def _add_rows(self, gui: viser.GuiApi) -> None:
        # Exactly one of these two is shown, and they have the same height: nothing moves under the pointer.
        self._hint = gui.add_html("")
        self._travel = gui.add_html("", visible=False)

    # --- commands ----------------------------------------------------------------------------------

    def do(self, command: Command, visitor: Visitor) -> None:
        session = self._session
        match command:
            case SeekBack(steps=0):
                session.do(GoToLast())
            case SeekBack(steps=steps):
                session.do(self._seek_to(self._newest + steps))
            case GoToFirst():
                # Go to the left end of the slider, as the Home key does while the slider has the focus.
                if self._episode_only:
                    session.do(self._seek_to(self._range[0]))
                else:
                    session.dispatch(MomentShown(0))
            case ZoomTimeline(episode_only=wanted):
                self._episode_only, self._range_at = wanted, -math.inf
            case ChooseStripCurve(curve=curve):
                self._curve = curve

    def _seek_to(self, tick: int) -> Seek:
        return Seek(step=tick, episode_only=self._episode_only)

    # --- drawing -----------------------------------------------------------------------------------

    def urgent(self, view: SessionView) -> object:
        return super().urgent(view), self._episode_only, self._curve

    def draw(self, view: SessionView) -> None:
        self._draw_panel(True)
        self._draw_transport(view)
        curves = strip_curves(view)
        chosen = self._curve if self._curve in curves else REWARD.label
        self._entry.show(chosen, options=by_name(tuple(curves)))
        if view.task is not None and view.timeline.moments > 0:
            self._draw_slider(view)
            self._draw_buttons(view)
            self._draw_strip(view, curves.get(self._curve, REWARD))
        else:
            self._draw_empty()

    def _draw_empty(self) -> None:
        """Draw an empty timeline: there is no task, or its envs were just built."""
        self._range, self._newest, self._range_at, self._strip_of = (0, 0), 0, -math.inf, None
        self._show_slider(0, 0, 0)
        self._strip.content = self._legend.content = self._hint.content = self._walk.content = ""
        self._travel.visible, self._hint.visible = False, True

    def _draw_transport(self, view: SessionView) -> None:
        live = view.timeline.shown is None
        can_act = view.task is not None and view.state != "stopped"
        step = tool("Step", Step(), off=not can_act) if live else tool("Step forward", StepForward())
        buttons = [
            ("first", tool("First moment", GoToFirst(), off=not view.timeline.moments)),
            ("back", tool("Step back", StepBack(), off=not view.timeline.moments)),
            play_tool(view.playing, off=not can_act),
            ("step", step),
            ("last", tool("Live", GoToLast(), off=live)),
        ]
        if self._record is not None:
            buttons.append(("record", self._record(view)))
        self._transport.content = render("toolbar", kind="transport", label="Transport", tools=buttons)
        speed = None if math.isinf(view.settings.speed) else view.settings.speed
        # The command line takes speeds that are not in the list.
        speeds = SPEEDS if speed in SPEEDS.values() else SPEEDS | {f"{speed:g} ×": speed}
        self._speed.show(speed, options=speeds, off=not can_act)

    def _draw_slider(self, view: SessionView) -> None:
        past, now = view.timeline, self._clock()
        moved = past.shown is not None and not self._range[0] <= past.tick <= self._range[1]
        if now - self._range_at >= RANGE_PERIOD_SECONDS or moved:
            self._range_at = now
            episode = self._session.look(lambda run: run.episode_ticks()) if self._episode_only else None
            self._range = (past.first_tick, past.last_tick) if episode is None else episode
            self._newest = past.last_tick
        low, high = (tick - self._newest for tick in self._range)
        self._show_slider(low, high, 0 if past.shown is None else past.tick - self._newest)

    def _draw_buttons(self, view: SessionView) -> None:
        past = view.timeline
        zoom = (
            (EVERYTHING, ZoomTimeline(episode_only=False))
            if self._episode_only
            else (EPISODE, ZoomTimeline(episode_only=True))
        )
        walk = [
            *event_tools(),
            Tool(zoom[0], zoom[1], zoom[1].help()),
            tool(f"{UNDO} {past.undo or ''}".strip(), UndoReset(), off=past.undo is None),
        ]
        self._walk.content = tools_html(walk)
        travel = continue_tools(view) if past.can_continue else []
        if travel:
            self._travel.content = tools_html(travel)
        not_carried = "; ".join(past.not_carried)
        hint = render("timeline_hint", live=past.shown is None, not_carried=not_carried, arrived=past.arrived)
        self._hint.content = hint
        self._travel.visible, self._hint.visible = bool(travel), not travel

    def _draw_strip(self, view: SessionView, column: Column) -> None:
        past = view.timeline
        wanted = (
            past.first,
            past.last,
            past.shown,
            view.selected_env,
            self._range,
            self._episode_only,
            column,
        )
        if wanted == self._strip_of:
            return
        self._strip_of = wanted
        low, high = self._range
        strip = self._session.look(lambda run: run.strip(low, high, column))
        if strip is not None:
            content = strip_html(strip, view, self._seek_to, column)
            self._strip.content, self._legend.content = content


def play_tool(playing: bool, off: bool = False) -> tuple[str, Tool]:
    """The icon and the button that play or pause."""
    return ("pause" if playing else "play"), tool(
        "Pause" if playing else "Play", TogglePlay(), off=off, tone="main"
    )


def event_tools() -> list[Tool]:
    """Buttons that go to the previous and the next event."""
    return [tool(LAST_EVENT, PreviousEvent()), tool(NEXT_EVENT, NextEvent())]


def continue_tools(view: SessionView) -> list[Tool]:
    """Buttons that continue from the shown moment."""
    if view.task is None or view.task.num_envs == 1:
        return [tool(GO_ON, ContinueFromHere())]
    env = f"env {view.selected_env}"
    return [
        tool(f"{GO_ON}: {env}", ContinueFromHere()),
        Tool("all envs", ContinueFromHere(scope="all"), "Each from its own moment"),
        Tool(
            f"{env} into all envs",
            ContinueFromHere(scope="into all"),
            "All envs continue from this env's shown moment",
        ),
    ]


STRIP_POINTS = 240
"""Number of points of the strip's line. The points are the minimum and the maximum of each interval, so that
a spike of one step stays visible."""
LINE_HEIGHT = 30.0
"""Height of the line in units of the SVG; the marks are above."""
FLAGS = {
    REWARD_NONFINITE: "odd",
    FAIL: "fail",
    SUCCESS: "success",
    TRUNCATED: "limit",
    WENT_BACK: "back",
    BY_HAND: "hand",
    RESET: "reset",
}
"""Style of each event's mark. Where several events coincide, the first of these is drawn."""
NAMES = {
    "odd": "reward is NaN or infinite",
    "fail": "fail",
    "success": "success",
    "limit": "time limit",
    "back": "went back",
    "hand": "moved or pulled by hand",
    "reset": "reset",
    "other": "other event",
}
"""Legend text of each style."""
LASTING = REWARD_NONFINITE | FAIL | SUCCESS | TRUNCATED
"""Events that each further step repeats if the episode continues."""
MAX_MARKS = 250
"""Maximum number of marks on the strip: closer marks could not be distinguished."""


def strip_values(
    low: int, high: int, reward: NDArray[np.float32], styles: Collection[str]
) -> dict[str, object]:
    """Values that the templates of both timelines share.

    Args:
        low: First tick of the strip.
        high: Last tick.
        reward: (high - low + 1,), NaN where there is none.
        styles: Styles of the strip's marks.
    """

    def place(at: float) -> float:
        """Per cent of the strip's width, clamped."""
        return round(100 * (min(max(at, low), high) - low) / max(high - low, 1), 3)

    kinds = [(style, name) for style, name in NAMES.items() if style in styles]
    finite = reward[np.isfinite(reward)]
    span = [_number(float(value)) for value in (finite.min(), finite.max())] if len(finite) else None
    return {"place": place, "lines": reward_lines(reward), "span": span, "kinds": kinds}


def marks_of(strip: Strip) -> list[tuple[int, str, str]]:
    """Tick, style and name of each mark. Where several events fall on one place, the first of `FLAGS` is
    drawn. An event that lasts several steps is drawn at the first one, for example in an episode that
    continues after its time limit."""
    rank, names, events = list(FLAGS), dict(strip.branches), dict(strip.events)
    marks: dict[int, tuple[int, int, str]] = {}
    for tick, flags in strip.events:
        flag = next(flag for flag in rank if flags & flag)
        if flags == events.get(tick - 1) and not flags & ~LASTING:
            continue
        place = MAX_MARKS * (tick - strip.low) // (strip.high - strip.low + 1)
        if place not in marks or rank.index(flag) < rank.index(marks[place][1]):
            name = NAMES[FLAGS[flag]]
            if flag == WENT_BACK:
                name = (
                    f"went back {counted(tick - names[tick], 'step')}"
                    if tick in names
                    else "from a recording"
                )
            marks[place] = tick, flag, name
    return [(tick, FLAGS[flag], name) for tick, flag, name in marks.values()]


def strip_curves(view: SessionView) -> dict[str, Column]:
    """The entries that the strip can show, by name."""
    if view.step is None or view.task is None:
        return {REWARD.label: REWARD}
    return columns_by_label(view.step, view.task.joints)


def strip_html(
    strip: Strip,
    view: SessionView,
    seek: Callable[[int], Seek] = lambda tick: Seek(step=tick),
    column: Column = REWARD,
) -> tuple[str, str]:
    """The strip of one env with its shown moment, and its legend.

    Args:
        seek: returns the command for a press on a tick.
        column: the number that the strip shows.
    """
    is_known = column != REWARD or view.task is None or view.task.reward_mode != "none"
    # ManiSkill returns the reward 0 for a task without a reward.
    numbers = strip.values if is_known else np.full_like(strip.values, np.nan)
    marks = marks_of(strip)
    values = {
        "strip": strip,
        "seek": seek,
        "past": view.timeline,
        "marks": marks,
        "ago": ago_in_words(view.timeline),
        "where": step_in_words(view),
        "time": time_in_words(view),
        "megabytes": megabytes,
        "curve": column.label,
        **strip_values(strip.low, strip.high, numbers, {style for _, style, _ in marks}),
    }
    return render("strip", **values), render("legend", **values)


def _number(value: float) -> str:
    return number_text(value, ".3g")


def ago_in_words(past: TimelineView) -> str:
    """Age of the shown moment as text: ``7 steps ago``."""
    # An episode's last step is at the tick of the reset that follows it.
    return f"{counted(past.steps_ago, 'step')} ago" if past.steps_ago else "before the reset"


def step_in_words(view: SessionView) -> str:
    """The selected env's step of its episode, as text."""
    task, step = view.task, view.step
    if task is None or step is None or view.selected_env >= len(step.elapsed_steps):
        return ""
    limit = f" / {task.max_episode_steps}" if task.max_episode_steps else ""
    env = "" if task.num_envs == 1 else f"env {view.selected_env}: "
    return f"{env}step {int(step.elapsed_steps[view.selected_env])}{limit}"


def time_in_words(view: SessionView) -> str:
    """Simulated time of the shown moment in its episode, as text."""
    task, step = view.task, view.step
    if task is None or step is None or view.selected_env >= len(step.elapsed_steps):
        return ""
    return f"{step.elapsed_steps[view.selected_env] * task.control_dt:.2f} s"


def reward_lines(reward: NDArray[np.float32]) -> list[str]:
    """SVG polylines of the finite rewards over x 0..100 and y 0..`LINE_HEIGHT` (greatest on top), with gaps. A constant
    reward is a line in the middle."""
    finite = reward[np.isfinite(reward)]
    if not len(finite):
        return []
    low, high = drawn_span(float(finite.min()), float(finite.max()))
    known = np.where(np.isfinite(reward), reward, np.nan)
    if len(known) <= STRIP_POINTS:
        places, values = np.arange(len(known)), known
    else:
        edges = np.linspace(0, len(known), STRIP_POINTS // 2 + 1).astype(int)[:-1]
        values = np.stack([np.fmin.reduceat(known, edges), np.fmax.reduceat(known, edges)], 1).reshape(-1)
        places = np.repeat(edges, 2)
    x = 100 * places / max(len(known) - 1, 1)
    y = LINE_HEIGHT * (1 - (values - low) / (high - low))
    return polylines([None if np.isnan(b) else f"{a:.2f},{b:.1f}" for a, b in zip(x, y, strict=True)])


def megabytes(size: int) -> str:
    return f"{size / 1024**2:.0f}" if size >= 10 * 1024**2 else f"{size / 1024**2:.1f}"

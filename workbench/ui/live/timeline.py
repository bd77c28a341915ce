"""The timeline under the view: a slider over the past, a strip with reward and events, and buttons."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence
from functools import partial
from itertools import groupby
from typing import Any, Protocol, TypeVar

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.machine.text import number_text
from workbench.session.history.history import FAIL, RESET, REWARD_NONFINITE, SUCCESS, TRUNCATED, WENT_BACK
from workbench.session.live.session import Session
from workbench.session.live.timeline import Scope, Strip, TimelineView
from workbench.session.live.view import SessionView
from workbench.ui.live.moment import MomentPart
from workbench.ui.server.control_values import name_control
from workbench.ui.widgets.click_targets import Presses
from workbench.ui.widgets.hotkeys import Command
from workbench.ui.widgets.inputs import Control
from workbench.ui.widgets.parts import Clock, PagePart
from workbench.ui.widgets.templates import counted, render

GAP = 12
"""Pixels between floating panels and the view's edges; the same in ``view_width.js``."""
WIDEST = 760
HEIGHT = 205
"""Pixels of the view that it covers; framing a scene leaves them out."""
RANGE_EVERY = 0.5
"""Seconds. A slider whose ends move at every step cannot be held."""
STANDS_STILL = 0.35
"""Seconds at one moment until its pictures are drawn; with less, every drag would draw some."""
LAST_EVENT, LAST_STEP, NEXT_STEP, NEXT_EVENT, LIVE = "‹ event", "‹ step", "step ›", "event ›", "live"
EPISODE, EVERYTHING = "this episode", "all episodes"
SCOPES: tuple[Scope, ...] = ("this", "all", "into all")
GO_ON = "Continue from here"
UNDO = "undo"
"""Start of the undo button's label; what is undone follows."""
WALK = (LAST_EVENT, LAST_STEP, NEXT_STEP, NEXT_EVENT, LIVE, EPISODE)
View = TypeVar("View", contravariant=True)


class Seeks(Protocol):
    """What the slider and the buttons move through time; it defines what a place is."""

    def seek(self, place: Any, /) -> None: ...
    def seek_by(self, steps: int, /) -> None: ...
    def seek_event(self, direction: int, /) -> None: ...


class TimeBar(PagePart[View]):
    """A slider over time, a strip under it and a row of buttons, across the bottom of the view.

    Args:
        seeks: What slider, buttons and arrow keys move.
        name: Of the slider.
        does: Actions of further buttons, by the start of their label.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        seeks: Seeks,
        name: str,
        does: dict[str, Callable[[], None]],
        clock: Clock,
    ) -> None:
        self._seeks = seeks
        steps = {LAST_STEP: -1, NEXT_STEP: 1}
        events = {LAST_EVENT: -1, NEXT_EVENT: 1}
        self._does = {
            **{label: partial(seeks.seek_by, by) for label, by in steps.items()},
            **{label: partial(seeks.seek_event, by) for label, by in events.items()},
            **does,
        }
        gui = server.gui
        self._panel = gui.add_panel(visible=False, order=10.0)
        with self._panel.add_tab("Timeline", viser.Icon.HISTORY):
            self._slider: Control[viser.GuiSliderHandle[int], int] = Control(
                gui.add_slider("", min=-1, max=0, step=1, initial_value=0), self._on_slider, clock=clock
            )
            name_control(self._slider.handle, name)
            self._strip = gui.add_html("")
            self._add_rows(gui)
            self._walk: viser.GuiButtonGroupHandle = gui.add_button_group("", tuple(self._does))
            name_control(self._walk, "step to take")
            self._pick = Presses(server).number_id("place on the strip", self._on_pick)
            """Id of the input that gets what of the strip is pressed, counted from its left end."""
        self._walk.on_click(lambda event: self._on_walk(event.target.value))
        # Across the bottom of the view: viser docks panels at the sides only.
        self._panel.float(x=GAP, y=-GAP, width=WIDEST)
        self._shown: int | None = None
        self._folded = False
        self._before_slider: int | None = None
        """The place that was shown before the slider was last moved."""

    def _add_rows(self, gui: viser.GuiApi) -> None:
        """Add rows between the strip and the buttons."""

    def commands(self) -> list[Command]:
        """Commands of the arrow keys."""
        return [
            Command("One step back", lambda: self._step_by(-1), "arrowleft", buttons=(LAST_STEP,)),
            Command("One step forward", lambda: self._step_by(1), "arrowright", buttons=(NEXT_STEP,)),
            Command("Previous event", lambda: self._to_event(-1), "arrowleft", "shift", (LAST_EVENT,)),
            Command("Next event", lambda: self._to_event(1), "arrowright", "shift", (NEXT_EVENT,)),
        ]

    def _step_by(self, steps: int) -> None:
        """An arrow key."""
        if not Control.took_the_key():
            self._seeks.seek_by(steps)

    def _to_event(self, direction: int) -> None:
        """An arrow key with shift; undoes the move of a slider that has the focus."""
        if Control.took_the_key():
            self._seeks.seek(self._before_slider)
        self._seeks.seek_event(direction)

    def _on_slider(self, value: int) -> None:
        self._before_slider = self._shown
        self._seek(value)

    def _seek(self, value: int) -> None:
        """Show what lies at this value of the slider."""
        self._seeks.seek(value)

    def _on_pick(self, offset: int) -> None:
        """The strip was pressed, so far from its left end."""
        raise NotImplementedError

    def _on_walk(self, name: str) -> None:
        next(does for label, does in self._does.items() if name.startswith(label))()

    def fold(self, wanted: bool) -> None:
        """Fold it to a bar, where it would cover what is looked at, or unfold what this has folded."""
        if wanted != self._folded:
            self._folded = wanted
            (self._panel.minimize if wanted else self._panel.expand)()

    def _draw_panel(self, there: bool, shown: int | None) -> bool:
        self._panel.visible = there
        self._shown = shown
        return there

    def _set_ends(self, low: int, high: int) -> None:
        handle = self._slider.handle
        # Never an empty range: the browser divides by it. Disabled, not hidden: the panel would grow at the first step.
        handle.min, handle.max, handle.disabled = min(low, high - 1), high, low >= high


class TimelinePanel(TimeBar[SessionView], MomentPart):
    """The live page's timeline. It counts control steps backwards: 0 is live and -37 is 37 steps ago, so that the slider
    rests at its right end while the simulation runs and nothing is sent. Dragging shows moments that the session has in
    memory; the worker draws pictures only after a while at one moment.
    """

    def __init__(self, server: viser.ViserServer, session: Session, clock: Clock = time.monotonic) -> None:
        zooms = {EPISODE: partial(self._zoom, True), EVERYTHING: partial(self._zoom, False)}
        does = {LIVE: self.go_live, **zooms, UNDO: session.past.undo}
        super().__init__(server, session.past, "step of the past", does, clock)
        self._session, self._clock = session, clock
        self._travel.on_click(lambda event: self._on_travel(event.target.value))
        self._episode_only = False
        self._range = (0, 0)
        """Ticks of the slider's ends."""
        self._strip_from = 0
        """Tick of the strip's left end, as it was drawn."""
        self._newest = 0
        """The tick that the slider shows as 0."""
        self._range_at = -math.inf
        self._strip_of: object = None
        """What the strip was drawn for."""
        self._stood: tuple[object, float] = (None, 0.0)

    def _add_rows(self, gui: viser.GuiApi) -> None:
        # One of these two is shown, and they have the same height: a panel that grows is moved up a moment later, its
        # last row is cut off until then, and a second press on "step" would hit another button.
        self._hint = gui.add_html("")
        self._travel = gui.add_button_group("", (GO_ON,), visible=False)
        name_control(self._travel, "way to continue")

    # --- buttons and keys --------------------------------------------------------------------------

    def go_live(self) -> None:
        self._session.past.seek(None)

    def go_to_the_first(self) -> None:
        """Go to the left end of the slider, where a slider with the focus goes too."""
        if self._episode_only:
            self._session.past.seek_tick(self._range[0], in_episode=True)
        else:
            self._session.past.seek(0)

    def continue_from_shown(self) -> None:
        self._session.past.continue_from_shown("this")

    def _seek(self, value: int) -> None:
        if value == 0:
            self._session.past.seek(None)
        else:
            self._session.past.seek_tick(self._newest + value, self._episode_only)

    def _on_pick(self, offset: int) -> None:
        self._session.past.seek_tick(self._strip_from + offset, self._episode_only)

    def _zoom(self, episode_only: bool) -> None:
        self._episode_only, self._range_at = episode_only, -math.inf

    def _on_travel(self, name: str) -> None:
        for scope, label in zip(SCOPES, self._travel.options, strict=False):
            if label == name:
                self._session.past.continue_from_shown(scope)

    # --- drawing -----------------------------------------------------------------------------------

    def urgent(self, view: SessionView) -> object:
        return super().urgent(view), self._episode_only

    def draw(self, view: SessionView) -> None:
        there = view.task is not None and view.timeline.moments > 0
        if self._draw_panel(there, view.timeline.shown):
            self._draw_slider(view)
            self._draw_buttons(view)
            self._draw_strip(view)
            self._ask_for_pictures(view)

    def _draw_slider(self, view: SessionView) -> None:
        past, now = view.timeline, self._clock()
        moved = past.shown is not None and not self._range[0] <= past.tick <= self._range[1]
        if now - self._range_at >= RANGE_EVERY or moved:
            self._range_at = now
            episode = self._session.past.episode() if self._episode_only else None
            self._range = (past.first_tick, past.last_tick) if episode is None else episode
            self._newest = past.last_tick
            self._set_ends(*(tick - self._newest for tick in self._range))
        self._slider.show(0 if past.shown is None else past.tick - self._newest)

    def _draw_buttons(self, view: SessionView) -> None:
        past = view.timeline
        # viser's buttons of a group cannot be disabled, so those that would do nothing are left out.
        undo = () if past.undo is None else (f"{UNDO} {past.undo}",)
        self._walk.options = (*WALK[:-1], EVERYTHING if self._episode_only else EPISODE, *undo)
        travel = continue_labels(view) if past.can_continue else ()
        if travel:
            self._travel.options = travel
        not_carried = "; ".join(past.not_carried)
        hint = render("timeline_hint", live=past.shown is None, not_carried=not_carried, arrived=past.arrived)
        self._hint.content = hint
        self._travel.visible, self._hint.visible = bool(travel), not travel

    def _draw_strip(self, view: SessionView) -> None:
        past = view.timeline
        wanted = (past.first, past.last, past.shown, view.selected_env, self._range)
        if wanted == self._strip_of:
            return
        self._strip_of = wanted
        low, high = self._range
        strip = self._session.past.strip(low, high)
        if strip is not None:
            self._strip_from = strip.low
            self._strip.content = strip_html(strip, view, self._pick)

    def _ask_for_pictures(self, view: SessionView) -> None:
        at = (view.timeline.shown, view.selected_env)
        if at != self._stood[0]:
            self._stood = (at, self._clock())
        elif view.timeline.wants_pictures and self._clock() - self._stood[1] > STANDS_STILL:
            self._session.past.draw()


def continue_labels(view: SessionView) -> tuple[str, ...]:
    """Labels of the go-on buttons, in the order of `SCOPES`."""
    if view.task is None or view.task.num_envs == 1:
        return (GO_ON,)
    env = f"env {view.selected_env}"
    return (f"{GO_ON}: {env}", "all envs", f"{env} into all envs")


POINTS = 240
"""Points of the reward's line, minimum and maximum of each interval in turn: a spike of one step stays visible."""
LINE_HEIGHT = 30.0
"""Height of the line in the picture's units; the marks are above."""
FLAGS = {
    REWARD_NONFINITE: "odd",
    FAIL: "fail",
    SUCCESS: "success",
    TRUNCATED: "limit",
    WENT_BACK: "back",
    RESET: "reset",
}
"""Style of each event's mark; of several events at once the first of these is drawn."""
NAMES = {
    "odd": "reward is NaN or infinite",
    "fail": "fail",
    "success": "success",
    "limit": "time limit",
    "back": "went back",
    "reset": "reset",
    "other": "other event",
}
"""Legend of the styles."""
MOST_MARKS = 250
"""Places of the strip that have a mark each: what is nearer together cannot be told apart."""


def strip_values(
    low: int, high: int, reward: NDArray[np.float32], styles: Collection[str]
) -> dict[str, object]:
    """The values that the templates of both timelines share.

    Args:
        low: First place of the strip.
        high: Last place.
        reward: (high - low + 1,), NaN where there is none.
        styles: Of the marks on it.
    """

    def place(at: float) -> float:
        """Per cent of the strip's width, clamped."""
        return round(100 * (min(max(at, low), high) - low) / max(high - low, 1), 3)

    kinds = [(style, name) for style, name in NAMES.items() if style in styles]
    return {"place": place, "lines": reward_lines(reward), "kinds": kinds}


def marks_of(strip: Strip) -> list[tuple[int, str, str]]:
    """Tick, style and name of each mark. Of several events that fall on one place the first of `FLAGS` is drawn."""
    rank, names = list(FLAGS), dict(strip.branches)
    marks: dict[int, tuple[int, int, str]] = {}
    for tick, flags in strip.events:
        flag = next(flag for flag in rank if flags & flag)
        place = MOST_MARKS * (tick - strip.low) // (strip.high - strip.low + 1)
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


def strip_html(strip: Strip, view: SessionView, pick: str = "") -> str:
    """The strip of one env with its shown moment.

    Args:
        pick: id of the input that gets the tick of a press.
    """
    has_reward = view.task is None or view.task.reward_mode != "none"
    # ManiSkill's reward is 0 where a task has none.
    reward = strip.reward if has_reward else np.full_like(strip.reward, np.nan)
    marks, finite = marks_of(strip), reward[np.isfinite(reward)]
    return render(
        "timeline",
        strip=strip,
        pick=pick,
        past=view.timeline,
        marks=marks,
        ago=ago_in_words(view.timeline),
        where=where(view),
        span=[_number(float(value)) for value in (finite.min(), finite.max())] if len(finite) else None,
        megabytes=megabytes,
        **strip_values(strip.low, strip.high, reward, {style for _, style, _ in marks}),
    )


def _number(value: float) -> str:
    return number_text(value, ".3g")


def ago_in_words(past: TimelineView) -> str:
    """``7 steps ago``, of the shown moment."""
    # An episode's last step is at the tick of the reset that follows it.
    return f"{counted(past.steps_ago, 'step')} ago" if past.steps_ago else "before the last reset"


def step_in_words(view: SessionView) -> str:
    """The selected env's step of its episode, as text."""
    task, step = view.task, view.step
    if task is None or step is None or view.selected_env >= len(step.elapsed_steps):
        return ""
    limit = f" / {task.max_episode_steps}" if task.max_episode_steps else ""
    env = "" if task.num_envs == 1 else f"env {view.selected_env}: "
    return f"{env}step {int(step.elapsed_steps[view.selected_env])}{limit}"


def where(view: SessionView) -> str:
    """Env, step of its episode and simulated time of the shown moment."""
    words = step_in_words(view)
    if not words or view.task is None or view.step is None:
        return words
    return f"{words}, {view.step.elapsed_steps[view.selected_env] * view.task.control_dt:.2f} s"


def reward_lines(reward: NDArray[np.float32]) -> list[str]:
    """SVG polylines of the finite rewards over x 0..100 and y 0..`LINE_HEIGHT` (greatest on top), with gaps. One value
    alone is a line in the middle."""
    finite = reward[np.isfinite(reward)]
    if not len(finite):
        return []
    low, high = float(finite.min()), float(finite.max())
    if low == high:
        low, high = low - 1.0, high + 1.0
    known = np.where(np.isfinite(reward), reward, np.nan)
    if len(known) <= POINTS:
        places, values = np.arange(len(known)), known
    else:
        edges = np.linspace(0, len(known), POINTS // 2 + 1).astype(int)[:-1]
        values = np.stack([np.fmin.reduceat(known, edges), np.fmax.reduceat(known, edges)], 1).reshape(-1)
        places = np.repeat(edges, 2)
    x = 100 * places / max(len(known) - 1, 1)
    y = LINE_HEIGHT * (1 - (values - low) / (high - low))
    return polylines([None if np.isnan(b) else f"{a:.2f},{b:.1f}" for a, b in zip(x, y, strict=True)])


def polylines(points: Sequence[str | None]) -> list[str]:
    """``points`` of SVG polylines through these points, with a gap at each None."""
    runs = [[point for point in run if point] for there, run in groupby(points, key=bool) if there]
    # A polyline of one point is not drawn; one of length zero with round ends is a dot.
    return [" ".join(run if len(run) > 1 else run * 2) for run in runs]


def megabytes(size: int) -> str:
    return f"{size / 1024**2:.0f}" if size >= 10 * 1024**2 else f"{size / 1024**2:.1f}"

"""The timeline: one slider over the past, under the view, with what happened to the selected env on it.

It counts backwards from now: 0 is live and -37 is 37 steps ago. So the slider rests at its right end while the
simulation runs, and nothing has to be sent to keep it there. The strip under it is drawn by the server as one
small SVG, a few times a second at most: the reward of the selected env, its episodes as bands, its events as
marks, and an arc where it went back.

Dragging asks the session for another moment, which it has in memory; only when somebody has stood still at a
moment for a while are its pictures asked of the worker, where there are none.
"""

from __future__ import annotations

import math
import time

import viser

from workbench.session.session import Session
from workbench.session.timeline import Scope
from workbench.session.view import SessionView
from workbench.ui.control_values import checked_int, name_control
from workbench.ui.controls import Control
from workbench.ui.fragments import render
from workbench.ui.over_the_view import GAP, FitsTheView
from workbench.ui.parts import Clock, DrawDue, Part
from workbench.ui.timeline_strip import strip_values

WIDEST, NARROWEST = 760, 280
HEIGHT = 205
"""Pixels of the view that it lies over, for whoever frames a scene."""
REDRAW_EVERY = 0.2
RANGE_EVERY = 0.5
"""Seconds. A slider whose ends move at every step cannot be held."""
STANDS_STILL = 0.35
"""Seconds at one moment after which its pictures are drawn: less, and every drag would draw some."""
LAST_EVENT, LAST_STEP, NEXT_STEP, NEXT_EVENT, NOW = "‹ event", "‹ step", "step ›", "event ›", "now"
EPISODE, EVERYTHING = "zoom to episode", "zoom out"
SCOPES: tuple[Scope, ...] = ("this", "all", "into all")
GO_ON = "Go on from here"
UNDO = "undo"
"""How the button begins that takes back a jump; what and of how many envs follows."""
WALK = (LAST_EVENT, LAST_STEP, NEXT_STEP, NEXT_EVENT, NOW, EPISODE)


class TimelinePanel(Part[SessionView]):
    def __init__(self, server: viser.ViserServer, session: Session, clock: Clock = time.monotonic) -> None:
        self._session, self._clock = session, clock
        gui = server.gui
        self._panel = gui.add_panel(visible=False, order=10.0)
        with self._panel.add_tab("Timeline", viser.Icon.HISTORY):
            self._slider = Control(
                gui.add_slider("", min=-1, max=0, step=1, initial_value=0),
                read=lambda value: checked_int(value, -(10**9), 0, "step of the past"),
                send=self._seek,
                clock=clock,
            )
            name_control(self._slider.handle, "step of the past")
            self._strip = gui.add_html("")
            # One of these two rows is there, and they are equally high: a panel that grows is moved up only a moment
            # later, its last row is cut off until then, and a second press on "step" would meet another button.
            self._hint = gui.add_html("")
            self._travel = gui.add_button_group("", (GO_ON,), visible=False)
            self._walk = gui.add_button_group("", WALK)
            name_control(self._travel, "way to go on")
            name_control(self._walk, "step to take")
        self._walk.on_click(lambda event: self._on_walk(event.target.value))
        self._travel.on_click(lambda event: self._on_travel(event.target.value))
        # Across the bottom of the view: viser docks panels at the sides only.
        self._panel.float(x=GAP, y=-GAP, width=WIDEST)
        self._fits = FitsTheView(server, self._panel, WIDEST, NARROWEST)
        self._episode_only = False
        self._range = (0, 0)
        """Serials of the slider's ends."""
        self._shown: int | None = None
        self._before_slider: int | None = None
        """What was shown before the slider was last moved."""
        self._newest = 0
        """The serial that the page last took for 0."""
        self._range_at = -math.inf
        self._strip_due = DrawDue(REDRAW_EVERY, clock)
        self._stood: tuple[object, float] = (None, 0.0)

    # --- what buttons and keys do ------------------------------------------------------------------

    def step_by(self, steps: int) -> None:
        """An arrow key."""
        if not Control.took_the_key():
            self._session.past.seek_by(steps)

    def to_event(self, direction: int) -> None:
        """An arrow key with shift; what a slider that has the focus made of it is taken back."""
        if Control.took_the_key():
            self._session.past.seek(self._before_slider)
        self._session.past.seek_event(direction)

    def go_live(self) -> None:
        self._session.past.seek(None)

    def go_to_the_first(self) -> None:
        """To the left end of the slider, which may have the focus and go there as well."""
        self._session.past.seek(self._range[0] if self._episode_only else 0)

    def go_on(self) -> None:
        self._session.past.go_on("this")

    def _seek(self, value: int) -> None:
        self._before_slider = self._shown
        self._session.past.seek(None if value == 0 else self._newest + value)

    def _on_walk(self, name: object) -> None:
        if name in (LAST_STEP, NEXT_STEP):
            self._session.past.seek_by(1 if name == NEXT_STEP else -1)
        elif name in (LAST_EVENT, NEXT_EVENT):
            self._session.past.seek_event(1 if name == NEXT_EVENT else -1)
        elif name == NOW:
            self.go_live()
        elif name in (EPISODE, EVERYTHING):
            self._episode_only = name == EPISODE
            self._range_at = -math.inf
        elif isinstance(name, str) and name.startswith(UNDO):
            self._session.past.undo()

    def _on_travel(self, name: object) -> None:
        for scope, label in zip(SCOPES, self._travel.options, strict=False):
            if label == name:
                self._session.past.go_on(scope)

    # --- drawing -----------------------------------------------------------------------------------

    def draw(self, view: SessionView) -> None:
        past = view.timeline
        there = view.task is not None and past.moments > 0
        self._panel.visible = there
        if not there or view.task is None:
            return
        self._shown = past.shown
        self._fits.fit()
        self._draw_slider(view)
        self._draw_buttons(view)
        self._draw_strip(view)
        self._ask_for_pictures(view)

    def _draw_slider(self, view: SessionView) -> None:
        past, now = view.timeline, self._clock()
        moved = past.shown is not None and not self._range[0] <= past.shown <= self._range[1]
        if now - self._range_at >= RANGE_EVERY or moved:
            self._range_at = now
            stretch = self._session.past.stretch() if self._episode_only else None
            self._range = (past.first, past.last) if stretch is None else stretch
            self._newest = past.last
            low, high = (serial - self._newest for serial in self._range)
            handle = self._slider.handle
            # Never an empty range, which the browser divides by.
            handle.min, handle.max = min(low, high - 1), high
        self._slider.show(0 if past.shown is None else past.shown - self._newest)

    def _draw_buttons(self, view: SessionView) -> None:
        past = view.timeline
        # A group of buttons cannot be greyed, so what would do nothing is left out.
        undo = () if past.undo is None else (f"{UNDO} {past.undo}",)
        self._walk.options = (*WALK[:-1], EVERYTHING if self._episode_only else EPISODE, *undo)
        travel = go_on_labels(view) if past.can_go_on else ()
        if travel:
            self._travel.options = travel
        not_carried = "; ".join(past.not_carried)
        hint = render("timeline_hint", live=past.shown is None, not_carried=not_carried, arrived=past.arrived)
        self._hint.content = hint
        self._travel.visible, self._hint.visible = bool(travel), not travel

    def _draw_strip(self, view: SessionView) -> None:
        past = view.timeline
        wanted = (past.first, past.last, past.shown, view.selected_env, self._range, view.playing)
        if not self._strip_due.is_due(wanted):
            return
        low, high = self._range
        strip = self._session.past.strip(low, high)
        if strip is not None:
            self._strip.content = render("timeline", **strip_values(strip, view))

    def _ask_for_pictures(self, view: SessionView) -> None:
        at = (view.timeline.shown, view.selected_env)
        if at != self._stood[0]:
            self._stood = (at, self._clock())
        elif view.timeline.wants_pictures and self._clock() - self._stood[1] > STANDS_STILL:
            self._session.past.draw()


def go_on_labels(view: SessionView) -> tuple[str, ...]:
    """Of the buttons that go back, in the order of `SCOPES`."""
    if view.task is None or view.task.num_envs == 1:
        return (GO_ON,)
    env = f"env {view.selected_env}"
    return (f"{GO_ON}: {env}", "all envs", f"{env} into all envs")

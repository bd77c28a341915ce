"""The timeline of a review: the live page's slider, strip and keys, over recordings that are whole.

It lies where the live one lies and looks the same, but counts forwards: a recording has a beginning and an end, and
nothing is added to it. With several recordings each has a line of its own on the strip, placed as they are aligned.
"""

from __future__ import annotations

import numpy as np
import viser

from workbench.session.review import MOST_COMPARED, Review
from workbench.session.review_view import Opened, ReviewView, column_at
from workbench.ui.control_values import checked_int, name_control
from workbench.ui.controls import Control
from workbench.ui.fragments import render
from workbench.ui.over_the_view import GAP, FitsTheView
from workbench.ui.parts import Part
from workbench.ui.review_scene import COLOURS, letter
from workbench.ui.timeline_panel import (
    LAST_EVENT,
    LAST_STEP,
    NARROWEST,
    NEXT_EVENT,
    NEXT_STEP,
    WIDEST,
)
from workbench.ui.timeline_strip import MOST_MARKS, reward_lines

PLAY, PAUSE = "play", "pause"
FIRST, LAST = "first", "last"
NAMES = {
    "success": "success",
    "fail": "fail",
    "limit": "time limit",
    "odd": "NaN or infinite",
    "other": "other event",
}


class ReviewTimeline(Part[ReviewView]):
    def __init__(self, server: viser.ViserServer, review: Review) -> None:
        self._review = review
        gui = server.gui
        self._panel = gui.add_panel(visible=False, order=10.0)
        with self._panel.add_tab("Timeline", viser.Icon.HISTORY):
            self._slider = Control(
                gui.add_slider("", min=0, max=1, step=1, initial_value=0),
                read=lambda value: checked_int(value, *self._ends, "step of the timeline"),
                send=self._seek,
            )
            name_control(self._slider.handle, "step of the timeline")
            self._strip = gui.add_html("")
            self._walk = gui.add_button_group("", walk(False))
        self._walk.on_click(lambda event: self._on_walk(event.target.value))
        self._panel.float(x=GAP, y=-GAP, width=WIDEST)
        self._fits = FitsTheView(server, self._panel, WIDEST, NARROWEST)
        self._ends = (0, 1)
        self._shown = 0
        self._before_slider = 0
        self._drawn: object = None
        self._fixed: tuple[object, dict[str, object]] = (None, {})

    # --- what buttons and keys do --------------------------------------------------------------------

    def step_by(self, steps: int) -> None:
        """An arrow key."""
        if not Control.took_the_key():
            self._review.seek_by(steps)

    def to_event(self, direction: int) -> None:
        """An arrow key with shift; what a slider that has the focus made of it is taken back."""
        if Control.took_the_key():
            self._review.seek(self._before_slider)
        self._review.seek_event(direction)

    def _seek(self, value: int) -> None:
        self._before_slider = self._shown
        self._review.seek(value)

    def _on_walk(self, name: object) -> None:
        if name in (LAST_STEP, NEXT_STEP):
            self._review.seek_by(1 if name == NEXT_STEP else -1)
        elif name in (LAST_EVENT, NEXT_EVENT):
            self._review.seek_event(1 if name == NEXT_EVENT else -1)
        elif name in (PLAY, PAUSE):
            self._review.toggle_play()
        elif name == FIRST:
            self._review.to_first()
        elif name == LAST:
            self._review.to_last()

    # --- drawing -------------------------------------------------------------------------------------

    def draw(self, view: ReviewView) -> None:
        self._panel.visible = bool(view.opened)
        if not view.opened:
            return
        self._fits.fit()
        self._shown = view.position
        handle = self._slider.handle
        low, high = view.first, max(view.last, view.first + 1)
        handle.min, handle.max = self._ends = low, high
        self._slider.show(view.position)
        self._walk.options = walk(view.playing)
        wanted = (view.position, view.selected, view.opened_serial, view.anchors, view.align)
        if wanted == self._drawn:
            return
        self._drawn = wanted
        # Only the cursor and the words follow the position.
        if self._fixed[0] != wanted[1:]:
            self._fixed = (wanted[1:], strip_values(view))
        self._strip.content = render("review_timeline", **self._fixed[1], **cursor_values(view))


def walk(playing: bool) -> tuple[str, ...]:
    """The buttons under the strip."""
    return (FIRST, LAST_EVENT, LAST_STEP, PAUSE if playing else PLAY, NEXT_STEP, NEXT_EVENT, LAST)


def place(view: ReviewView, position: float) -> float:
    """Where a position lies on the strip, per cent of its width."""
    return round(100 * (position - view.first) / max(view.last - view.first, 1), 3)


def strip_values(view: ReviewView) -> dict[str, object]:
    """What of the strip stays while the position moves."""
    compared = (
        list(enumerate(view.opened))[:MOST_COMPARED]
        if len(view.opened) <= MOST_COMPARED
        else [(view.selected, view.opened[view.selected])]
    )
    rows, styles = [], set()
    for index, one in compared:
        anchor = view.anchors[index]
        marks = [h for h in one.happenings if h.style != "reset"][:MOST_MARKS]
        styles |= {h.style for h in marks}
        rows.append(
            {
                "letter": letter(index) if len(view.opened) > 1 else "",
                "colour": COLOURS[index % len(COLOURS)],
                "x": place(view, -anchor),
                "width": round(place(view, one.length - anchor) - place(view, -anchor), 3),
                "selected": index == view.selected,
                "marks": [
                    {"x": place(view, h.state - anchor), "style": h.style, "name": h.name, "state": h.state}
                    for h in marks
                ],
            }
        )
    chosen = view.opened[view.selected]
    return {
        "rows": rows,
        "lines": reward_lines(_reward_over(view, chosen)),
        "line_colour": COLOURS[view.selected % len(COLOURS)] if len(view.opened) > 1 else "",
        "zero": None if view.align == "start" or view.first == 0 else place(view, 0),
        "align": view.align,
        "kinds": [(style, name) for style, name in NAMES.items() if style in styles],
    }


def cursor_values(view: ReviewView) -> dict[str, object]:
    chosen = view.opened[view.selected]
    state, dt = view.states[view.selected], chosen.episode.info.control_dt
    inside = 0 <= view.position + view.anchors[view.selected] <= chosen.length
    words = f"step {state} / {chosen.length}, {state * dt:.2f} s"
    if len(view.opened) > 1:
        words = f"{letter(view.selected)}: {words}"
    here = [h.name for h in chosen.happenings if h.state == state and h.style != "reset"]
    return {
        "cursor": place(view, view.position),
        "where": words,
        "beyond": "" if inside else "(it has no state there)",
        "here": ", ".join(here) if inside else "",
    }


def _reward_over(view: ReviewView, one: Opened) -> np.ndarray:
    axis = np.arange(view.first, view.last + 1)
    anchor = view.anchors[view.opened.index(one)]
    reward = np.asarray(one.episode.reward, np.float64)
    return column_at(np.arange(1, len(reward) + 1), reward, anchor, axis).astype(np.float32)

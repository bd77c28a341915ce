"""The timeline of a review: the live page's slider, strip and keys, over recordings that are whole.

It lies where the live one lies and looks the same, but counts forwards: a recording has a beginning and an end, and
nothing is added to it. With several recordings each has a line of its own on the strip, placed as they are aligned.
"""

from __future__ import annotations

import time
from functools import partial

import numpy as np
import viser

from workbench.session.review import MOST_COMPARED, Review
from workbench.session.review_view import Opened, ReviewView, column_at
from workbench.ui.fragments import render
from workbench.ui.parts import Clock
from workbench.ui.review_scene import COLOURS, letter
from workbench.ui.timeline_panel import (
    LAST_EVENT,
    LAST_STEP,
    MOST_MARKS,
    NEXT_EVENT,
    NEXT_STEP,
    TimeBar,
    place_between,
    reward_lines,
)

PLAY, PAUSE = "play", "pause"
FIRST, LAST = "first", "last"
NAMES = {
    "success": "success",
    "fail": "fail",
    "limit": "time limit",
    "odd": "NaN or infinite",
    "other": "other event",
}


class ReviewTimeline(TimeBar[ReviewView]):
    def __init__(self, server: viser.ViserServer, review: Review, clock: Clock = time.monotonic) -> None:
        does = {
            PLAY: review.toggle_play,
            PAUSE: review.toggle_play,
            FIRST: review.to_first,
            LAST: review.to_last,
        }
        super().__init__(server, review, "step of the timeline", does, clock)
        self._drawn: object = None
        self._fixed: tuple[object, dict[str, object]] = (None, {})

    def draw(self, view: ReviewView) -> None:
        if not self._draw_panel(bool(view.opened), view.position):
            return
        self._set_ends(view.first, view.last)
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


def strip_values(view: ReviewView) -> dict[str, object]:
    """What of the strip stays while the position moves."""
    compared = (
        list(enumerate(view.opened))[:MOST_COMPARED]
        if len(view.opened) <= MOST_COMPARED
        else [(view.selected, view.opened[view.selected])]
    )
    place = partial(place_between, view.first, view.last)
    rows, styles = [], set()
    for index, one in compared:
        anchor = view.anchors[index]
        marks = [h for h in one.happenings if h.style != "reset"][:MOST_MARKS]
        styles |= {h.style for h in marks}
        rows.append(
            {
                "letter": letter(index) if len(view.opened) > 1 else "",
                "colour": COLOURS[index % len(COLOURS)],
                "x": place(-anchor),
                "width": round(place(one.length - anchor) - place(-anchor), 3),
                "selected": index == view.selected,
                "marks": [
                    {"x": place(h.state - anchor), "style": h.style, "name": h.name, "state": h.state}
                    for h in marks
                ],
            }
        )
    chosen = view.opened[view.selected]
    return {
        "rows": rows,
        "lines": reward_lines(_reward_over(view, chosen)),
        "line_colour": COLOURS[view.selected % len(COLOURS)] if len(view.opened) > 1 else "",
        "zero": None if view.align == "start" or view.first == 0 else place(0),
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
        "cursor": place_between(view.first, view.last, view.position),
        "where": words,
        "beyond": "" if inside else "(it has no state there)",
        "here": ", ".join(here) if inside else "",
    }


def _reward_over(view: ReviewView, one: Opened) -> np.ndarray:
    axis = np.arange(view.first, view.last + 1)
    anchor = view.anchors[view.opened.index(one)]
    reward = np.asarray(one.episode.reward, np.float64)
    return column_at(np.arange(1, len(reward) + 1), reward, anchor, axis).astype(np.float32)

"""The timeline of a review: the live page's slider, strip and keys, over recordings that are whole.

It lies where the live one lies and looks the same, but counts forwards: a recording has a beginning and an end, and
nothing is added to it. With several recordings each has a line of its own on the strip, placed as they are aligned.
"""

from __future__ import annotations

import time

import numpy as np
import viser

from workbench.session.review import Review
from workbench.session.review_view import ReviewView, column_at
from workbench.ui.fragments import render
from workbench.ui.parts import Clock
from workbench.ui.review_scene import shown_together
from workbench.ui.timeline_panel import (
    LAST_EVENT,
    LAST_STEP,
    MOST_MARKS,
    NEXT_EVENT,
    NEXT_STEP,
    TimeBar,
    strip_values,
)

PLAY, PAUSE = "play", "pause"
FIRST, LAST = "first", "last"


class ReviewTimeline(TimeBar[ReviewView]):
    def __init__(self, server: viser.ViserServer, review: Review, clock: Clock = time.monotonic) -> None:
        does = {
            PLAY: review.toggle_play,
            PAUSE: review.toggle_play,
            FIRST: review.to_first,
            LAST: review.to_last,
        }
        super().__init__(server, review, "step of the timeline", does, clock)
        self._drawn: tuple[object, ...] = ()
        self._fixed: dict[str, object] = {}

    def draw(self, view: ReviewView) -> None:
        if not self._draw_panel(bool(view.opened), view.position):
            return
        self._set_ends(view.first, view.last)
        self._slider.show(view.position)
        self._walk.options = walk(view.playing)
        wanted = (view.position, view.selected, view.opened_serial, view.anchors, view.align)
        if wanted == self._drawn:
            return
        # Only the cursor and the words follow the position.
        if wanted[1:] != self._drawn[1:]:
            self._fixed = fixed_values(view)
        self._drawn = wanted
        one, state = view.opened[view.selected], view.states[view.selected]
        self._strip.content = render("review_timeline", view=view, one=one, state=state, **self._fixed)


def walk(playing: bool) -> tuple[str, ...]:
    """The buttons under the strip."""
    return (FIRST, LAST_EVENT, LAST_STEP, PAUSE if playing else PLAY, NEXT_STEP, NEXT_EVENT, LAST)


def fixed_values(view: ReviewView) -> dict[str, object]:
    """What of the strip stays while the position moves."""
    rows = [
        (index, [h for h in view.opened[index].happenings if h.style != "reset"][:MOST_MARKS])
        for index in shown_together(view)
    ]
    reward = np.asarray(view.opened[view.selected].episode.reward, np.float64)
    after, anchor = np.arange(1, len(reward) + 1), view.anchors[view.selected]
    over = column_at(after, reward, anchor, np.arange(view.first, view.last + 1)).astype(np.float32)
    styles = {h.style for _, marks in rows for h in marks}
    return {"rows": rows, **strip_values(view.first, view.last, over, styles)}

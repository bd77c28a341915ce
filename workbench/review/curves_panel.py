"""The Curves tab of a review: numbers of the recordings at the position, and curves over all steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.envs.step_result import StepResult
from workbench.episodes.episode import Episode
from workbench.live.history.curves import spans_of
from workbench.live.panels.reward_panel import COLOURS as LINE_COLOURS
from workbench.live.panels.reward_panel import NumberRow, number_rows
from workbench.live.timeline_commands import Seek
from workbench.page.command import Command, Refused
from workbench.page.widgets.fields import by_name, choice
from workbench.page.widgets.line_chart import ChartLine, LineChart, span_of
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import colour, letter, render
from workbench.page.widgets.visitors import Visitor
from workbench.review.commands import ChooseReviewCurve
from workbench.review.scene_view import shown_together
from workbench.review.view import ACTION, REWARD, TERMS, ReviewView, column_at, curves

CHARTS = {"reward": 150, "also": 150, "terms": 150, "action": 190}
"""Height in pixels of each chart, in the order from top to bottom."""
Lines = dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]


class ReviewNumbers(PagePart[ReviewView]):
    """The table of numbers at the position."""

    every = 0.09

    def __init__(self, server: viser.ViserServer) -> None:
        self._html = server.gui.add_html("")

    def key(self, view: ReviewView) -> object:
        return view.opened_serial, view.selected, view.position, view.anchors

    def draw(self, view: ReviewView) -> None:
        chosen = view.chosen
        if chosen is None:
            self._html.content = render("note", text="Numbers and curves appear when a recording is open.")
            return
        own = number_rows(
            step_of(chosen.episode, view.states[view.selected]), 0, chosen.length, _mode_of(chosen.episode)
        )
        beside = [(own, view.states[view.selected])]
        together = shown_together(view)
        if len(together) > 1:
            episodes = [(view.opened[i].episode, view.states[i]) for i in together]
            beside = [
                (number_rows(step_of(episode, state), 0, None, _mode_of(episode)), state)
                for episode, state in episodes
            ]
        self._html.content = render("review_numbers", rows=compared(own, beside), of=together)


class ReviewCurves(PagePart[ReviewView]):
    """Charts of the reward and of a chosen entry, each with one line per recording (see `shown_together`).

    The action and the reward terms have many lines, so they are drawn only for the selected recording.
    """

    every = 0.15
    does = (ChooseReviewCurve,)

    def __init__(self, server: viser.ViserServer) -> None:
        self._entry = choice(server, "Also", ChooseReviewCurve, "curve", (), "")
        self._charts = {
            name: LineChart(server, height, lambda step: Seek(step=step)) for name, height in CHARTS.items()
        }
        self._lines_drawn: object = None
        self._found: dict[str, dict[str, Lines]] = {}
        self._offered: dict[str, tuple[str, str]] = {}
        """(entry, line) of each choice; the line is empty if the entry has a single line."""
        self._wish = ""
        """Last chosen entry; kept even while the open recordings lack it."""

    def key(self, view: ReviewView) -> object:
        which = view.opened_serial, len(view.opened), view.selected
        return *which, view.position, view.anchors, self._wish

    def draw(self, view: ReviewView) -> None:
        # Curves are kept by id: a recording that gets its scene later becomes a new object with the same id
        # and curves.
        self._found = {one.id: self._found.get(one.id) or curves(one.episode) for one in view.opened}
        shown = shown_together(view)
        also = self._offer(view, shown)
        self._draw_entry("reward", REWARD, view, shown)
        self._draw_entry("also", also, view, shown)
        lines = (view.opened_serial, view.selected, view.anchors, len(view.opened))
        if lines != self._lines_drawn:
            # These charts do not depend on the position. A browser would redraw a chart that is sent again.
            self._lines_drawn = lines
            self._draw_lines("terms", TERMS, view)
            self._draw_lines("action", ACTION, view)

    # --- charts --------------------------------------------------------------------------------------

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ChooseReviewCurve(curve=curve):
                if curve not in self._offered:
                    raise Refused("The open recordings have no such entry.")
                self._wish = curve

    def _offer(self, view: ReviewView, shown: Sequence[int]) -> str:
        """Offer the entries of the shown recordings as choices. Returns the chosen entry; empty if there is
        none."""
        found = [self._found[view.opened[index].id] for index in shown]
        self._offered = {
            name if len(lines) == 1 else f"{name}: {line}": (name, "" if len(lines) == 1 else line)
            for entries in found
            for name, lines in entries.items()
            if name not in (REWARD, TERMS, ACTION)
            for line in lines
        }
        for entries in found:
            for group in (TERMS, ACTION):
                self._offered |= {f"{group}: {line}": (group, line) for line in entries.get(group, {})}
        wishes = self._wish, "success", *self._offered
        chosen = next((one for one in wishes if one in self._offered), "")
        self._entry.visible = bool(chosen)
        self._entry.show(chosen, options=by_name(tuple(self._offered)))
        return chosen

    def _draw_entry(self, chart: str, entry: str, view: ReviewView, shown: Sequence[int]) -> None:
        """Draw one entry for all compared recordings."""
        group, line = self._offered.get(entry, (entry, ""))
        drawn: list[ChartLine] = []
        cursor = 0
        for index in shown:
            one = view.opened[index]
            lines = self._found[one.id].get(group)
            if not lines or (line and line not in lines):
                continue
            if index == view.selected:
                cursor = len(drawn)
            states, values = lines[line] if line else next(iter(lines.values()))
            name = letter(index) if len(view.opened) > 1 else entry
            over = column_at(states, values, view.anchors[index], axis_of(view))
            drawn.append(ChartLine(name, over, colour(index), 1.7))
        self._put(chart, entry, view, drawn, drawn[cursor] if drawn else None, view.position)

    def _draw_lines(self, chart: str, entry: str, view: ReviewView) -> None:
        """Draw an entry with several lines for the selected recording."""
        chosen, axis = view.chosen, axis_of(view)
        lines = {} if chosen is None else self._found[chosen.id].get(entry, {})
        drawn = [
            ChartLine(name, column_at(states, values, view.anchors[view.selected], axis), tone, 1.7)
            for (name, (states, values)), tone in zip(lines.items(), LINE_COLOURS, strict=False)
        ]
        whose = f", {letter(view.selected)}" if len(view.opened) > 1 else ""
        self._put(chart, f"{entry}{whose}", view, drawn)

    def _put(
        self,
        chart: str,
        title: str,
        view: ReviewView,
        drawn: list[ChartLine],
        chosen: ChartLine | None = None,
        at: int | None = None,
    ) -> None:
        """Draw the lines. If there are many positions, draw only the lowest and the highest value of each
        span of positions.

        Args:
            chosen: The line whose peaks are drawn at their exact positions; the peaks of the other lines are
                off by less than one span.
            at: The present position.
        """
        # Put the chosen line first: `points` takes its x values from the first line's extremes, so only that
        # line's peaks are exact.
        ordered = sorted(drawn, key=lambda line: line is not chosen)
        if not ordered:
            self._charts[chart].hide()
            return
        x, values = spans_of(np.stack([line.values for line in ordered]), first=view.first).points()
        found = {id(line): own for line, own in zip(ordered, values, strict=True)}
        lines = [replace(line, values=found[id(line)]) for line in drawn]
        self._charts[chart].draw(title, x, lines, at, span_of([line.values for line in lines]))


def _mode_of(episode: Episode) -> str:
    """The reward mode for `number_rows`: ``none`` if the episode has no reward, else empty."""
    return "" if episode.info.has_reward else "none"


def step_of(episode: Episode, state: int) -> StepResult:
    """One state of a recording as a batch of one env."""
    before = state - 1
    return StepResult(
        elapsed_steps=np.array([state], np.int32),
        reward=np.asarray(episode.reward[before : before + 1] if state else [0.0], np.float32),
        terminated=np.asarray(episode.terminated[before : before + 1] if state else [False], bool),
        truncated=np.asarray(episode.truncated[before : before + 1] if state else [False], bool),
        evaluate={name: values[state : state + 1] for name, values in episode.evaluate.items()},
        poses=np.zeros((1, 0, 7), np.float32) if episode.poses is None else episode.poses[state : state + 1],
        action=episode.action[before : before + 1] if state else None,
        others=episode.other_entries_at(state),
    )


def known(number: str, state: int) -> str:
    """The text of a number, with a dash for NaN at state 0: no step led to that state. Any later NaN comes
    from the task."""
    return "—" if number == "NaN" and state == 0 else number


def compared(
    rows: Sequence[NumberRow], beside: Sequence[tuple[Sequence[NumberRow], int]]
) -> list[dict[str, Any]]:
    """Rows of the table: the entries of the selected recording, then the entries that only other recordings
    have.

    Args:
        beside: (rows, state) of each recording that has a column.
    """
    tones = {row.name: row.tone for row in rows}
    for others, _ in beside:
        for row in others:
            tones.setdefault(row.name, "")
    columns = [
        {row.name: known(row.whole or row.selected, state) for row in others} for others, state in beside
    ]
    hints = {row.name: row.hint for others, _ in reversed(beside) for row in others if row.whole}
    return [
        {
            "name": name,
            "tone": tone,
            "whole": name in hints,
            "hint": hints.get(name, ""),
            "values": [column.get(name, "—") for column in columns],
        }
        for name, tone in tones.items()
    ]


def axis_of(view: ReviewView) -> NDArray[np.int64]:
    return np.arange(view.first, view.last + 1)

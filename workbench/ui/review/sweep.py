"""The Sweep tab: the points of a sweep as parallel coordinates and as a table, and the episodes of one to open."""

from __future__ import annotations

import json
import logging
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import viser

from workbench.commands.command import Command
from workbench.commands.review import (
    ClearSweepFilter,
    FilterSweep,
    OpenSweepEpisode,
    ShowSweepPoint,
    SortSweep,
    TurnSweep,
)
from workbench.machine.processes.watched_thread import watched_thread
from workbench.recording.episode.row import UnreadableRecording
from workbench.recording.library.library import Library
from workbench.recording.reader.reading import read_sweep
from workbench.recording.sweeps import RESULTS, PointSummary, SweepEpisode, SweepResults, value_text
from workbench.session.review.view import ReviewView
from workbench.ui.widgets.paged import Paged
from workbench.ui.widgets.parts import PagePart
from workbench.ui.widgets.templates import render, short_text
from workbench.ui.widgets.visitors import Visitor

log = logging.getLogger(__name__)

ROWS = 12
"""Number of rows of a page of the table."""
MOST_AXES = 9
MOST_TICKS = 8
"""Maximum number of labels of an axis."""
MOST_PRESSED = 64
"""Maximum number of lines that can be pressed."""
MOST_SHOWN = 5
"""Number of best and of worst episodes of a point that are shown."""
WIDTH, TOP, BOTTOM, SIDE = 500, 34, 196, 34
"""Sizes in pixels of the plot and of its axes."""
_TERMS = "reward_terms/"
_RATE = "success"


@dataclass(frozen=True)
class Axis:
    """An axis of the plot."""

    name: str
    x: float
    heights: tuple[float | None, ...]
    """Height of each point in pixels; None for a point without a value."""
    ticks: tuple[tuple[str, float, str], ...]
    """Label and height of each tick, and the JSON of a set value."""


def axes_of(results: SweepResults, summaries: Sequence[PointSummary]) -> list[Axis]:
    """The set values, the success rate, the return and as many terms as there is room for."""
    places: list[tuple[str, Any]] = []
    for name in results.names:
        texts = sorted({one.values[name] for one in summaries}, key=_in_order)
        places.append((name, texts))
    if any(one.rate is not None for one in summaries):
        places.append((_RATE, [one.rate for one in summaries]))
    places.append(("return", [one.mean_return for one in summaries]))
    for name in terms_of(summaries):
        places.append((name.removeprefix(_TERMS), [one.means.get(name) for one in summaries]))
    places = places[: max(MOST_AXES, len(results.names) + 2)]
    gap = (WIDTH - 2 * SIDE) / max(len(places) - 1, 1)
    made = []
    for k, (name, values) in enumerate(places):
        x = SIDE + k * gap
        if k < len(results.names):
            made.append(_of_set(name, x, values, summaries))
        else:
            # By its place: a term of the reward may be called so too.
            is_rate = k == len(results.names) and name == _RATE
            made.append(_of_numbers(name, x, values, is_rate))
    return made


def terms_of(summaries: Sequence[PointSummary]) -> list[str]:
    """Names of the means: the reward's terms, where the task reports them, else all."""
    names = list(dict.fromkeys(name for one in summaries for name in one.means))
    return [name for name in names if name.startswith(_TERMS)] or names


def _in_order(text: str) -> tuple[int, float, str]:
    """Sort key: numbers by size, then texts."""
    number = _number(text)
    return (1, 0.0, text) if number is None else (0, number, "")


def _number(text: str) -> float | None:
    try:
        value = json.loads(text)
        number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    except (ValueError, OverflowError, RecursionError):
        return None
    return number if math.isfinite(number) else None


def _of_set(name: str, x: float, texts: Sequence[str], summaries: Sequence[PointSummary]) -> Axis:
    # One above the other at equal distances: 0.01, 0.1 and 1 are as good a choice as 1, 2 and 3.
    gap = (BOTTOM - TOP) / max(len(texts) - 1, 1)
    heights = {
        text: (BOTTOM - k * gap if len(texts) > 1 else (TOP + BOTTOM) / 2) for k, text in enumerate(texts)
    }
    shown = _spread(texts)
    ticks = tuple((short_text(value_text(text), 10), heights[text], text) for text in shown)
    return Axis(name, x, tuple(heights[one.values[name]] for one in summaries), ticks)


def _spread(texts: Sequence[str]) -> Sequence[str]:
    if len(texts) <= MOST_TICKS:
        return texts
    return [texts[round(k * (len(texts) - 1) / (MOST_TICKS - 1))] for k in range(MOST_TICKS)]


def _of_numbers(name: str, x: float, values: Sequence[float | None], is_rate: bool) -> Axis:
    known = [value for value in values if value is not None]
    low, high = (0.0, 1.0) if is_rate else (min(known, default=0.0), max(known, default=0.0))
    # Halved, or the distance of the largest numbers is infinite.
    span = high / 2 - low / 2

    def height(value: float) -> float:
        return (TOP + BOTTOM) / 2 if not span else BOTTOM - (value / 2 - low / 2) / span * (BOTTOM - TOP)

    label: Callable[[float], str] = (lambda v: f"{100 * v:.0f} %") if is_rate else _short_number
    ends = (low, high) if span else (low,)
    ticks = tuple((label(end), height(end), "") for end in ends) if known else ()
    return Axis(name, x, tuple(None if value is None else height(value) for value in values), ticks)


def _short_number(value: float) -> str:
    return f"{value:.3g}"


def best_first(rows: Sequence[SweepEpisode]) -> list[SweepEpisode]:
    """Episodes that succeeded before the others, the earlier and then the higher return first."""

    def goodness(row: SweepEpisode) -> tuple[bool, float, float]:
        solved = math.inf if row.solved_at is None else row.solved_at
        total = -math.inf if row.total_reward is None else row.total_reward
        return not row.success, solved, -total

    return sorted((row for row in rows if row.steps is not None), key=goodness)


@dataclass
class Shown:
    """Choices of a person; the same on all open pages."""

    column: str = "success"
    descending: bool = True
    chosen: int | None = None
    """Index of the chosen point. None until a person chooses: then the point of the open episode is shown, else
    the best one."""
    only: dict[str, set[str]] = field(default_factory=dict)
    """Values of the shown points, by name of the setting; all values if a name is missing."""


class SweepPanel(PagePart[ReviewView]):
    """The tab's content, in the present container.

    Args:
        on_open: gets the id of a recording in the library.
    """

    every = 0.25
    does = (ShowSweepPoint, SortSweep, FilterSweep, ClearSweepFilter, TurnSweep, OpenSweepEpisode)

    def __init__(
        self,
        server: viser.ViserServer,
        library: Library,
        on_open: Callable[[tuple[str, ...]], None],
    ) -> None:
        self._library, self._on_open = library, on_open
        self._file = library.folder / RESULTS
        self._note = server.gui.add_html("")
        self._plot = server.gui.add_html("")
        self._table = server.gui.add_html("")
        self._episodes = server.gui.add_html("")
        self._lock = threading.RLock()
        self._results: SweepResults | None = None
        self._summaries: list[PointSummary] = []
        self._point_of: dict[str, int] = {}
        """Index of the point of each recording, by path of the recording."""
        self._problem = ""
        self._seen: tuple[int, int] | None = None
        self._serial = 0
        """Counter that grows with every change of what is shown."""
        self.shown = Shown()
        self._chosen: int | None = None
        """The point whose episodes are listed."""
        self._pages = Paged(ROWS)

    # --- the file --------------------------------------------------------------------------------------

    def _look(self) -> None:
        """Read the file when it has changed, on a thread of its own."""
        seen = self._library.view().sweep
        if seen != self._seen:
            self._seen = seen
            watched_thread("sweep results", self._read).start()

    def _read(self) -> None:
        results, problem = None, ""
        try:
            results = read_sweep(self._file)
        except (UnreadableRecording, OSError) as error:
            problem = str(error)
        with self._lock:
            self._results, self._problem = results, problem
            self._summaries = [] if results is None else results.summaries()
            rows = () if results is None else results.episodes
            self._point_of = {
                str(self._library.folder / row.recording): row.point for row in rows if row.recording
            }
            if self.shown.chosen is not None and self.shown.chosen >= len(self._summaries):
                self.shown.chosen = None
            self._serial += 1

    # --- drawing ---------------------------------------------------------------------------------------

    def key(self, view: ReviewView) -> object:
        self._look()
        opened = tuple(one.id for one in view.opened)
        return self._serial, opened, self._library.view().serial

    def draw(self, view: ReviewView) -> None:
        with self._lock:
            results, shown = self._results, self.shown
            self._note.content = self._note_html()
            if results is None:
                self._plot.content = self._table.content = self._episodes.content = ""
                return
            self._chosen = self._first(view) if shown.chosen is None else shown.chosen
            kept = [one for one in self._summaries if self._is_kept(one)]
            self._plot.content = self._plot_html(results)
            self._table.content = self._table_html(results, kept)
            chosen = next((one for one in self._summaries if one.index == self._chosen), None)
            self._episodes.content = "" if chosen is None else self._episodes_html(results, chosen, view)

    def _first(self, view: ReviewView) -> int | None:
        """The point of the episode that is open, else the best one."""
        opened = {one.id for one in view.opened}
        paths = (str(path) for row in self._library.view().rows if row.id in opened for path in row.paths)
        of_opened = (self._point_of[path] for path in paths if path in self._point_of)
        return next(of_opened, next((one.index for one in self._summaries), None))

    def _note_html(self) -> str:
        if self._problem:
            return render("note", text=self._problem)
        results = self._results
        if results is None:
            return render("note", text=f"Reading {RESULTS}.")
        actions = results.actions.rpartition("/")[2]
        failed, lines = sum(one.failed for one in self._summaries), len(self._summaries) <= MOST_PRESSED
        return render("sweep_head", results=results, actions=actions, failed=failed, lines=lines)

    def _is_kept(self, one: PointSummary) -> bool:
        return all(one.values.get(name) in texts for name, texts in self.shown.only.items() if texts)

    def _plot_html(self, results: SweepResults) -> str:
        axes = axes_of(results, self._summaries)
        lines = []
        by_return = [one.mean_return for one in self._summaries if one.mean_return is not None]
        low, high = min(by_return, default=0.0), max(by_return, default=0.0)
        tell_apart = len({one.rate for one in self._summaries if one.rate is not None}) > 1
        for k, one in enumerate(self._summaries):
            points = [(axis.x, axis.heights[k]) for axis in axes]
            known = [f"{x:.1f},{y:.1f}" for x, y in points if y is not None]
            kept = self._is_kept(one)
            rate = one.rate if tell_apart else None
            if rate is None and one.mean_return is not None and high > low:
                rate = (one.mean_return - low) / (high - low)
            lines.append(
                {
                    "points": " ".join(known),
                    "kept": kept,
                    "part": round(100 * (rate or 0.0)),
                    "chosen": one.index == self._chosen,
                    "failed": not one.episodes,
                    "press": ShowSweepPoint(index=one.index)
                    if kept and len(self._summaries) <= MOST_PRESSED
                    else None,
                    "about": _about(one),
                }
            )
        # The chosen one over the others, and those that are left out below.
        lines.sort(key=lambda line: (line["chosen"], line["kept"]))
        return render(
            "sweep_plot",
            axes=[
                {
                    "name": axis.name,
                    "x": axis.x,
                    "ticks": [
                        {
                            "label": label,
                            "y": y,
                            "press": FilterSweep(name=axis.name, value=text) if text else None,
                            "on": text in self.shown.only.get(axis.name, ()) and bool(text),
                        }
                        for label, y, text in axis.ticks
                    ],
                }
                for axis in axes
            ],
            lines=lines,
            faint=len(lines) > MOST_PRESSED,
            width=WIDTH,
            top=TOP,
            bottom=BOTTOM,
            clear=ClearSweepFilter() if any(self.shown.only.values()) else None,
        )

    def _table_html(self, results: SweepResults, kept: Sequence[PointSummary]) -> str:
        terms = terms_of(self._summaries)
        columns: dict[str, tuple[Callable[[PointSummary], Any], str]] = {}
        for name in results.names:
            columns[f"set {name}"] = (lambda one, name=name: _in_order(one.values[name])), name
        columns["success"] = lambda one: _rate_order(one), "success"
        columns["at the end"] = lambda one: _part(one.solved_at_end, one.episodes), "at the end"
        columns["return"] = lambda one: _least(one.mean_return), "return"
        for name in terms:
            columns[f"mean {name}"] = (
                (lambda one, name=name: _least(one.means.get(name))),
                name.removeprefix(_TERMS),
            )
        columns["episodes"] = lambda one: one.episodes, "episodes"
        order, _ = columns.get(self.shown.column, columns["success"])
        ordered = sorted(kept, key=order, reverse=self.shown.descending)
        places = self._pages.places(len(ordered))
        rows = []
        for one in [ordered[k] for k in places]:
            rows.append(
                {
                    "press": ShowSweepPoint(index=one.index),
                    "chosen": one.index == self._chosen,
                    "values": [value_text(one.values[name]) for name in results.names],
                    "cells": [*_result_cells(one), *(_shown(one.means.get(name)) for name in terms)],
                    "episodes": one.episodes,
                    "failed": one.failed,
                }
            )
        head = [
            {
                "name": title,
                "arrow": "" if column != self.shown.column else " ↓" if self.shown.descending else " ↑",
                "press": SortSweep(column=column),
                "set": column.startswith("set "),
            }
            for column, (_, title) in columns.items()
        ]
        return render(
            "sweep_table", head=head, rows=rows, pages=self._pages.shown(lambda by: TurnSweep(by=by))
        )

    def _episodes_html(self, results: SweepResults, chosen: PointSummary, view: ReviewView) -> str:
        rows = [row for row in results.episodes if row.point == chosen.index]
        ordered = best_first(rows)
        if len(ordered) > 2 * MOST_SHOWN:
            lists = [
                ("Best episodes", ordered[:MOST_SHOWN]),
                ("Worst episodes", ordered[: -MOST_SHOWN - 1 : -1]),
            ]
        else:
            lists = [("Episodes, the best first", ordered)] if ordered else []
        ids = {str(path): row.id for row in self._library.view().rows for path in row.paths}
        opened = {one.id for one in view.opened}
        return render(
            "sweep_episodes",
            point=_point_text(chosen),
            failure=chosen.failure,
            failed=chosen.failed,
            lists=[
                {"title": title, "rows": [self._episode(row, ids, opened) for row in some]}
                for title, some in lists
            ],
        )

    def _episode(self, row: SweepEpisode, ids: dict[str, str], opened: set[str]) -> dict[str, Any]:
        # Only what the library itself has found can be opened: a path of the table names a row of it, and no file.
        id = ids.get(str(self._library.folder / row.recording)) if row.recording else None
        return {
            "press": None if id is None else OpenSweepEpisode(id=id),
            "opened": id is not None and id in opened,
            "seed": row.seed,
            "success": {None: "", True: f"solved at {row.solved_at}", False: "not solved"}[row.success],
            "steps": row.steps,
            "total": _shown(row.total_reward),
        }

    # --- presses ---------------------------------------------------------------------------------------

    def do(self, command: Command, visitor: Visitor) -> None:
        with self._lock:
            match command:
                case ShowSweepPoint(index=index):
                    self.shown.chosen = index
                case SortSweep(column=column):
                    self._sort(column)
                case FilterSweep(name=name, value=value):
                    self._filter(name, value)
                case ClearSweepFilter():
                    self.shown.only.clear()
                    self._pages.go_to(0)
                case TurnSweep(by=by):
                    self._pages.turn(by)
                case OpenSweepEpisode(id=id):
                    self._on_open((id,))
            self._serial += 1

    def _sort(self, column: str) -> None:
        same = column == self.shown.column
        self.shown.descending = not self.shown.descending if same else not column.startswith("set ")
        self.shown.column = column
        self._pages.go_to(0)

    def _filter(self, name: str, text: str) -> None:
        self.shown.only.setdefault(name, set()).symmetric_difference_update({text})
        self._pages.go_to(0)
        kept = [one.index for one in self._summaries if self._is_kept(one)]
        if kept and self._chosen not in kept:
            # They are the best first.
            self.shown.chosen = kept[0]


def _part(count: int | None, total: int) -> float:
    return -1.0 if count is None or not total else count / total


def _least(number: float | None) -> float:
    return -math.inf if number is None else number


def _rate_order(one: PointSummary) -> tuple[float, float]:
    return _least(one.rate), _least(one.mean_return)


def _shown(number: float | None) -> str:
    return "" if number is None else _short_number(number)


def _result_cells(one: PointSummary) -> list[str]:
    """Success with its interval, success at the end, and return."""
    success = at_end = ""
    if one.rate is not None and one.interval is not None:
        low, high = one.interval
        success = f"{100 * one.rate:.0f} % ({100 * low:.0f} - {100 * high:.0f})"
        at_end = f"{100 * _part(one.solved_at_end, one.episodes):.0f} %"
    return [success, at_end, _shown(one.mean_return)]


def _point_text(one: PointSummary) -> str:
    return ", ".join(f"{name} = {value_text(text)}" for name, text in one.values.items())


def _about(one: PointSummary) -> str:
    success, _, total = _result_cells(one)
    return "; ".join(
        filter(None, (_point_text(one), success and f"success {success}", total and f"return {total}"))
    )

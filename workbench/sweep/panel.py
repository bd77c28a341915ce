"""The Sweep tab: the points of a sweep as parallel coordinates and as a table, and the episodes of a point."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import viser

from workbench.episodes.reader.reading import read_sweep
from workbench.episodes.row import LibraryRow, UnreadableRecording
from workbench.episodes.sweep_results import RESULTS, PointSummary, SweepEpisode, SweepResults, value_text
from workbench.library.folder import Library
from workbench.machine.loop import BlockingPool, begin, on_loop, post
from workbench.machine.processes.watched_thread import report_failure
from workbench.page.command import Command
from workbench.page.widgets.paged import Paged
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render, short_text
from workbench.page.widgets.visitors import Visitor
from workbench.review.commands import (
    ClearSweepFilter,
    FilterSweep,
    OpenSweepEpisode,
    ShowSweepPoint,
    SortSweep,
    TurnSweep,
)
from workbench.review.view import ReviewView

PAGE_ROWS = 12
"""Number of rows of a page of the table."""
MAX_AXES = 9
MAX_TICKS = 8
"""Maximum number of labels of an axis."""
MAX_CLICKABLE_LINES = 64
"""If the plot has more lines than this, they cannot be clicked."""
MAX_SHOWN_EPISODES = 5
"""Number of best and of worst episodes of a point that are shown."""
WIDTH, TOP, BOTTOM, SIDE = 500, 46, 208, 34
"""In pixels: width of the plot, y of the upper and lower ends of its axes, and margin beside the outer
axes."""
_TERMS = "reward_terms/"
_RATE = "success"


@dataclass(frozen=True)
class Axis:
    """An axis of the plot."""

    name: str
    x: float
    heights: tuple[float | None, ...]
    """For each point of the sweep, y on this axis in pixels; None for a point without a value."""
    ticks: tuple[tuple[str, float, str], ...]
    """(label, y in pixels, value of the setting in JSON) of each tick. On axes of results the value is
    empty."""


def axes_of(results: SweepResults, summaries: Sequence[PointSummary]) -> list[Axis]:
    """One axis for each setting, then the success rate, the return and as many terms as there is room for."""
    places: list[tuple[str, Any]] = []
    for name in results.names:
        texts = sorted({one.values[name] for one in summaries}, key=_in_order)
        places.append((name, texts))
    if any(one.rate is not None for one in summaries):
        places.append((_RATE, [one.rate for one in summaries]))
    places.append(("return", [one.mean_return for one in summaries]))
    for name in terms_of(summaries):
        places.append((name.removeprefix(_TERMS), [one.means.get(name) for one in summaries]))
    places = places[: max(MAX_AXES, len(results.names) + 2)]
    gap = (WIDTH - 2 * SIDE) / max(len(places) - 1, 1)
    made = []
    for k, (name, values) in enumerate(places):
        x = SIDE + k * gap
        if k < len(results.names):
            made.append(_of_set(name, x, values, summaries))
        else:
            # The axis of the success rate is identified by its index, since a term of the reward may have the
            # same name.
            is_rate = k == len(results.names) and name == _RATE
            made.append(_of_numbers(name, x, values, is_rate))
    return made


def terms_of(summaries: Sequence[PointSummary]) -> list[str]:
    """Names of the means: the reward's terms if the task reports them, else all means."""
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
    # Equally spaced, since values like 0.01, 0.1 and 1 are as common as 1, 2 and 3.
    gap = (BOTTOM - TOP) / max(len(texts) - 1, 1)
    heights = {
        text: (BOTTOM - k * gap if len(texts) > 1 else (TOP + BOTTOM) / 2) for k, text in enumerate(texts)
    }
    shown = _spread(texts)
    ticks = tuple((short_text(value_text(text), 10), heights[text], text) for text in shown)
    return Axis(name, x, tuple(heights[one.values[name]] for one in summaries), ticks)


def _spread(texts: Sequence[str]) -> Sequence[str]:
    if len(texts) <= MAX_TICKS:
        return texts
    return [texts[round(k * (len(texts) - 1) / (MAX_TICKS - 1))] for k in range(MAX_TICKS)]


def _of_numbers(name: str, x: float, values: Sequence[float | None], is_rate: bool) -> Axis:
    known = [value for value in values if value is not None]
    low, high = (0.0, 1.0) if is_rate else (min(known, default=0.0), max(known, default=0.0))
    # Halved, because the difference of the largest numbers would overflow.
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
    """Episodes in order: successes first, then by earlier success, then by higher return. Episodes that could
    not be recorded are left out."""

    def goodness(row: SweepEpisode) -> tuple[bool, float, float]:
        solved = math.inf if row.solved_at is None else row.solved_at
        total = -math.inf if row.total_reward is None else row.total_reward
        return not row.success, solved, -total

    return sorted((row for row in rows if row.steps is not None), key=goodness)


@dataclass(frozen=True)
class Shown:
    """The user's choices; shared by all open pages."""

    column: str = "success"
    descending: bool = True
    chosen: int | None = None
    """Index of the chosen point. If None, the point of the open episode is shown; without an open episode,
    the best point."""
    only: frozenset[tuple[str, str]] = frozenset()
    """Pairs (setting, value): the values that are shown. A setting without a pair shows all values."""
    pages: Paged = field(default_factory=lambda: Paged(PAGE_ROWS))

    def keeps(self, one: PointSummary) -> bool:
        """Whether the point is shown; see `only`."""
        return all((name, one.values.get(name)) in self.only for name in {name for name, _ in self.only})


def apply(shown: Shown, command: Command, summaries: Sequence[PointSummary]) -> Shown:
    """The choices after a command."""
    first = shown.pages.at(0)
    match command:
        case ShowSweepPoint(index=index):
            return replace(shown, chosen=index)
        case SortSweep(column=column):
            down = not shown.descending if column == shown.column else not column.startswith("set ")
            return replace(shown, column=column, descending=down, pages=first)
        case FilterSweep(name=name, value=value):
            return replace(shown, only=shown.only ^ {(name, value)}, pages=first)
        case ClearSweepFilter():
            return replace(shown, only=frozenset(), pages=first)
        case TurnSweep(by=by):
            return replace(shown, pages=shown.pages.turned(by, sum(map(shown.keeps, summaries))))
        case _:
            return shown


@dataclass(frozen=True, eq=False)
class LoadedSweep:
    """Content of the results file."""

    results: SweepResults | None = None
    problem: str = ""
    summaries: Sequence[PointSummary] = ()
    """One for each point, best first."""
    point_of: Mapping[str, int] = field(default_factory=dict)
    """Index of the point of each recording, by path of the recording."""


class SweepPanel(PagePart[ReviewView]):
    """The tab's content, in the current container.

    Args:
        on_open: called with the library's ids of the recordings to open.
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
        self._note = server.gui.add_html("")
        self._plot = server.gui.add_html("")
        self._table = server.gui.add_html("")
        self._episodes = server.gui.add_html("")
        self._disk = BlockingPool("sweep-results")
        self._seen: tuple[int, int] | None = None
        """Size and modification time of the file when it was last read."""
        self._read = LoadedSweep()
        self._shown = Shown()
        library.on_change.add(self._library_changed)
        self._library_changed()

    # --- the file --------------------------------------------------------------------------------------

    def _library_changed(self) -> None:
        post(self._look)

    def _look(self) -> None:
        """Read the file if it has changed; on the loop."""
        seen = self._library.view().sweep
        if seen != self._seen:
            self._seen = seen
            begin(self._read_again())

    async def _read_again(self) -> None:
        try:
            self._read = await self._disk.run(self._read_file)
        except (UnreadableRecording, OSError) as error:
            self._read = LoadedSweep(problem=str(error))
        except Exception as error:
            report_failure("The results of a sweep could not be read", error)
            self._read = LoadedSweep(problem="The results could not be read. The reason is in the terminal.")

    def _read_file(self) -> LoadedSweep:
        folder = self._library.folder
        results = read_sweep(folder / RESULTS)
        point_of = {str(folder / row.recording): row.point for row in results.episodes if row.recording}
        return LoadedSweep(results, "", results.summaries(), point_of)

    @on_loop
    def end(self) -> None:
        """Stop following the file when the page closes."""
        self._library.on_change.discard(self._library_changed)
        self._disk.end()

    # --- drawing ---------------------------------------------------------------------------------------

    def key(self, view: ReviewView) -> object:
        opened = tuple(one.id for one in view.opened)
        return self._read, self._shown, opened, self._library.view()

    def draw(self, view: ReviewView) -> None:
        read, shown = self._read, self._shown
        self._note.content = _note_html(read)
        if read.results is None:
            self._plot.content = self._table.content = self._episodes.content = ""
            return
        library = self._library.view().rows
        point = _shown_point(read, shown, view, library)
        self._plot.content = _plot_html(read.results, read.summaries, shown, point)
        self._table.content = _table_html(read.results, read.summaries, shown, point)
        self._episodes.content = (
            "" if point is None else self._episodes_html(read.results, point, view, library)
        )

    def _episodes_html(
        self, results: SweepResults, point: PointSummary, view: ReviewView, library: Sequence[LibraryRow]
    ) -> str:
        rows = [row for row in results.episodes if row.point == point.index]
        ordered = best_first(rows)
        if len(ordered) > 2 * MAX_SHOWN_EPISODES:
            lists = [
                ("Best episodes", ordered[:MAX_SHOWN_EPISODES]),
                ("Worst episodes", ordered[: -MAX_SHOWN_EPISODES - 1 : -1]),
            ]
        else:
            lists = [("Episodes, the best first", ordered)] if ordered else []
        ids = {str(path): row.id for row in library for path in row.paths}
        opened = {one.id for one in view.opened}
        return render(
            "sweep_episodes",
            point=_point_text(point),
            failure=point.failure,
            failed=point.failed,
            lists=[
                {"title": title, "rows": [self._episode(row, ids, opened) for row in some]}
                for title, some in lists
            ],
        )

    def _episode(self, row: SweepEpisode, ids: dict[str, str], opened: set[str]) -> dict[str, Any]:
        # Only recordings that the library has found can be opened: a path in the table is looked up in the library.
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
        self._shown = apply(self._shown, command, self._read.summaries)
        if isinstance(command, OpenSweepEpisode):
            self._on_open((command.id,))


def _note_html(read: LoadedSweep) -> str:
    if read.problem:
        return render("note", text=read.problem)
    results = read.results
    if results is None:
        return render("note", text=f"Reading {RESULTS}.")
    actions = results.actions.rpartition("/")[2]
    failed, lines = sum(one.failed for one in read.summaries), len(read.summaries) <= MAX_CLICKABLE_LINES
    return render("sweep_head", results=results, actions=actions, failed=failed, lines=lines)


def _shown_point(
    read: LoadedSweep, shown: Shown, view: ReviewView, library: Sequence[LibraryRow]
) -> PointSummary | None:
    """The point whose episodes are listed: the chosen point, else the point of the open episode, else the
    best point. If this point is filtered out, the best of the shown points."""
    by_index: dict[int | None, PointSummary] = {one.index: one for one in read.summaries}
    opened = {one.id for one in view.opened}
    paths = (str(path) for row in library if row.id in opened for path in row.paths)
    of_opened = (read.point_of[path] for path in paths if path in read.point_of)
    index = shown.chosen if shown.chosen in by_index else next(of_opened, None)
    point = by_index.get(index, next(iter(read.summaries), None))
    if point is None or shown.keeps(point):
        return point
    return next(filter(shown.keeps, read.summaries), point)


def _plot_html(
    results: SweepResults, summaries: Sequence[PointSummary], shown: Shown, point: PointSummary | None
) -> str:
    axes = axes_of(results, summaries)
    lines = []
    by_return = [one.mean_return for one in summaries if one.mean_return is not None]
    low, high = min(by_return, default=0.0), max(by_return, default=0.0)
    tell_apart = len({one.rate for one in summaries if one.rate is not None}) > 1
    for k, one in enumerate(summaries):
        points = [(axis.x, axis.heights[k]) for axis in axes]
        known = [f"{x:.1f},{y:.1f}" for x, y in points if y is not None]
        kept = shown.keeps(one)
        rate = one.rate if tell_apart else None
        if rate is None and one.mean_return is not None and high > low:
            rate = (one.mean_return - low) / (high - low)
        lines.append(
            {
                "points": " ".join(known),
                "kept": kept,
                "part": round(100 * (rate or 0.0)),
                "chosen": one is point,
                "failed": not one.episodes,
                "press": ShowSweepPoint(index=one.index)
                if kept and len(summaries) <= MAX_CLICKABLE_LINES
                else None,
                "about": _about(one),
            }
        )
    # The chosen line is drawn above the others, filtered-out lines below.
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
                        "on": (axis.name, text) in shown.only and bool(text),
                    }
                    for label, y, text in axis.ticks
                ],
            }
            for axis in axes
        ],
        lines=lines,
        faint=len(lines) > MAX_CLICKABLE_LINES,
        width=WIDTH,
        top=TOP,
        bottom=BOTTOM,
        clear=ClearSweepFilter() if shown.only else None,
    )


def _table_html(
    results: SweepResults, summaries: Sequence[PointSummary], shown: Shown, point: PointSummary | None
) -> str:
    terms = terms_of(summaries)
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
    order, _ = columns.get(shown.column, columns["success"])
    ordered = sorted(filter(shown.keeps, summaries), key=order, reverse=shown.descending)
    places = shown.pages.places(len(ordered))
    rows = []
    for one in [ordered[k] for k in places]:
        rows.append(
            {
                "press": ShowSweepPoint(index=one.index),
                "chosen": one is point,
                "values": [value_text(one.values[name]) for name in results.names],
                "cells": [*_result_cells(one), *(_shown(one.means.get(name)) for name in terms)],
                "episodes": one.episodes,
                "failed": one.failed,
            }
        )
    head = [
        {
            "name": title,
            "arrow": "" if column != shown.column else " ↓" if shown.descending else " ↑",
            "press": SortSweep(column=column),
            "set": column.startswith("set "),
        }
        for column, (_, title) in columns.items()
    ]
    return render(
        "sweep_table",
        head=head,
        rows=rows,
        pages=shown.pages.shown(len(ordered), lambda by: TurnSweep(by=by)),
    )


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

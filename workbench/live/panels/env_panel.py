"""The table of envs: one row per env, sorted and filtered; a press selects the env and goes to its event."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.live.env_commands import (
    FilterEnvs,
    NextFailedEnv,
    NextFlaggedEnv,
    ShowEnvAtEvent,
    ShowFirstFlagged,
    SortEnvs,
    ToggleEnvEntries,
    ToggleEnvEntry,
    TurnEnvs,
)
from workbench.live.events import EnvEventShown, EpisodeStepShown, SettingsChanged
from workbench.live.history.env_table import EnvEvent, EnvRows, Outcome
from workbench.live.panels.env_columns import DOT_PIXELS, EnvColumn, levels, wanted_width
from workbench.live.panels.moment import MomentPart
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.machine.text import number_text
from workbench.page.command import Command, Refused
from workbench.page.commands import TellUnfolded
from workbench.page.widgets.fields import choice
from workbench.page.widgets.line_chart import drawn_span, polylines
from workbench.page.widgets.paged import Paged
from workbench.page.widgets.templates import counted, render
from workbench.page.widgets.visitors import Visitor

Filter = Literal["all", "unsolved", "failed", "limit", "running", "flagged"]
FILTERS: dict[Filter, tuple[str, str]] = {
    "all": ("all envs", "There is no env."),
    "unsolved": ("last episode without success", "Every env's last episode ended in success."),
    "failed": ("last episode failed", "No env's last episode failed."),
    "limit": ("last episode at the time limit", "No env's last episode reached the time limit."),
    "running": ("running", "No env is running."),
    "flagged": ("flagged", "No env is flagged."),
}
"""Label of the choice, and text of an empty table."""
FILTER_HINT = (
    "last episode: the last finished one. "
    "without success: it ended by fail or at the time limit. "
    "flagged: something odd in the current or the previous episode."
)
WORDS = {
    Outcome.RUNNING: "running",
    Outcome.SUCCESS: "success",
    Outcome.FAIL: "failed",
    Outcome.TRUNCATED: "time limit",
}
_ENDS: dict[Filter, tuple[Outcome, ...]] = {
    "unsolved": (Outcome.FAIL, Outcome.TRUNCATED),
    "failed": (Outcome.FAIL,),
    "limit": (Outcome.TRUNCATED,),
}
"""Outcomes of the last episode that pass a filter."""
TABLE = "envs"
"""The panel's name in `TellUnfolded`."""
MAX_DEFAULT_ENTRIES = 6
"""Maximum number of bool entries with a column by default; with more, a row is wider than the view."""
CURVE_POINTS = 40
"""Number of points of a row's small curve."""
STEP_CHARACTERS = 3
"""Minimum width of a step number in characters, so that the columns do not widen in the first steps."""
REWARD_CURVE = "reward curve"
"""Name of the only column by which the table cannot be sorted."""
CURVE_WIDTH, CURVE_HEIGHT = 60, 14
_GRAVITY = np.array([2, 3, 0, 1])
"""Sort key of each `Outcome`. The order is: fail, truncated, running, success."""


def bool_entries(rows: EnvRows) -> tuple[str, ...]:
    """The bool entries of `evaluate`, ``success`` and ``fail`` first."""
    return tuple(sorted(rows.first_true, key=lambda name: (name != "success", name != "fail", name)))


def entry_names(rows: EnvRows, chosen: Mapping[str, bool] | None = None) -> tuple[str, ...]:
    """Bool entries that get a column: those that the user switched on, and those of the first
    `MAX_DEFAULT_ENTRIES` that the user did not switch off.

    Args:
        chosen: True or False for each entry that the user has switched.
    """
    chosen = chosen or {}
    every = bool_entries(rows)
    return tuple(name for place, name in enumerate(every) if chosen.get(name, place < MAX_DEFAULT_ENTRIES))


def columns(rows: EnvRows, chosen: Mapping[str, bool] | None = None) -> tuple[str, ...]:
    """Names of the sortable columns, in the order of the table."""
    return (
        "env",
        "state",
        "steps",
        "return",
        "last",
        "flags",
        *(f"first {name}" for name in entry_names(rows, chosen)),
    )


def gives_way(entries: tuple[str, ...], chosen: Mapping[str, bool], sorted_by: str) -> dict[str, int]:
    """Order in which columns are left out if the panel is narrow, 0 first; columns without a rank always stay.

    Args:
        entries: The bool entries of `evaluate` that have a column.
        chosen: Entries that the user switched on stay longer than the others.
        sorted_by: This column always stays.
    """
    added = [name for name in reversed(entries) if chosen.get(name)]
    others = [name for name in reversed(entries) if name not in added]
    more = [f"first {name}" for name in others if name not in ("success", "fail")]
    fail, success = ([f"first {name}"] if name in others else [] for name in ("fail", "success"))
    # Flags go first: flagged envs also have a mark in the bar.
    in_turn = ["flags", *more, "last", *fail, *success, *(f"first {name}" for name in added)]
    ranked = [column for column in (*in_turn, REWARD_CURVE, "steps", "return") if column != sorted_by]
    return {column: rank for rank, column in enumerate(ranked)}


def mask(rows: EnvRows, wanted: Filter) -> NDArray[np.bool_]:
    """(N,) whether each env passes a filter.

    ``unsolved``: the present episode ended without success or, while it runs, the previous one did. ``failed``
    and ``limit``: it ended by fail, or at the time limit.
    ``flagged``: there are outliers in the present or the previous episode.
    """
    everyone = np.ones(rows.num_envs, bool)
    if (ends := _ENDS.get(wanted)) is not None:
        running = rows.outcome == Outcome.RUNNING
        return np.isin(np.where(running, rows.last.outcome, rows.outcome), ends)
    if wanted == "running":
        return rows.outcome == Outcome.RUNNING
    if wanted == "flagged":
        return np.isin(np.arange(rows.num_envs), [*rows.outliers, *rows.last.outliers])
    return everyone


def first_flagged(rows: EnvRows) -> int | None:
    """The first env with an outlier in the present episode; if there is none, in the previous one; else None."""
    return min(rows.outliers, default=None) if rows.outliers else min(rows.last.outliers, default=None)


def order(rows: EnvRows, column: str, descending: bool, wanted: Filter = "all") -> NDArray[np.int64]:
    """The envs that pass a filter, sorted by a column.

    Envs without a value come last in both directions. Envs with equal values keep the order of their numbers:
    otherwise rows would jump although nothing changes.
    """
    envs = np.flatnonzero(mask(rows, wanted))
    keys = _keys(rows, column)[envs]
    keys = np.where(np.isnan(keys), np.inf, -keys if descending else keys)
    return envs[np.argsort(keys, kind="stable")]


def moment_of(rows: EnvRows, env: int) -> int | None:
    """The step of the present episode that a press on an env's row shows: the first outlier, else the
    episode's end; None without either."""
    if env in rows.outliers:
        return rows.outliers[env][0].step
    return int(rows.end[env]) if rows.end[env] >= 0 else None


def make_rows(
    rows: EnvRows, envs: NDArray[np.int64], chosen: Mapping[str, bool] | None = None
) -> list[dict[str, Any]]:
    """The cells of these envs. A curve is a list of ``points`` of SVG polylines. Among the flags, those of
    the present episode come before those of the previous one."""
    names = entry_names(rows, chosen)
    curves = _curves(rows.rewards, envs)
    made = []
    for env, curve in zip(envs.tolist(), curves, strict=True):
        state, last = (Outcome(int(one)).name.lower() for one in (rows.outcome[env], rows.last.outcome[env]))
        had_one = rows.last.steps[env] >= 0
        made.append(
            {
                "env": env,
                "state": state,
                "state_word": WORDS[Outcome(int(rows.outcome[env]))],
                "total": number_text(float(rows.total[env]), ".3g") if rows.followed[env] else "",
                "steps": str(int(rows.steps[env])),
                "first_true": tuple(_step(int(rows.first_true[name][env])) for name in names),
                "curve": curve,
                "last": ("cut short" if last == "running" else WORDS[Outcome(int(rows.last.outcome[env]))])
                if had_one
                else "",
                "last_steps": str(int(rows.last.steps[env])),
                "last_state": last,
                "tally": f"{counted(int(rows.ended[env]), 'episode')} ended: {ended_text(rows, [env])}",
                "flags": _flags(rows, env),
            }
        )
    return made


def _flags(rows: EnvRows, env: int) -> tuple[str, ...]:
    """What is odd, each kind once."""
    before = {outlier.kind: outlier for outlier in rows.last.outliers.get(env, ())}
    flags = []
    for outlier in rows.outliers.get(env, ()):
        earlier = before.pop(outlier.kind, None)
        also = "" if earlier is None else f"; previous episode, step {earlier.step}"
        flags.append(f"{outlier.text} (step {outlier.step}{also})")
    flags += [f"{outlier.text} (previous episode, step {outlier.step})" for outlier in before.values()]
    return tuple(flags)


def ended_text(rows: EnvRows, envs: Sequence[int] | slice = slice(None)) -> str:
    """How the ended episodes of these envs ended: ``3 success, 1 failed, 2 time limit``."""
    return ", ".join(f"{count} {word}" for _, word, count in ended_counts(rows, envs))


def ended_counts(rows: EnvRows, envs: Sequence[int] | slice = slice(None)) -> list[tuple[str, str, int]]:
    """(name, label on the page, number of ended episodes of these envs) for each outcome of an episode."""
    success, fail, all_of_them = (int(n[envs].sum()) for n in (rows.succeeded, rows.failed, rows.ended))
    counts = {
        Outcome.SUCCESS: success,
        Outcome.FAIL: fail,
        Outcome.TRUNCATED: all_of_them - success - fail,
    }
    return [(outcome.name.lower(), WORDS[outcome], count) for outcome, count in counts.items()]


def _keys(rows: EnvRows, column: str) -> NDArray[np.float64]:
    """(N,) sort keys; NaN for no value."""
    if column == "state":
        return _GRAVITY[rows.outcome].astype(np.float64)
    if column == "steps":
        return rows.steps.astype(np.float64)
    if column == "return":
        return rows.total.astype(np.float64)
    if column == "last":
        return np.where(rows.last.steps < 0, np.nan, _GRAVITY[rows.last.outcome])
    if column == "flags":
        keys = np.full(rows.num_envs, np.nan)
        keys[list(rows.last.outliers)] = 1.0
        keys[list(rows.outliers)] = 0.0
        return keys
    if column.startswith("first "):
        steps = rows.first_true.get(column.removeprefix("first "))
        if steps is not None:
            return np.where(steps < 0, np.nan, steps)
    return np.arange(rows.num_envs, dtype=np.float64)


def _curves(rewards: NDArray[np.float32], envs: NDArray[np.int64]) -> list[list[str]]:
    """SVG points of each env's rewards, all on one scale."""
    chosen = rewards[envs].astype(np.float64)
    finite = np.isfinite(chosen)
    if not finite.any():
        return [[] for _ in envs]
    # The longest shown episode sets the width.
    chosen = chosen[:, int(finite.any(axis=0).argmax()) :]
    every = np.arange(0, chosen.shape[1], -(-chosen.shape[1] // CURVE_POINTS))
    # A single non-finite step makes a gap too.
    finite = np.logical_and.reduceat(np.isfinite(chosen), every, axis=1)
    chosen = chosen[:, every]
    if not finite.any():
        return [[] for _ in envs]
    low, high = drawn_span(float(chosen[finite].min()), float(chosen[finite].max()))
    x = np.round(np.linspace(0, CURVE_WIDTH, chosen.shape[1]), 1)
    y = np.round(
        CURVE_HEIGHT - 1 - (CURVE_HEIGHT - 2) * (np.where(finite, chosen, low) - low) / (high - low), 1
    )
    return [
        polylines([f"{a:g},{b:g}" if there else None for a, b, there in zip(x, heights, ok, strict=True)])
        for heights, ok in zip(y, finite, strict=True)
    ]


def _step(step: int) -> str:
    return "" if step < 0 else str(step)


ROWS_PER_PAGE = 64
HINTS = {
    "env": "Click a column to sort by it, again to reverse the order",
    "state": "State of the current episode: running until its first end",
    "steps": "Control steps of the episode",
    "return": "Sum of the rewards of the episode so far",
    "last": "How the previous episode ended, and at which step",
    "flags": "What is odd: NaN or infinite, too fast, fallen, reward out of range",
}


class EnvPanel(MomentPart):
    """The table of envs. Sorting and filter are the same for all open pages.

    While it is folded in every page, it is redrawn only for a new task: drawing 64 rows takes half of the
    panels' time while a task plays.
    """

    does = (
        ShowEnvAtEvent,
        ShowFirstFlagged,
        NextFailedEnv,
        NextFlaggedEnv,
        SortEnvs,
        FilterEnvs,
        ToggleEnvEntries,
        ToggleEnvEntry,
        TurnEnvs,
    )

    def __init__(self, server: viser.ViserServer, session: LiveSession) -> None:
        self._session = session
        names = {label: name for name, (label, _) in FILTERS.items()}
        self._which = choice(server, "Show", FilterEnvs, "which", names, "all", hint=FILTER_HINT)
        self._handle = server.gui.add_html("")
        server.gui.add_html(render("tell", command=TellUnfolded(panel=TABLE)))
        self._sort = "env", False
        """Chosen sort column, and whether the order is descending."""
        self._filter: Filter = "all"
        self._pages = Paged(ROWS_PER_PAGE)
        self._chosen: dict[str, bool] = {}
        """Bool entries that the user switched on or off."""
        self._choosing = False
        """Whether the list of entries is open."""
        self._pressed = 0
        """Number of presses that changed the table."""
        self._is_unfolded = False
        self._drawn_task = -1
        """Value of `SessionView.task_serial` at the last drawing."""

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ShowEnvAtEvent(env=env):
                self._choose_env(env)
            case ShowFirstFlagged():
                self._select_first_flagged()
            case NextFailedEnv():
                self._select_next("failed", "limit")
            case NextFlaggedEnv():
                self._select_next("flagged")
            case SortEnvs(column=column):
                before, descending = self._sort
                self._sort = column, column == before and not descending
                self._pages = self._pages.at(0)
            case FilterEnvs(which=which):
                self._filter = which
                self._pages = self._pages.at(0)
            case ToggleEnvEntries():
                self._choosing = not self._choosing
            case ToggleEnvEntry(name=name):
                self._toggle_entry(name)
            case TurnEnvs(by=by):
                rows = self._session.env_rows()
                count = 0 if rows is None else int(np.count_nonzero(mask(rows, self._filter)))
                self._pages = self._pages.turned(by, count)
        self._pressed += 1

    def unfold(self) -> None:
        """Draw the table from now on, because a page shows it. Lasts until `fold`, since pages do not report that the user
        folded the panel."""
        self._is_unfolded = True

    def fold(self) -> None:
        """Stop drawing the table, because no page shows it."""
        self._is_unfolded = False

    def key(self, view: SessionView) -> object:
        return view.task_serial, view.step_serial if self._is_unfolded else None

    def urgent(self, view: SessionView) -> object:
        return super().urgent(view), self._is_unfolded, self._pressed if self._is_unfolded else None

    def draw(self, view: SessionView) -> None:
        if not self._is_unfolded and self._drawn_task == view.task_serial:
            return
        self._drawn_task = view.task_serial
        rows = self._session.env_rows()
        self._which.show(self._filter, off=rows is None)
        content = render("envs", head=()) if rows is None else self._html(rows, view.selected_env)
        self._handle.content = content

    def wanted_width(self) -> float:
        """Width in pixels of a panel in which every column is visible."""
        rows = self._session.env_rows()
        if rows is None:
            return 0.0
        return wanted_width(
            self._measure(rows, make_rows(rows, np.arange(min(rows.num_envs, ROWS_PER_PAGE)), self._chosen))
        )

    def _html(self, rows: EnvRows, selected: int) -> str:
        envs = order(rows, *self._sorted_by(rows), self._filter)
        places = self._pages.places(len(envs))
        shown = make_rows(rows, envs[places.start : places.stop], self._chosen)
        return render(
            "envs",
            none_so=FILTERS[self._filter][1],
            tally=[
                (one.name.lower(), WORDS[one], int(np.count_nonzero(rows.outcome == one))) for one in Outcome
            ],
            choose=ToggleEnvEntries() if rows.first_true else None,
            entries=self._entries(rows) if self._choosing else (),
            choosing=self._choosing,
            pages=self._pages.shown(len(envs), lambda by: TurnEnvs(by=by)),
            head=self._head(rows),
            levels=levels(self._measure(rows, shown)),
            rows=[
                {
                    "cells": row,
                    "selected": row["env"] == selected,
                    "press": ShowEnvAtEvent(env=row["env"]),
                }
                for row in shown
            ],
        )

    def _head(self, rows: EnvRows) -> list[dict[str, object]]:
        names = entry_names(rows, self._chosen)
        sorted_by, descending = self._sorted_by(rows)

        def sortable(name: str, column: str, hint: str) -> dict[str, object]:
            arrow = "" if column != sorted_by else f"\N{NO-BREAK SPACE}{'↓' if descending else '↑'}"
            return {
                "name": name,
                "arrow": arrow,
                "press": SortEnvs(column=column),
                "hint": hint,
            }

        entries = [
            sortable(name, f"first {name}", f"{name}: the first step at which it was true") for name in names
        ]
        plain: dict[str, object] = {
            "name": "reward",
            "arrow": "",
            "press": None,
            "hint": "Over the episode; all rows on one scale",
        }
        start = [sortable(name, name, HINTS[name]) for name in ("env", "state", "steps", "return")]
        end = [sortable(name, name, HINTS[name]) for name in ("last", "flags")]
        return [*start, plain, *entries, *end]

    def _sorted_by(self, rows: EnvRows) -> tuple[str, bool]:
        """The chosen sort column, and whether it descends; the env's number while the table lacks that
        column."""
        return self._sort if self._sort[0] in columns(rows, self._chosen) else ("env", False)

    def _measure(self, rows: EnvRows, shown: list[dict[str, Any]]) -> list[EnvColumn]:
        """The columns in the order of `_head`."""
        names = entry_names(rows, self._chosen)
        ranks = gives_way(names, self._chosen, self._sorted_by(rows)[0])

        def longest(texts: Iterable[str]) -> int:
            return max(STEP_CHARACTERS, *map(len, texts), 0)

        states = longest(row["state_word"] for row in shown)
        last = longest(row["last"] for row in shown)
        firsts = [
            EnvColumn(
                name,
                longest(row["first_true"][place] for row in shown),
                rank=ranks.get(f"first {name}"),
            )
            for place, name in enumerate(names)
        ]
        return [
            EnvColumn("env", longest(str(row["env"]) for row in shown)),
            EnvColumn("state", states, states, DOT_PIXELS),
            EnvColumn("steps", longest(row["steps"] for row in shown), rank=ranks.get("steps")),
            EnvColumn("return", longest(row["total"] for row in shown), rank=ranks.get("return")),
            EnvColumn("reward", 0, fixed=CURVE_WIDTH, rank=ranks.get(REWARD_CURVE)),
            *firsts,
            EnvColumn("last", last + STEP_CHARACTERS, last, DOT_PIXELS if last else 0.0, ranks.get("last")),
            EnvColumn("flags", 3, rank=ranks.get("flags")),
        ]

    def _entries(self, rows: EnvRows) -> list[dict[str, object]]:
        shown = entry_names(rows, self._chosen)
        return [
            {
                "name": name,
                "on": name in shown,
                "press": ToggleEnvEntry(name=name),
            }
            for name in bool_entries(rows)
        ]

    # --- commands ----------------------------------------------------------------------------------

    def _choose_env(self, env: int) -> None:
        rows = self._session.env_rows()
        if rows is None or not 0 <= env < rows.num_envs:
            raise Refused(f"There is no env {env}.")
        step = moment_of(rows, env)
        self._session.dispatch(
            SettingsChanged({"selected_env": env}) if step is None else EpisodeStepShown(env, step)
        )

    def _toggle_entry(self, name: str) -> None:
        rows = self._session.env_rows()
        if rows is not None:
            self._chosen = {**self._chosen, name: name not in entry_names(rows, self._chosen)}

    def _select_first_flagged(self) -> None:
        """Select the first flagged env of the shown moment, and go to the outlier."""
        rows = self._session.view().env_table
        env = None if rows is None else first_flagged(rows)
        if env is not None:
            self._session.dispatch(EnvEventShown(env, "flagged"))

    def _select_next(self, wanted: EnvEvent, or_else: EnvEvent | None = None) -> None:
        """Select the next env (by number, wrapping around) with the wanted event in its present or previous
        episode, and go to this event. Uses the newest moment, so that pressing again visits all such envs.

        Args:
            or_else: event to look for if no env has the wanted one.
        """
        rows = self._session.look(lambda run: run.newest_env_table())
        envs = np.zeros(0, int) if rows is None else np.flatnonzero(mask(rows, wanted))
        if not len(envs) and or_else is not None:
            return self._select_next(or_else)
        if not len(envs):
            raise Refused(
                "No env has an outlier."
                if wanted == "flagged"
                else "No env's last episode failed or reached the time limit."
            )
        later = envs[envs > self._session.view().selected_env]
        self._session.dispatch(EnvEventShown(int(later[0] if len(later) else envs[0]), wanted))

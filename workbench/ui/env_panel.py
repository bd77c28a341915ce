"""The batch, one row an env: sort it, filter it, press a row to select that env and go to its moment.

What the rows say is in `env_strip`; how a row of HTML can be pressed, in `presses`. The table is drawn a few times
a second, and at most `MOST_ROWS` rows of it: which those are is what sorting and filtering are for. Sorting and
filter belong to the page's server, like the selected env, so two open pages show the same.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable

import numpy as np
import viser

from workbench.session.env_table import EnvRows
from workbench.session.session import Session
from workbench.session.view import SessionView
from workbench.ui.env_strip import (
    FILTERS,
    MEANS,
    NONE_SO,
    SHOWN_AS,
    Filter,
    columns,
    entry_names,
    first_flagged,
    make_rows,
    mask,
    moment_of,
    order,
)
from workbench.ui.fragments import render
from workbench.ui.parts import Part
from workbench.ui.presses import Paged, Presses

MOST_ROWS = 64
"""On one page of the table."""
HINTS = {
    "env": "Press a column to sort by it, again to turn it round",
    "state": "Of the episode under way: running until its first end",
    "steps": "Control steps of the episode",
    "return": "Sum of the rewards of the episode so far",
    "last": "How the episode before ended, and at which step",
    "flags": "What is odd: NaN or infinite, too fast, fallen, reward out of range",
}


class EnvPanel(Part[SessionView]):
    """The table of envs in the present container."""

    every = 0.3
    """Faster, numbers of many rows cannot be read."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._session = session
        self._handle = server.gui.add_html("")
        self._presses = Presses(server)
        self._column, self._descending = "env", False
        self._filter: Filter = "all"
        self._pages = Paged(self._presses, MOST_ROWS)
        self._pressed = 0
        """How often something was that changes the table."""

    def key(self, view: SessionView) -> object:
        return view.task_serial, view.step_serial

    def urgent(self, view: SessionView) -> object:
        return view.selected_env, self._pressed, self._pages.first

    def draw(self, view: SessionView) -> None:
        rows = self._session.env_rows()
        content = render("envs", head=()) if rows is None else self._html(rows, view.selected_env)
        self._handle.content = content

    def _html(self, rows: EnvRows, selected: int) -> str:
        if self._column not in columns(rows):
            self._column, self._descending = "env", False
        envs = order(rows, self._column, self._descending, self._filter)
        places = self._pages.places(len(envs))
        shown = envs[places.start : places.stop]
        return render(
            "envs",
            none_so=NONE_SO[self._filter],
            pills=[
                {
                    "name": SHOWN_AS[name],
                    "hint": MEANS[name],
                    "count": int(np.count_nonzero(mask(rows, name))),
                    "on": name == self._filter,
                    "press": self._press(("filter", name), lambda name=name: self._choose_filter(name)),
                }
                for name in FILTERS
            ],
            pages=self._pages.shown,
            head=self._head(rows),
            rows=[
                {"cells": row, "selected": row["env"] == selected, "press": self._press_of_env(row["env"])}
                for row in make_rows(rows, shown)
            ],
        )

    def _head(self, rows: EnvRows) -> list[dict[str, str]]:
        def sortable(name: str, column: str, hint: str) -> dict[str, str]:
            arrow = "" if column != self._column else " ↓" if self._descending else " ↑"
            press = self._press(("sort", column), lambda: self._choose_column(column))
            return {"name": name, "arrow": arrow, "press": press, "hint": hint}

        entries = [
            sortable(name, f"first {name}", f"The first step at which {name} was true")
            for name in entry_names(rows)
        ]
        plain = {
            "name": "reward",
            "arrow": "",
            "press": "",
            "hint": "Over the episode; all rows on one scale",
        }
        start = [sortable(name, name, HINTS[name]) for name in ("env", "state", "steps", "return")]
        return [*start, plain, *entries, *(sortable(name, name, HINTS[name]) for name in ("last", "flags"))]

    # --- what is pressed ---------------------------------------------------------------------------

    def _press(self, key: Hashable, do: Callable[[], None]) -> str:
        def pressed(client: viser.ClientHandle | None) -> None:
            do()
            self._pressed += 1

        return self._presses.id_of(key, pressed)

    def _press_of_env(self, env: int) -> str:
        return self._press(("env", env), lambda: self._choose_env(env))

    def _choose_env(self, env: int) -> None:
        rows = self._session.env_rows()
        if rows is None or env >= rows.num_envs:
            return  # a version with fewer envs was loaded since the table was drawn
        self._session.select_env(env)
        step = moment_of(rows, env)
        if step is not None:
            self._session.past.seek_step(env, step)

    def _choose_column(self, column: str) -> None:
        self._descending = not self._descending if column == self._column else False
        self._column = column
        self._pages.go_to(0)

    def _choose_filter(self, wanted: Filter) -> None:
        self._filter = wanted
        self._pages.go_to(0)

    def select_first_flagged(self) -> None:
        """The first env with something odd, at the step at which that began."""
        rows = self._session.env_rows()
        env = None if rows is None else first_flagged(rows)
        if env is not None:
            self._choose_env(env)
            self._pressed += 1

    def select_next(self, wanted: Filter) -> None:
        """The next env, by number and round the end, that a filter lets through; none if there is none."""
        rows = self._session.env_rows()
        if rows is None:
            return
        envs = np.flatnonzero(mask(rows, wanted))
        if len(envs):
            later = envs[envs > self._session.view().selected_env]
            self._choose_env(int(later[0] if len(later) else envs[0]))
            self._pressed += 1

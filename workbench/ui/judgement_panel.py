"""The past judged again: a line above the curves, and under them the new curve over the old and what differs.

Nothing is here before there is something to say. A row of the list selects its env and goes to the moment where it
differs. On a small screen all that lies below the edge, so the line above says what came of it and scrolls there.
"""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.session.judge import JudgementView
from workbench.session.judgement import EpisodeDifference, JudgedCurve
from workbench.session.lengths import length
from workbench.session.session import Session
from workbench.session.view import SessionView
from workbench.ui import judged_in_words as words
from workbench.ui.fragments import render
from workbench.ui.line_chart import LONGEST, ThenAndNow
from workbench.ui.parts import Part
from workbench.ui.presses import Paged, Presses

MOST_ROWS = 8
"""Of the list, at a time."""


class JudgementPanel(Part[SessionView]):
    every = 0.25

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server, self._session = server, session
        self._status = server.gui.add_html("", visible=False)
        self._stop = server.gui.add_button("Stop judging", icon=viser.Icon.PLAYER_STOP, visible=False)
        self._stop.on_click(lambda _: session.stop_judging())
        names: tuple[str, ...] = ("reward",)
        self._name: viser.GuiDropdownHandle = server.gui.add_dropdown(
            "Curve",
            names,
            visible=False,
            hint="Which number is drawn, as recorded and as the new code has it",
        )
        self._chart = ThenAndNow(server)
        self._list = server.gui.add_html("", visible=False)
        self._presses = Presses(server)
        self._pages = Paged(self._presses, MOST_ROWS)
        self._listed: tuple[EpisodeDifference, ...] = ()

    def key(self, view: SessionView) -> object:
        past = view.timeline
        chosen = self._name.value, self._pages.first
        return view.judgement.serial, view.selected_env, past.shown, past.first, *chosen

    def draw(self, view: SessionView) -> None:
        judged = view.judgement
        self._status.visible = judged.state != "none"
        self._stop.visible = judged.state in ("loading", "judging")
        if judged.state == "none":
            self._pages.go_to(0)
        else:
            self._status.content = status_html(judged)
        self._draw_list(judged, view)
        self._draw_chart(judged, view)

    # --- the chart -----------------------------------------------------------------------------------

    def _draw_chart(self, judged: JudgementView, view: SessionView) -> None:
        summary = judged.summary
        names = () if summary is None else summary.names
        differs = summary is not None and bool(summary.differing or summary.differing_names)
        if names and self._name.options != names:
            self._name.options = names
        # What a page sends as its choice may be anything.
        name = self._name.value if self._name.value in names else "reward"
        curve = self._session.judged_curve(name, view.selected_env) if differs else None
        self._name.visible = curve is not None
        if curve is None or len(curve.tick) < 2:
            self._chart.hide()
            return
        self._chart.draw(
            f"{name} of env {view.selected_env}, before and now", chart_data(curve, view.timeline.shown)
        )

    # --- the list ------------------------------------------------------------------------------------

    def _draw_list(self, judged: JudgementView, view: SessionView) -> None:
        self._listed = () if judged.summary is None else judged.summary.differences
        self._list.visible = bool(self._listed)
        if not self._listed:
            return
        shown = self._pages.places(len(self._listed))
        rows = [self._row(place, view) for place in shown]
        self._list.content = render("differences", rows=rows, more=self._pages.shown)

    def _row(self, place: int, view: SessionView) -> dict[str, object]:
        episode = self._listed[place]
        far = episode.drift > words.FAR_METRES
        kept = episode.at >= view.timeline.first
        return {
            "env": episode.env,
            "lines": words.difference(episode),
            "returns": words.change(*episode.returns),
            "drift": f"drifted {length(episode.drift)}" if far else "",
            "hint": "Show this moment" if kept else "This moment is no longer in the history",
            "selected": view.timeline.shown == episode.at and view.selected_env == episode.env,
            "press": self._presses.id_of(
                ("row", place % MOST_ROWS), lambda _, k=place % MOST_ROWS: self._go(k)
            ),
        }

    def _go(self, row: int) -> None:
        place = self._pages.first + row
        if place < len(self._listed):
            self._show_episode(self._listed[place])

    def _show_episode(self, episode: EpisodeDifference) -> None:
        if episode.at >= self._session.view().timeline.first:
            self._session.show(episode.env, episode.at)
        else:
            self._session.change(selected_env=episode.env)

    def go_to_difference(self, by: int) -> None:
        """Show the next (1) or last (-1) moment of the list, from the one that is shown; round the end."""
        listed = self._listed
        if not listed:
            return
        view = self._session.view()
        here = next(
            (k for k, e in enumerate(listed) if (e.at, e.env) == (view.timeline.shown, view.selected_env)),
            -1 if by > 0 else 0,
        )
        place = (here + by) % len(listed)
        self._pages.go_to(place)
        self._show_episode(listed[place])


def chart_data(curve: JudgedCurve, shown: int | None) -> tuple[NDArray[np.float64], ...]:
    """As uPlot wants it: x, the record, what is said now, and a point at the moment that is shown, if one is.

    Of a long record the newest part, or the part round the moment that is shown.
    """
    count = len(curve.tick)
    end = count
    if shown is not None:
        end = int(np.searchsorted(curve.serial, shown)) + LONGEST // 2
    end = min(max(end, LONGEST), count)
    part = slice(max(0, end - LONGEST), end)
    x, old, new = (np.asarray(v[part], np.float64) for v in (curve.tick, curve.old, curve.new))
    if shown is None or shown not in curve.serial[part]:
        return x, old, new
    return x, old, new, np.where(curve.serial[part] == shown, np.where(np.isnan(new), old, new), np.nan)


def status_html(judged: JudgementView) -> str:
    return render("judgement", judged=judged, words=words)


class JudgedAbove(Part[SessionView]):
    def __init__(self, server: viser.ViserServer) -> None:
        self._line = server.gui.add_html("", visible=False)

    def draw(self, view: SessionView) -> None:
        says = words.in_a_line(view.judgement)
        self._line.visible = bool(says)
        if says:
            self._line.content = render("judged_above", says=says)

"""Shared parts of the two rescoring panels: progress, the list of changed results, and a chart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Generic, TypeVar

import viser
from numpy.typing import NDArray

from workbench.live.timeline_commands import ShowRescored, StopRescoring, TurnRescored
from workbench.page.command import Command
from workbench.page.widgets.line_chart import ChartLine, LineChart, span_of
from workbench.page.widgets.paged import Paged
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.rescore import verdict_text
from workbench.rescore.state import RUNNING, RescoreView
from workbench.rescore.verdict import Verdict

MAX_ROWS = 10
"""Maximum number of rows of the list that are shown at a time."""
RECORD_COLOUR = "#adb5bd"
View = TypeVar("View")
Of = TypeVar("Of")


class RescoredPanel(PagePart[View], Generic[View, Of]):
    """Parts of a rescoring panel, which a subclass adds to the current container in its own order. A click on a row of the list
    shows its run.

    Args:
        server: The page.
        column: Heading of the column of runs.
    """

    every = 0.25
    does: tuple[type[Command], ...] = (ShowRescored, TurnRescored)
    advice = ""
    """Sentence that is shown if bodies drifted from the record."""

    def __init__(self, server: viser.ViserServer, column: str) -> None:
        self._server, self._column = server, column
        self._listed: Sequence[Verdict[Of]] = ()
        self._failed_since = ""
        """Reason of a failed rescoring. The status shows it, so the rows do not repeat it."""

    def _add_status(self, label: str) -> None:
        self._stop = self._server.gui.add_html(tools_html([tool(label, StopRescoring())]), visible=False)
        self._status = self._server.gui.add_html("")

    def _add_list(self) -> None:
        self._list = self._server.gui.add_html("", visible=False)
        self._pages = Paged(MAX_ROWS)

    def _add_chart(self) -> None:
        self._chart = LineChart(self._server, height=160)

    def _draw_status(self, rescored: RescoreView, title: str = "", idle: str = "") -> None:
        self._failed_since = rescored.why if rescored.state == "failed" else ""
        self._stop.visible = rescored.state in RUNNING
        self._status.visible = rescored.state != "none" or bool(idle)
        self._status.content = status_html(rescored, title, idle, self.advice)

    def _draw_list(self, listed: Sequence[Verdict[Of]]) -> None:
        self._listed = listed
        self._list.visible = bool(listed)
        if listed:
            rows = [self._row(place) for place in self._pages.places(len(listed))]
            pages = self._pages.shown(len(listed), lambda by: TurnRescored(by=by))
            self._list.content = render("rescored_list", rows=rows, more=pages, column=self._column)

    def _draw_chart(
        self, title: str, x: NDArray, old: NDArray, new: NDArray, at: float | None = None
    ) -> None:
        lines = ChartLine("as recorded", old, RECORD_COLOUR, 1.2), ChartLine("rescored", new)
        self._chart.draw(title, x, lines, at, span_of([line.values for line in lines]))

    def _row(self, place: int) -> dict[str, Any]:
        verdict = self._listed[place]
        in_status = self._failed_since and verdict.why_not.startswith(self._failed_since)
        return {
            "badge": None,
            "changed": "not rescored" if in_status else verdict_text.change_text(verdict),
            "returns": "" if verdict.why_not else verdict_text.returns_text(verdict),
            "drift": f"drifted {verdict_text.drift_text(verdict)}" if verdict.drifted else "",
            "same": not verdict.differs,
            "press": ShowRescored(run=self._key_of(verdict)),
            **self._of_row(verdict),
        }

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ShowRescored(run=run):
                for verdict in self._listed:
                    if self._key_of(verdict) == run:
                        self._show(verdict)
                        break
            case TurnRescored(by=by):
                self._pages = self._pages.turned(by, len(self._listed))

    def _key_of(self, verdict: Verdict[Of]) -> str:
        """Key that distinguishes the verdict's run from the other runs."""
        raise NotImplementedError

    def _of_row(self, verdict: Verdict[Of]) -> dict[str, Any]:
        """Values of a row for the template: the run's name, a hint, and whether the row is selected."""
        raise NotImplementedError

    def _show(self, verdict: Verdict[Of]) -> None:
        """Show the verdict's run."""
        raise NotImplementedError


def status_html(rescored: RescoreView, title: str = "", idle: str = "", advice: str = "") -> str:
    """HTML of the state and the results of rescoring.

    Args:
        title: Title above the status.
        idle: Text before anything is rescored.
        advice: As in `RescoredPanel.advice`.
    """
    return render(
        "rescored", rescored=rescored, title=title, idle=idle, advice=advice, verdict_text=verdict_text
    )

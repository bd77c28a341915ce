"""Rescoring of the past in the Reward tab: a summary above the curves, and below them the new curve and the
differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.live.events import MomentShown
from workbench.live.session_protocol import LiveSession
from workbench.live.timeline_commands import ChooseRescoredCurve, NextDifference, PreviousDifference
from workbench.live.view import SessionView
from workbench.page.command import Command, Refused
from workbench.page.widgets.fields import by_name, choice
from workbench.page.widgets.line_chart import part_round
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import counted, render
from workbench.page.widgets.visitors import Visitor
from workbench.rescore import verdict_text
from workbench.rescore.past_scores import PastRun, RescoredCurve
from workbench.rescore.result_parts import RescoredPanel
from workbench.rescore.state import RescoreView
from workbench.rescore.verdict import Verdict, by_change

TITLE = "History, rescored"


class PastRescorePanel(RescoredPanel[SessionView, PastRun]):
    does = (*RescoredPanel.does, ChooseRescoredCurve, NextDifference, PreviousDifference)

    def __init__(
        self,
        server: viser.ViserServer,
        session: LiveSession,
        rescored_curve: Callable[[str, int], RescoredCurve | None],
    ) -> None:
        super().__init__(server, "env")
        self._session, self._rescored_curve = session, rescored_curve
        self._add_status("Stop rescoring")
        self._name = "reward"
        self._curve = choice(
            server,
            "Curve",
            ChooseRescoredCurve,
            "curve",
            (self._name,),
            self._name,
            hint="The number that is plotted, as recorded and with the new code",
        )
        self._curve.visible = False
        self._add_chart()
        self._add_list()
        self._verdicts: Sequence[Verdict[PastRun]] = ()
        self._shown: tuple[int, int | None] = 0, None
        """(env, moment) that the page shows."""
        self._first = 0

    def key(self, view: SessionView) -> object:
        past = view.timeline
        chosen = self._name, self._pages.first
        return view.of(RescoreView).serial, view.selected_env, past.shown, past.first, *chosen

    def draw(self, view: SessionView) -> None:
        rescored = view.of(RescoreView)
        self._shown, self._first = (view.selected_env, view.timeline.shown), view.timeline.first
        if rescored.state == "none":
            self._pages = self._pages.at(0)
        self._draw_status(rescored, TITLE)
        if rescored.verdicts is not self._verdicts:
            self._verdicts = rescored.verdicts
            self._listed = by_change([verdict for verdict in rescored.verdicts if verdict.differs])
        self._draw_list(self._listed)
        self._draw_curve(rescored, view)

    def _draw_curve(self, rescored: RescoreView, view: SessionView) -> None:
        names, env = rescored.names or (self._name,), view.selected_env
        name = self._name if self._name in names else names[0]
        self._curve.show(name, options=by_name(names))
        differs = bool(self._listed or rescored.differing_names)
        curve = self._rescored_curve(name, env) if differs else None
        self._curve.visible = curve is not None
        if curve is None:
            self._chart.hide()
        else:
            self._draw_chart(f"{name} of env {env}, before and now", *chart_data(curve, view.timeline.shown))

    # --- the list ------------------------------------------------------------------------------------

    def _key_of(self, verdict: Verdict[PastRun]) -> str:
        return "{} {}".format(*_place(verdict))

    def _of_row(self, verdict: Verdict[PastRun]) -> dict[str, Any]:
        env, at = place = _place(verdict)
        in_history = at >= self._first
        return {
            "name": f"{env}, from {verdict.of.tick}",
            "hint": f"Env {env}, the episode that began after {counted(verdict.of.tick, 'step')}. "
            + ("Click to show the moment" if in_history else "The moment is no longer in the history"),
            "selected": self._shown == place,
        }

    def _show(self, verdict: Verdict[PastRun]) -> None:
        env, at = _place(verdict)
        if at >= self._session.view().timeline.first:
            self._session.dispatch(MomentShown(at, env))
        else:
            self._session.change(selected_env=env)

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ChooseRescoredCurve(curve=curve):
                if curve not in self._session.view().of(RescoreView).names:
                    raise Refused("There is no such curve.")
                self._name = curve
            case NextDifference():
                self._go_to_difference(1)
            case PreviousDifference():
                self._go_to_difference(-1)
            case _:
                super().do(command, visitor)

    def _go_to_difference(self, by: int) -> None:
        """Show the next (1) or previous (-1) moment of the list, wrapping around."""
        listed = self._listed
        if not listed:
            return
        view = self._session.view()
        shown = view.selected_env, view.timeline.shown
        here = next((k for k, one in enumerate(listed) if _place(one) == shown), -1 if by > 0 else 0)
        place = (here + by) % len(listed)
        self._pages = self._pages.at(place)
        self._show(listed[place])


def _place(verdict: Verdict[PastRun]) -> tuple[int, int]:
    """Env and serial of the moment to show."""
    assert verdict.look_at is not None
    return verdict.of.env, verdict.of.at(verdict.look_at)


def chart_data(curve: RescoredCurve, shown: int | None) -> tuple[NDArray, NDArray, NDArray, float | None]:
    """x (control steps), the recorded curve, the new curve, and x of the shown moment (None if that moment is
    not on the chart).

    A long curve is cut to the part around the shown moment, or to its newest part.
    """
    place = None if shown is None else int(np.searchsorted(curve.serial, shown))
    part = part_round(len(curve.tick), place)
    x, old, new = (v[part] for v in (curve.tick, curve.old, curve.new))
    if shown is None or shown not in curve.serial[part]:
        return x, old, new, None
    return x, old, new, float(curve.tick[np.searchsorted(curve.serial, shown)])


def in_a_line(rescored: RescoreView) -> str:
    """Summary in one line; empty while there is nothing to report."""
    if rescored.state == "loading":
        return "Rescoring the history: loading the new code"
    if rescored.state == "rescoring":
        # Rounded to 10 %, because each change is sent to the page.
        return f"Rescoring the history: {10 * int(10 * rescored.done / max(1, rescored.total))} %"
    if rescored.state == "done":
        return f"{TITLE}: {verdict_text.headline(rescored.verdicts, others=rescored.differing_names)}"
    return f"{TITLE}: {rescored.why}" if rescored.why else ""


class RescoredAbove(PagePart[SessionView]):
    def __init__(self, server: viser.ViserServer) -> None:
        self._line = server.gui.add_html("", visible=False)

    def draw(self, view: SessionView) -> None:
        says = in_a_line(view.of(RescoreView))
        self._line.visible = bool(says)
        if says:
            self._line.content = render("rescored_above", says=says)

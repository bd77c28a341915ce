"""The folder *Solve many seeds* of the Checks tab: what planning comes to from each seed, and what that tells of the reward."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import viser

from workbench.checks.rules import RULES
from workbench.core.rules import Finding
from workbench.planning.report import SolveReport
from workbench.planning.verdicts import ENOUGH_SEEDS
from workbench.session.checks.checks import ChecksView
from workbench.session.checks.solve_seeds import RUNNING, SeedsView
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.ui.checks.findings import Card, Row
from workbench.ui.checks.panel import list_html
from workbench.ui.widgets.click_targets import Presses
from workbench.ui.widgets.editor import LinkTo, no_links
from workbench.ui.widgets.parts import PagePart
from workbench.ui.widgets.templates import render

TITLE = "Solve many seeds"
SOLVE, STOP_SOLVING = "Solve", "Stop solving"
MOST_SEEDS = 256


class SolveSeedsPanel(PagePart[SessionView]):
    """A button that solves in the background, a row a seed, and the rules that the reward breaks.

    Args:
        server: The page.
        session: The session.
        on_look: Called with the recording that a person wants to look at.
        link: Links the lines of the author's files.
    """

    every = 0.25

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        on_look: Callable[[Path], None],
        link: LinkTo = no_links,
    ) -> None:
        self._session, self._on_look, self._link = session, on_look, link
        self._open: set[str] = set()
        """Ids of rules that are folded out."""
        self._presses = Presses(server)
        # Who comes back from a recording finds the rows that led there.
        before = session.seeds_solver.view
        with server.gui.add_folder(TITLE, expand_by_default=before.state != "none"):
            self._seeds = server.gui.add_number(
                "Seeds",
                before.total or ENOUGH_SEEDS,
                min=1,
                max=MOST_SEEDS,
                step=1,
                hint=f"From 0 on. That no rule is broken says something from {ENOUGH_SEEDS} seeds on.",
            )
            self._start = server.gui.add_button(
                SOLVE,
                icon=viser.Icon.TARGET,
                color="gray",
                hint="Solves the file as it is saved, as workbench solve does, with the sliders of the Run tab.",
            )
            self._stop = server.gui.add_button(
                STOP_SOLVING, icon=viser.Icon.PLAYER_STOP, color="gray", visible=False
            )
            self._html = server.gui.add_html("")
            self._list = server.gui.add_html("", visible=False)
        self._start.on_click(lambda _: session.solve_seeds(int(self._seeds.value)))
        self._stop.on_click(lambda _: session.seeds_solver.stop())

    def key(self, view: SessionView) -> object:
        return view.seeds.serial, view.task_serial, tuple(sorted(self._open))

    def draw(self, view: SessionView) -> None:
        seeds = view.seeds
        running = seeds.state in RUNNING
        self._start.visible = not running and view.task is not None
        self._stop.visible = running
        self._seeds.disabled = running
        self._html.content = seeds_html(seeds, self._look, self._link)
        found = [] if seeds.report is None else verdict_cards(seeds.report, seeds.stale)
        self._list.visible = bool(found)
        if found:
            self._list.content = list_html(ChecksView(), found, 0, self._open, self._press, self._link)

    def _press(self, rule: str) -> str:
        """The id of the button that folds a rule's page out and in."""
        return self._presses.id_of(("fold", rule), lambda _: self._open.symmetric_difference_update({rule}))

    def _look(self, seed: int) -> str:
        """The id of the button that opens a seed's recording in the review."""
        return self._presses.id_of(("look", seed), lambda _: self._look_at(seed))

    def _look_at(self, seed: int) -> None:
        report = self._session.seeds_solver.view.report
        for one in () if report is None else report.seeds:
            if one.seed == seed:
                self._on_look(one.path)


def verdict_cards(report: SolveReport, old: bool = False) -> list[Card]:
    """The verdicts as findings of their rules, each with its seeds."""
    cards = []
    for verdict in report.verdicts:
        rule = RULES[verdict.rule]
        named = ", ".join(map(str, verdict.seeds[:12])) + (" ..." if len(verdict.seeds) > 12 else "")
        message = f"{verdict.message} (seeds {named})"
        finding = Finding(rule.id, rule.degree, message, None, None, "", "", len(verdict.seeds), 0)
        cards.append(Card(rule, rule.degree, (Row(finding, old=old),)))
    return cards


def seeds_html(seeds: SeedsView, id_of: Callable[[int], str], link: LinkTo = no_links) -> str:
    """How far it is, and a row for each seed.

    Args:
        id_of: the id of the button that opens a seed's recording.
    """
    running = seeds.state in RUNNING
    return render("solve_seeds", seeds=seeds, running=running, id_of=id_of, link=link)

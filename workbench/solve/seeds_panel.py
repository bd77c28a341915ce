"""The folder *Solve many seeds* of the Try tab: the result of planning from each seed, and verdicts on the reward."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import viser

from workbench.checks.commands import ChooseSeeds, ShowSolved, SolveSeeds, StopSolving, ToggleVerdict
from workbench.checks.finding_cards import Card, Row
from workbench.checks.panel import list_html
from workbench.checks.rule_table import RULES
from workbench.checks.state import ChecksView
from workbench.envs.gpu_rules import Finding
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.page.command import Command
from workbench.page.widgets.editor_links import LinkTo, no_links
from workbench.page.widgets.fields import Field
from workbench.page.widgets.parts import PagePart, name_fold
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.planning.seeds_report import SolveReport
from workbench.planning.verdicts import MIN_SEEDS
from workbench.solve.seeds import RUNNING, SeedsView

TITLE = "Solve many seeds"
SOLVE, STOP_SOLVING = "Solve the seeds", "Stop solving"
HINT = f"Seeds are counted from 0. With fewer than {MIN_SEEDS}, problems of the reward may not show."


class SolveSeedsPanel(PagePart[SessionView]):
    """A button that solves in the background, one row per seed, and the rules that the reward breaks.

    Args:
        server: The page.
        session: The session.
        on_look: Called with the recording that the user opens.
        link: Links the lines of the author's files.
    """

    every = 0.25
    does = (ToggleVerdict, ShowSolved)

    def __init__(
        self,
        server: viser.ViserServer,
        session: LiveSession,
        on_look: Callable[[Path], None],
        link: LinkTo = no_links,
    ) -> None:
        self._session, self._on_look, self._link = session, on_look, link
        self._open: set[str] = set()
        """Ids of unfolded rules."""
        # Unfolded if there are results already: the user comes back from a recording.
        before = session.view().of(SeedsView)
        self._folder = server.gui.add_folder(TITLE, expand_by_default=before.state != "none")
        with self._folder:
            self._seeds = Field(server, "Seeds", ChooseSeeds, "seeds", str(before.chosen), hint=HINT)
            self._tools = server.gui.add_html("")
            self._html = server.gui.add_html("")
            self._list = server.gui.add_html("", visible=False)

    def key(self, view: SessionView) -> object:
        return view.of(SeedsView).serial, view.task_serial, tuple(sorted(self._open))

    def draw(self, view: SessionView) -> None:
        seeds = view.of(SeedsView)
        running = seeds.state in RUNNING
        pressed = tool(STOP_SOLVING, StopSolving()) if running else tool(SOLVE, SolveSeeds())
        self._tools.content = tools_html([pressed] if running or view.task is not None else [])
        self._seeds.show(str(seeds.chosen), off=running)
        report = seeds.report
        solved = "" if report is None else f"{len(report.solved)} of {len(report.seeds)} solved"
        name_fold(self._folder, TITLE, solved)
        self._html.content = seeds_html(seeds, self._link)
        found = [] if seeds.report is None else verdict_cards(seeds.report, seeds.stale)
        self._list.visible = bool(found)
        if found:
            self._list.content = list_html(ChecksView(), found, 0, self._open, _toggle, self._link)

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ToggleVerdict(rule=rule):
                self._open.symmetric_difference_update({rule})
            case ShowSolved(seed=seed):
                self._look_at(seed)

    def _look_at(self, seed: int) -> None:
        report = self._session.view().of(SeedsView).report
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


def _toggle(rule: str) -> ToggleVerdict:
    return ToggleVerdict(rule=rule)


def seeds_html(seeds: SeedsView, link: LinkTo = no_links) -> str:
    """HTML of the progress and of a row for each seed; the row opens the seed's recording in the review."""
    running = seeds.state in RUNNING
    show = lambda seed: ShowSolved(seed=seed)  # noqa: E731
    return render("solve_seeds", seeds=seeds, running=running, show=show, link=link)

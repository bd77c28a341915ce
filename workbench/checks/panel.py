"""The Checks tab, and the content of the findings mark (`app.marks`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import viser

from workbench.checks.commands import CheckAfterSave, CheckNow, StopChecks, ToggleRule
from workbench.checks.finding_cards import MAX_SHOWN, Card, cards, count, summary, undecided, without_finding
from workbench.checks.rule_table import RULES
from workbench.checks.silencing import Comment, comments_without_effect
from workbench.checks.state import RUNNING, ChecksView
from workbench.live.view import SessionView
from workbench.page.command import Command
from workbench.page.door.viser_private import set_tab_label
from workbench.page.widgets.editor_links import LinkTo, no_links
from workbench.page.widgets.fields import tick
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import place, render
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Visitor

TAB = "Checks"
CHECK_NOW, STOP_CHECKS = "Check now", "Stop checking"
AFTER_SAVE = "After each save"
AFTER_SAVE_HINT = "Check each version that loads, in a separate process at low priority: playing goes first. The choice is kept for later runs."
REST = "rest"
"""Key of the foldable part that lists the rules without a finding."""


class ChecksPanel(PagePart[SessionView]):
    """Findings of the checks and of playing, worst first, each with its line.

    Args:
        server: The page.
        tab: The tab that contains the panel; its label shows the number of findings.
        link: Links the lines of the author's files.
    """

    every = 0.25
    does = (ToggleRule,)

    def __init__(self, server: viser.ViserServer, tab: viser.GuiTabHandle, link: LinkTo = no_links) -> None:
        self._tab, self._link = tab, link
        self._open: set[str] = set()
        """Ids of unfolded rules, and `REST`."""
        self._status = server.gui.add_html("")
        self._tools = server.gui.add_html("")
        self._after_save = tick(server, AFTER_SAVE, CheckAfterSave, "on", True, hint=AFTER_SAVE_HINT)
        self._list = server.gui.add_html("", visible=False)

    def key(self, view: SessionView) -> object:
        checks = view.of(ChecksView)
        seen = view.rules_serial, view.odd
        return checks.serial, checks.waits, seen, tuple(sorted(self._open)), view.task_serial

    def draw(self, view: SessionView) -> None:
        checks = view.of(ChecksView)
        found = cards(checks, view.played)
        set_tab_label(self._tab, f"{TAB} {count(found)}" if found else TAB)
        self._status.content = status_html(checks, found, self._link)
        running = checks.state in RUNNING
        pressed = tool(STOP_CHECKS, StopChecks()) if running else tool(CHECK_NOW, CheckNow(), tone="main")
        self._tools.content = tools_html([pressed] if running or view.task is not None else [])
        self._after_save.show(checks.after_each_save)
        more = 0 if view.rules is None else view.rules.more
        comments = _comments(view)
        self._list.visible = bool(found or checks.results or comments)
        self._list.content = list_html(checks, found, more, self._open, _toggle, self._link, comments)

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ToggleRule(rule=rule):
                self._open.symmetric_difference_update({rule})


def _toggle(rule: str) -> ToggleRule:
    return ToggleRule(rule=rule)


@dataclass(frozen=True)
class FindingsMark:
    """Content of the findings mark, which is visible on every tab."""

    count: int
    newest: str
    """Place of the worst finding that has a line, with the number of other findings."""
    stops: bool
    old: bool
    """Whether all findings are from an earlier version, and their rules have not been checked again."""


def findings_mark(view: SessionView) -> FindingsMark | None:
    """The findings mark; None if there are no findings."""
    found = cards(view.of(ChecksView), view.played)
    if not found:
        return None
    rows = [row.finding for card in found for row in card.rows]
    newest = next((place(finding) for finding in rows if finding.file), "")
    if newest and len(rows) > 1:
        newest += f" and {len(rows) - 1} more"
    stops = any(finding.degree == "stop" for finding in rows)
    return FindingsMark(len(rows), newest, stops, all(card.old for card in found))


def status_html(checks: ChecksView, found: list[Card], link: LinkTo = no_links) -> str:
    """HTML of the progress and the result of the checks."""
    return render("checks_status", checks=checks, summary=summary(checks, found), link=link)


def _comments(view: SessionView) -> list[Comment]:
    """Silencing comments without effect. Comments that silence no finding are among them only once all rules
    are checked."""
    task, checks = view.task, view.of(ChecksView)
    if task is None:
        return []
    results = checks.results if checks.state == "done" else ()
    return comments_without_effect(task.source, results, task.class_name, task.others)


def list_html(
    checks: ChecksView,
    found: list[Card],
    more: int,
    opened: set[str],
    toggle: Callable[[str], Command],
    link: LinkTo = no_links,
    comments: Sequence[Comment] = (),
) -> str:
    """HTML of the findings, and of the rules without a finding if their part is unfolded.

    Args:
        more: number of findings from playing that are not listed.
        opened: ids of the unfolded rules, and `REST`.
        toggle: gives the command that unfolds or folds a part.
        comments: silencing comments without effect.
    """
    known = {
        "found": found,
        "more": more,
        "opened": opened,
        "toggle": toggle,
        "link": link,
        "most": MAX_SHOWN,
    }
    rest = without_finding(checks, found)
    failed = [result for result in rest if result.state == "failed"]
    kept = [result.rule for result in rest if result.state == "kept"]
    noted = [result for result in rest if result.silenced or result.notes]
    return render(
        "finding_cards",
        **known,
        rest=len(rest) - len(failed),
        failed=failed,
        undecided=undecided(rest),
        noted=noted,
        kept=kept,
        comments=comments,
        REST=REST,
        RULES=RULES,
    )

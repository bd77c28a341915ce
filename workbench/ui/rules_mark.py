"""The standing mark below the status line: what the task breaks of the rules of GPU simulation, a press from the list.

A rule that only warns stops nothing, so whatever tells of it must not pass: the mark stays until the file is mended.
"""

from __future__ import annotations

from pathlib import Path

import viser

from workbench.core.rules import RULES, Finding
from workbench.session.messages import RulesBroken
from workbench.session.view import SessionView
from workbench.ui.fragments import render
from workbench.ui.parts import Part
from workbench.ui.presses import Presses


class RulesMark(Part[SessionView]):
    """The mark, in the present container; nothing while no rule is broken."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._html = server.gui.add_html("", visible=False)
        # Not in a folder with it: viser draws one without a label as if its parts stood in the container itself, and
        # all that comes after the mark of the hidden buttons, the tabs too, would be hidden.
        self._press = Presses(server).id_of("open", lambda _: self.toggle())
        self._open = False
        self._rules: RulesBroken | None = None

    def draw(self, view: SessionView) -> None:
        self._rules = view.rules
        if view.rules is None:
            self._open = False
            self._html.visible = False
            return
        # What is the same is not sent: a list that somebody reads keeps its place.
        self._html.content = rules_html(view.rules, self._open, self._press)
        self._html.visible = True

    def toggle(self) -> None:
        """Open or close the list."""
        rules = self._rules
        if rules is not None:
            self._open = not self._open
            self._html.content = rules_html(rules, self._open, self._press)


def rules_html(rules: RulesBroken, open: bool, press_id: str) -> str:
    """The mark, and the list where it is open; every value escaped."""
    rows = [_row(finding) for finding in rules.rows]
    places = [row["where"] for row in rows if row["where"]]
    return render(
        "rules",
        open=open,
        press_id=press_id,
        count=len(rows),
        newest="" if not places else places[0] + (f" and {len(rows) - 1} more" if len(rows) > 1 else ""),
        rows=rows,
        more=rules.more,
    )


def _row(finding: Finding) -> dict[str, str]:
    where = ""
    if finding.file is not None:
        where = Path(finding.file).name + (f":{finding.line}" if finding.line else "")
    return {
        "rule": finding.rule,
        "asks": f"{RULES[finding.rule].asks} Else, on the GPU: {RULES[finding.rule].otherwise}",
        "where": where,
        "path": finding.file or "",
        "function": f"in {finding.function}" if finding.function else "",
        "code": finding.code,
        "message": finding.message,
        "times": times(finding.count),
        "since": f"first at step {finding.first_step}" if finding.first_step else "from the start",
    }


def times(count: int) -> str:
    """``once``, ``7 times``, ``300 times and more``: of large numbers the first digit, or the list would change at each step."""
    if count < 10:
        return "once" if count == 1 else f"{count} times"
    scale = 10 ** (len(str(count)) - 1)
    return f"{count // scale * scale:,} times and more".replace(",", " ")

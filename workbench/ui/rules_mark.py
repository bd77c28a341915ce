"""The standing mark below the status line: what the task breaks of the rules of GPU simulation, a press from the list.

A rule that only warns stops nothing, so whatever tells of it must not pass: the mark stays until the file is mended.
"""

from __future__ import annotations

import viser

from workbench.core.rules import RULES
from workbench.session.messages import RulesBroken
from workbench.session.view import SessionView
from workbench.ui.fragments import place, render
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
    newest = next((place(row) for row in rules.rows if row.file), "")
    if newest and len(rules.rows) > 1:
        newest += f" and {len(rules.rows) - 1} more"
    known = {"RULES": RULES, "times": times}
    return render("rules", open=open, press_id=press_id, newest=newest, rules=rules, **known)


def times(count: int) -> str:
    """``once``, ``7 times``, ``300 times and more``: of large numbers the first digit, or the list would change at each step."""
    if count < 10:
        return "once" if count == 1 else f"{count} times"
    scale = 10 ** (len(str(count)) - 1)
    return f"{count // scale * scale:,} times and more".replace(",", " ")

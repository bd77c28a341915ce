"""One line above the curves: that the past was judged again, and what came of it.

What it is about, the new curve over the old one and the list, lies under the live curves, and on a small screen below
the edge: who saved another reward and looks at the numbers would not learn of it. A press on the line scrolls there.
"""

from __future__ import annotations

import viser

from workbench.session.view import SessionView
from workbench.ui import judged_in_words as words
from workbench.ui.fragments import render
from workbench.ui.parts import Part


class JudgedAbove(Part[SessionView]):
    def __init__(self, server: viser.ViserServer) -> None:
        self._line = server.gui.add_html("", visible=False)

    def draw(self, view: SessionView) -> None:
        says = words.in_a_line(view.judgement)
        self._line.visible = bool(says)
        if says:
            self._line.content = render("judged_above", says=says)

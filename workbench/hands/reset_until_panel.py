"""The button *Reset until* of the Run tab, and the progress of its search."""

from __future__ import annotations

import viser

from workbench.hands.commands import ResetUntil, StopResetUntil
from workbench.hands.reset_until import ResetSearch
from workbench.live.view import SessionView
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import tool, tools_html


class ResetUntilPanel(PagePart[SessionView]):
    """Shown while a condition is chosen under *Pause when*.

    Args:
        order: viser's order in its folder.
    """

    def __init__(self, server: viser.ViserServer, order: float) -> None:
        self._html = server.gui.add_html("", order=order, visible=False)

    def draw(self, view: SessionView) -> None:
        search = view.of(ResetSearch)
        running = search.state == "running"
        self._html.visible = bool(view.pause_when.entry) or running
        button = tool("Stop", StopResetUntil()) if running else tool("Reset until", ResetUntil())
        # The result belongs to the condition for which it was found.
        text = search_text(search) if running or search.condition == view.pause_when else ""
        self._html.content = tools_html([button]) + (render("note", text=text) if text else "")


def search_text(search: ResetSearch) -> str:
    """What the search found, or how far it is; empty without a search."""
    tried, condition = f"{search.tried:,} first states tried", search.condition.text
    match search.state:
        case "running":
            return f"Resetting until {condition}: {tried}, at most {search.total:,}."
        case "found":
            return f"Seed {search.seed}, env {search.env} begins so; {tried}."
        case "not found":
            return f"No episode begins so: {tried}, up to seed {search.seed}. Press again for the next seeds."
        case "stopped":
            return f"Stopped; {tried}."
        case "failed":
            problem = "" if search.problem is None else f": {search.problem.message}"
            return f"The search failed: {search.why}{problem}"
    return ""

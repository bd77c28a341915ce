"""Tracks the open tab of the main panel in each page, and opens another."""

from __future__ import annotations

from workbench.page.commands import ShownOn
from workbench.page.widgets.templates import render
from workbench.page.widgets.visitors import Visitor, Visitors


class OpenTabs:
    """The open tab of each page. Only the browser knows it, and reports it on request (``panels.js``)."""

    def __init__(self, visitors: Visitors) -> None:
        self._visitors = visitors
        self._open: dict[str, str] = {}
        """Name of the open tab, by page."""

    def pages_at(self, name: str) -> frozenset[int]:
        """Client ids of the pages that have this tab open."""
        here = self._visitors.all()
        return frozenset(one.client.client_id for one in here if self._open.get(one.name) == name)

    def may_show(self, name: str) -> bool:
        """Whether some page has this tab open, or has not yet reported its open tab. Also True while there
        are no pages."""
        here = self._visitors.all()
        return not here or any(self._open.get(one.name, name) == name for one in here)

    def shows(self, where: ShownOn, name: str) -> bool:
        """Whether to draw the things of this tab in the view, given the user's choice `where`."""
        return where == "on all tabs" or (where == "on this tab" and bool(self.pages_at(name)))

    def open(self, visitor: Visitor, name: str, fold: str = "") -> None:
        """Open a tab, and a fold in it, on a page."""
        visitor.send(render("open_tab", tab=name, fold=fold))

    def said(self, visitor: Visitor, name: str) -> None:
        """Store the open tab that a page reports."""
        self._open[visitor.name] = name

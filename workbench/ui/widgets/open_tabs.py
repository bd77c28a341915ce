"""Which tab of the main panel each page has open; opens another."""

from __future__ import annotations

import viser

from workbench.ui.widgets.click_targets import Presses
from workbench.ui.widgets.templates import render


class OpenTabs:
    """Make it in the main panel, outside of its tabs. Which tab is open only the browser knows, which says so (``tab_stays.js``).

    Args:
        server: The page.
        which: Names what the page shows: a browser that comes back to it opens the tab that was open there.
    """

    def __init__(self, server: viser.ViserServer, which: str) -> None:
        self._server = server
        self._names: tuple[str, ...] = ()
        self._open: dict[int, int] = {}
        """Place of the tab, by page."""
        self._opening: dict[int, viser.GuiHtmlHandle] = {}
        """By page: the element that opened a tab last."""
        said = Presses(server).number_of_page_id("open tab", self._said)
        server.gui.add_html(render("which", which=which, anew=False, says=said))

    def are(self, *names: str) -> None:
        """The tabs, in their order."""
        self._names = names

    def pages_at(self, name: str) -> frozenset[int]:
        """The pages that have this tab open, by client id."""
        there = self._server.get_clients().keys()
        place = self._names.index(name)
        return frozenset(page for page, at in dict(self._open).items() if at == place and page in there)

    def open(self, name: str, client: viser.ClientHandle | None) -> None:
        """Open a tab on a page."""
        if client is None:
            return
        before = self._opening.pop(client.client_id, None)
        if before is not None:
            before.remove()
        self._opening[client.client_id] = client.gui.add_html(render("open_tab", tab=name))

    def open_everywhere(self, name: str) -> None:
        """Open a tab on every page: a key does not tell on which one it was pressed."""
        for client in self._server.get_clients().values():
            self.open(name, client)

    def _said(self, client: viser.ClientHandle, place: int) -> None:
        self._open[client.client_id] = place

"""Modal dialogs."""

from __future__ import annotations

import viser

from workbench.page.widgets.templates import render


class Dialog:
    """A modal window with a question, open on all pages until it is answered or closed."""

    def __init__(self, server: viser.ViserServer, title: str) -> None:
        self.modal = server.gui.add_modal(title)
        with self.modal:
            server.gui.add_html(render("context", context="dialog"))

    def close(self) -> bool:
        """Close the window. Returns False if it was already closed: only the first answer counts."""
        if self.modal.closed:
            return False
        self.modal.close()
        return True

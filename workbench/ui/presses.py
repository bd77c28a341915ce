"""Parts of our own HTML that can be pressed, as buttons can.

viser's HTML is one-way, and what it has for pressing (a button, a group of them) cannot be a row of a table with
a curve in it. But each viser button is an element with an id, and pressing it sends what it always sends. So a
pressable part of a table carries the id of a button that is in the page and not seen (``.wb-presses`` in
page.css), and two handlers on the table, fixed text of a template (``pressable.html``), press it. Nothing from the
page becomes more than "this button was pressed", which the server knows how to take.

The mouse counts when it goes down: a table that is drawn anew a few times a second would lose the click of a
person whose finger is still on the button. A touch counts as a click, or scrolling would press.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable

import viser

from workbench.ui.fragments import render
from workbench.ui.viser_seam import element_id

_LAST = 1e6
"""viser's order of elements: the hidden ones come after all others of their container."""


class Presses:
    """The hidden buttons of one container. Make it inside of the container."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        # Everything after this mark in its container is hidden by the style sheet.
        server.gui.add_html(render("presses"), order=_LAST)
        self._folder = server.gui.add_folder(None, order=_LAST + 1)
        self._ids: dict[Hashable, str] = {}

    def id_of(self, key: Hashable, pressed: Callable[[viser.ClientHandle | None], None]) -> str:
        """The id to put into ``data-press``; the same key is the same button for good.

        Args:
            pressed: called with the page that did it, on a thread of viser's.
        """
        if key not in self._ids:
            with self._folder:
                button = self._server.gui.add_button("·")
            button.on_click(lambda event: pressed(event.client))
            self._ids[key] = element_id(button)
        return self._ids[key]

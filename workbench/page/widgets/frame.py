"""The page's frame: a bar over all, docks at the sides, the view, and the transport under it (``page.css``)."""

from __future__ import annotations

import viser

from workbench.page.widgets.templates import render


def add_bar(server: viser.ViserServer) -> viser.GuiTabHandle:
    """The bar of 36 px across the top of the page, as a container.

    viser docks panels at the sides only. This one floats, and the style sheet gives it the first row of the page.
    """
    panel = server.gui.add_panel(order=-20.0)
    bar = panel.add_tab("")
    with bar:
        server.gui.add_html(render("bar"))
    panel.float(x=0, y=0)
    return bar

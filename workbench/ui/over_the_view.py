"""How wide a floating panel may be that lies over the view and must not lie over the controls beside it."""

from __future__ import annotations

import viser

GAP = 12
"""Pixels between such a panel and the edges of the view."""


class FitsTheView:
    """Keeps a floating panel as wide as the narrowest open view leaves room for.

    Args:
        server: Of viser.
        panel: It floats at `widest`.
        widest: Pixels.
        narrowest: Pixels.
    """

    def __init__(
        self, server: viser.ViserServer, panel: viser.PanelHandle, widest: int, narrowest: int
    ) -> None:
        self._server, self._panel = server, panel
        self._widest, self._narrowest = widest, narrowest
        self._width = widest

    def fit(self) -> None:
        """Fit it to the views as they are now."""
        views = [client.camera.image_width for client in self._server.get_clients().values()]
        least = min((width for width in views if width > 0), default=self._widest)
        width = int(min(max(least - 2 * GAP, self._narrowest), self._widest))
        if width != self._width:
            self._width = width
            self._panel.set_width(width)

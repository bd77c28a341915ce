"""How the page shows what it shows: all envs or one, dark or light."""

from __future__ import annotations

import viser

from workbench.session.view import SessionView
from workbench.ui.parts import PagePart

DETAILS = {"fine": 1_000_000, "normal": 200_000, "coarse": 50_000}
"""Triangles in the view. A browser without a graphics card wants the fewest."""
ALL, ONE = "all envs", "the selected env"
DARK, LIGHT = "dark", "light"
BRAND = (28, 112, 190)


class ViewPanel(PagePart[SessionView]):
    def __init__(self, server: viser.ViserServer, dark: bool = True) -> None:
        self._server = server
        with server.gui.add_folder("View"):
            self._show = server.gui.add_dropdown("Show", (ALL, ONE), initial_value=ALL, visible=False)
            self._detail = server.gui.add_dropdown(
                "Detail",
                tuple(DETAILS),
                initial_value="normal",
                hint="How finely shapes are drawn. Choose coarse if the view is slow.",
            )
            self._theme = server.gui.add_dropdown(
                "Theme", (DARK, LIGHT), initial_value=DARK if dark else LIGHT
            )
        self._theme.on_update(lambda _: self._apply_theme())
        self._apply_theme()

    @property
    def only_selected(self) -> bool:
        return self._show.value == ONE

    @property
    def dark(self) -> bool:
        return self._theme.value != LIGHT

    @property
    def triangles(self) -> int:
        return DETAILS[self._detail.value]

    def toggle_only_selected(self) -> None:
        self._show.value = ALL if self.only_selected else ONE

    def toggle_dark(self) -> None:
        self._theme.value = LIGHT if self._theme.value == DARK else DARK

    def draw(self, view: SessionView) -> None:
        several = view.task is not None and view.task.num_envs > 1
        self._show.visible = several

    def _apply_theme(self) -> None:
        self._server.gui.configure_theme(
            dark_mode=self.dark,
            show_logo=False,
            show_share_button=False,
            brand_color=BRAND,
        )

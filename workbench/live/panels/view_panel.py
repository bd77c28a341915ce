"""The folder *View*: all envs or one, level of detail, dark or light. Also on the review page."""

from __future__ import annotations

import viser

from workbench.live.env_commands import ShowEnvs
from workbench.live.view import SessionView
from workbench.page.command import Command
from workbench.page.commands import ChooseDetail, ChooseTheme
from workbench.page.scene.bodies import DrawStyle
from workbench.page.scene.viewpoint import ALL, DETAILS, ONE, ViewChoice
from workbench.page.widgets.fields import choice
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.visitors import Visitor

DARK, LIGHT = "dark", "light"
BRAND = (28, 112, 190)
"""Colour of the page's buttons, RGB."""


class ViewPanel(PagePart[object]):
    """The folder *View*."""

    does = (ShowEnvs, ChooseDetail, ChooseTheme)

    def __init__(
        self, server: viser.ViserServer, dark: bool = True, chosen: ViewChoice | None = None
    ) -> None:
        self._server, self.dark = server, dark
        self._choice = chosen = chosen or ViewChoice()
        with server.gui.add_folder("View"):
            self._show = choice(server, "Show", ShowEnvs, "which", (ALL, ONE), chosen.show)
            self._show.visible = False
            self._detail = choice(
                server,
                "Detail",
                ChooseDetail,
                "detail",
                tuple(DETAILS),
                chosen.detail,
                hint="How finely shapes are drawn. Choose coarse if the view is slow.",
            )
            self._theme = choice(
                server, "Theme", ChooseTheme, "theme", (DARK, LIGHT), DARK if dark else LIGHT
            )
        self._apply_theme()

    @property
    def only_selected(self) -> bool:
        return self._choice.show == ONE

    @property
    def looks(self) -> DrawStyle:
        return DrawStyle(DETAILS[self._choice.detail], self.dark)

    def show_only_selected(self, only: bool) -> None:
        self._choice.show = ONE if only else ALL

    def toggle_only_selected(self) -> None:
        self.show_only_selected(not self.only_selected)

    def toggle_dark(self) -> None:
        self.dark = not self.dark
        self._apply_theme()

    def draw(self, view: object) -> None:
        several = isinstance(view, SessionView) and view.task is not None and view.task.num_envs > 1
        self._show.visible = several
        self._show.show(self._choice.show)
        self._detail.show(self._choice.detail)
        self._theme.show(DARK if self.dark else LIGHT)

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ShowEnvs(which=which):
                self._choice.show = which
            case ChooseDetail(detail=detail):
                self._choice.detail = detail
            case ChooseTheme(theme=theme):
                self.dark = theme == DARK
                self._apply_theme()

    def _apply_theme(self) -> None:
        self._server.gui.configure_theme(
            dark_mode=self.dark,
            show_logo=False,
            show_share_button=False,
            brand_color=BRAND,
        )

"""Icons over the 3-D view, and the folder *View*. Also on the review page."""

from __future__ import annotations

import viser

from workbench.live.env_commands import NextEnv, PreviousEnv, ShowEnvs, ToggleOnlySelected
from workbench.live.view import SessionView
from workbench.page.command import Command
from workbench.page.commands import (
    ChooseDetail,
    ChooseTheme,
    FrameScene,
    ShowCollisions,
    ShowFrames,
    ShowFrustums,
    ToggleTheme,
)
from workbench.page.scene.bodies import DrawStyle
from workbench.page.scene.viewpoint import DETAILS, ViewChoice
from workbench.page.widgets.fields import choice
from workbench.page.widgets.keys_and_palette import with_key
from workbench.page.widgets.parts import PagePart, name_fold
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Tool, tool
from workbench.page.widgets.visitors import Visitor

TITLE = "View"
DARK, LIGHT = "dark", "light"
BRAND = (28, 112, 190)
"""Colour of the page's buttons, RGB."""


class ViewIcons(PagePart[object]):
    """Icons that choose what the 3-D view shows: the selected env or all envs, cameras, frames, collision
    shapes, the whole scene.

    Args:
        choice: the choices; they outlive the page.
        task: key of the open task among the choices.
    """

    does = (ShowEnvs, ToggleOnlySelected, ShowFrames, ShowFrustums, ShowCollisions)

    def __init__(self, server: viser.ViserServer, choice: ViewChoice, task: str = "") -> None:
        self._choice, self._task = choice, task
        panel = server.gui.add_panel(order=12.0)
        with panel.add_tab(""):
            self._html = server.gui.add_html("")
        # The style sheet puts it into the upper right corner of the view.
        panel.float(x=0, y=0)

    @property
    def only_selected(self) -> bool:
        """Whether the view shows only the selected env."""
        return self._task not in self._choice.all_envs

    def draw(self, view: object) -> None:
        several = isinstance(view, SessionView) and view.task is not None and view.task.num_envs > 1
        one, cameras = self.only_selected, self._choice.frustums
        icons: list[tuple[str, Tool]] = []
        if isinstance(view, SessionView) and several:
            icons = [
                ("left", tool("Previous env", PreviousEnv())),
                ("right", tool("Next env", NextEnv())),
                (
                    "one",
                    Tool("The selected env", ShowEnvs(all_envs=False), with_key(ToggleOnlySelected), on=one),
                ),
                ("all", Tool("All envs", ShowEnvs(all_envs=True), with_key(ToggleOnlySelected), on=not one)),
            ]
        shown = Tool("Cameras", ShowFrustums(on=not cameras), ShowFrustums.help(), on=cameras)
        frames = self._choice.frames
        axes = Tool("Frames", ShowFrames(on=not frames), ShowFrames.help(), on=frames)
        icons += [("cameras", shown), ("frames", axes), ("home", tool("Frame the scene", FrameScene()))]
        if isinstance(view, SessionView) and view.task is not None and view.task.geometry.collisions:
            on = self._choice.collisions
            shapes = Tool("Collision shapes", ShowCollisions(on=not on), ShowCollisions.help(), on=on)
            icons.insert(-1, ("collisions", shapes))
        env = f"env {view.selected_env}" if isinstance(view, SessionView) and several else ""
        self._html.content = render("toolbar", kind="view-icons", label="View", tools=icons, text=env)

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ShowEnvs(all_envs=True):
                self._choice.all_envs.add(self._task)
            case ShowEnvs():
                self._choice.all_envs.discard(self._task)
            case ToggleOnlySelected():
                self._choice.all_envs ^= {self._task}
            case ShowFrustums(on=on):
                self._choice.frustums = on
            case ShowFrames(on=on):
                self._choice.frames = on
            case ShowCollisions(on=on):
                self._choice.collisions = on


class ViewPanel(PagePart[object]):
    """The folder *View*: level of detail, dark or light."""

    does = (ChooseDetail, ChooseTheme, ToggleTheme)

    def __init__(
        self, server: viser.ViserServer, dark: bool = True, chosen: ViewChoice | None = None
    ) -> None:
        self._server, self.dark = server, dark
        self._choice = chosen = chosen or ViewChoice()
        self._folder = server.gui.add_folder(TITLE, expand_by_default=False)
        with self._folder:
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
    def looks(self) -> DrawStyle:
        return DrawStyle(DETAILS[self._choice.detail], self.dark)

    def draw(self, view: object) -> None:
        self._detail.show(self._choice.detail)
        theme = DARK if self.dark else LIGHT
        self._theme.show(theme)
        name_fold(self._folder, TITLE, f"{self._choice.detail}, {theme}")

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ChooseDetail(detail=detail):
                self._choice.detail = detail
            case ChooseTheme(theme=theme):
                self.dark = theme == DARK
                self._apply_theme()
            case ToggleTheme():
                self.dark = not self.dark
                self._apply_theme()

    def _apply_theme(self) -> None:
        self._server.gui.configure_theme(
            dark_mode=self.dark,
            show_logo=False,
            show_share_button=False,
            brand_color=BRAND,
        )

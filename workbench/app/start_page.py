"""The start page: the list of tasks, shown while none is open."""

from __future__ import annotations

import time

import workbench
from workbench.app.open_task import OpenTask
from workbench.app.palette_entries import add_help_topics
from workbench.app.shared import Shared
from workbench.live.panels.view_panel import BRAND
from workbench.page.command import Command, Refused
from workbench.page.commands import ShowRecordings, TellDrawnInSoftware, ToggleTheme
from workbench.page.widgets.keys_and_palette import register
from workbench.page.widgets.parts import Clock
from workbench.page.widgets.templates import render
from workbench.page.widgets.visitors import Done, Visitor
from workbench.start.panel import TaskList


class StartPage:
    """The list of tasks. There is no scene, so the list's panel fills the window (``.wb-start`` in page.css).

    Args:
        shared: The objects that all pages share.
        open_task: The list of tasks.
        also: Further commands that all pages have.
        dark: Whether the first theme is dark.
        clock: Clock of all parts of the page.
    """

    def __init__(
        self,
        shared: Shared,
        open_task: OpenTask,
        also: frozenset[type[Command]],
        dark: bool = True,
        clock: Clock = time.monotonic,
    ) -> None:
        self._server = server = shared.server
        self.dark = dark
        server.gui.main_panel.dock_right()
        server.gui.set_panel_label("Workbench")
        self._apply_theme()
        server.gui.add_html(render("start_head", version=workbench.__version__))
        open_task.catalogue.refresh()
        self._list = TaskList(server, open_task)
        self._shared = shared
        kinds = frozenset({ShowRecordings, ToggleTheme, *TaskList.does}) | also
        register(server, shared.visitors, kinds, "start page")
        add_help_topics(server, shared.visitors)

    def do(self, command: Command, visitor: Visitor) -> Done:
        """Carry out a command of a page. Raises `Refused`."""
        match command:
            case ShowRecordings():
                self._shared.pages.show("review")
            case ToggleTheme():
                self.dark = not self.dark
                self._apply_theme()
            case _ if isinstance(command, TaskList.does):
                return self._list.do(command, visitor)
            case TellDrawnInSoftware():
                self._shared.stage.in_software.report_arrived(visitor)
            case _:
                raise Refused(f"Not on this page: {command.help()}.")
        return None

    def wait(self, seen: int, timeout: float) -> int:
        """See `ShownPage`; this page is redrawn at a fixed interval."""
        time.sleep(timeout)
        return seen

    def counted(self, visitors: int) -> None:
        """Ignored: the page has no pictures to render."""

    def close(self) -> None:
        """Does nothing: the page holds no resources."""

    def redraw(self) -> None:
        """Draw what has changed."""
        with self._server.atomic():
            self._list.draw()
        self._server.flush()

    def _apply_theme(self) -> None:
        self._server.gui.configure_theme(
            dark_mode=self.dark, show_logo=False, show_share_button=False, brand_color=BRAND
        )

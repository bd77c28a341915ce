"""The start page: the list of tasks, while none is open."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

import workbench
from workbench.commands.command import Command, Refused
from workbench.commands.page import ShowRecordings, TellDrawnInSoftware, ToggleTheme
from workbench.ui.scene.viewpoint import BRAND
from workbench.ui.tasks.task_list import TaskList
from workbench.ui.widgets.hotkeys import register
from workbench.ui.widgets.parts import Clock
from workbench.ui.widgets.redraw_loop import RedrawLoop
from workbench.ui.widgets.templates import render
from workbench.ui.widgets.visitors import Visitor

if TYPE_CHECKING:
    from workbench.ui.app.workplace import Workplace

LOOK = 0.1
"""Seconds between two checks whether the list has changed."""


class StartPage:
    """The list in a panel over the whole window (``.wb-start`` in page.css): there is no scene to look at.

    Args:
        place: The pages, and the list.
        dark: The first theme.
        clock: Of all parts of the page.
    """

    def __init__(self, place: Workplace, dark: bool = True, clock: Clock = time.monotonic) -> None:
        self._server = server = place.server
        self.dark = dark
        self._resting = threading.Event()
        self._loop = RedrawLoop(
            server, "start-page", self._wait, lambda: place.stage.framing.follow() > 0, self.redraw
        )
        server.gui.main_panel.dock_right()
        server.gui.set_panel_label("Workbench")
        self._apply_theme()
        server.gui.add_html(render("start_head", version=workbench.__version__))
        place.open_task.catalogue.refresh()
        self._list = TaskList(server, place.open_task)
        self._place = place
        kinds = frozenset({ShowRecordings, ToggleTheme, *TaskList.does}) | place.does
        register(server, place.visitors, kinds, "start page")

    def do(self, command: Command, visitor: Visitor) -> None:
        """Carry out a command of a page. Raises `Refused`."""
        match command:
            case ShowRecordings():
                self._place.pages.show("review")
            case ToggleTheme():
                self.dark = not self.dark
                self._apply_theme()
            case _ if isinstance(command, TaskList.does):
                self._list.do(command, visitor)
            case TellDrawnInSoftware():
                self._place.stage.in_software.told_by(visitor)
            case _:
                raise Refused(f"Not on this page: {command.help()}.")

    def start(self) -> None:
        """Draw it, then keep drawing it in a thread."""
        self._loop.start()

    def stop(self) -> None:
        """Stop redrawing; returns when the loop has ended."""
        self._resting.set()
        self._loop.stop()

    def redraw(self) -> None:
        """Draw what has changed."""
        with self._server.atomic():
            self._list.draw()
        self._server.flush()

    def _wait(self, seen: int, timeout: float) -> int:
        self._resting.wait(min(timeout, LOOK))
        return seen + 1

    def _apply_theme(self) -> None:
        self._server.gui.configure_theme(
            dark_mode=self.dark, show_logo=False, show_share_button=False, brand_color=BRAND
        )

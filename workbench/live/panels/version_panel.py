"""How the running version was loaded, and buttons to reload it or choose the file's task."""

from __future__ import annotations

import time

import viser

from workbench.live.commands import ChooseClass, RebuildScene, ReloadCameras, ReloadCode, ReloadFile
from workbench.live.messages import ReloadReport
from workbench.live.run import PastLoad
from workbench.live.view import SessionView
from workbench.page.widgets.editor_links import LinkTo, no_links
from workbench.page.widgets.fields import by_name, choice
from workbench.page.widgets.keys_and_palette import with_key
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Tool, tool, tools_html
from workbench.task.problem import Problem

BY_HAND, LAST_LOADS = "Reload by hand", "Last reloads"
MAX_NAMED = 8
"""Maximum number of named items that were not carried over; the rest is counted."""


class VersionPanel(PagePart[SessionView]):
    """Level, reason and time of the last load, and state that a rebuild could not carry over.

    A save reloads with the smallest level that is safe, and the author must see which: an author who thinks that the scene
    was rebuilt, when only the reward was patched, looks for a bug that does not exist.
    """

    def __init__(self, server: viser.ViserServer, link: LinkTo = no_links) -> None:
        self._link = link
        with server.gui.add_folder("Code version"):
            self._task = choice(
                server, "Task", ChooseClass, "name", (), "", hint="The file has several tasks."
            )
            self._task.visible = False
            self._html = server.gui.add_html("")
            with server.gui.add_folder(BY_HAND, expand_by_default=False):
                self._again = server.gui.add_html("")
            self._loads_folder = server.gui.add_folder(LAST_LOADS, expand_by_default=False, visible=False)
            with self._loads_folder:
                self._loads = server.gui.add_html("")

    def key(self, view: SessionView) -> object:
        notices = None if view.task is None else view.task.notices
        return (
            view.state,
            view.choices,
            view.reload,
            view.load_milliseconds,
            notices,
            view.refused,
            view.loads,
            view.timeline_cleared,
        )

    def draw(self, view: SessionView) -> None:
        task = view.task
        least = Tool("Reload", ReloadFile(), with_key(ReloadFile, "As little as is safe"))
        again = (
            [least, tool("Rebuild the scene", RebuildScene())],
            [tool("Only reload code", ReloadCode()), tool("Only reload cameras", ReloadCameras())],
        )
        self._again.content = tools_html(*again if view.state != "stopped" else ())
        self._task.visible = len(view.choices) > 1
        # Sorted, so that the order does not depend on the chosen class.
        self._task.show(next(iter(view.choices), ""), options=by_name(sorted(view.choices)))
        notices = () if task is None else task.notices
        refused = view.refused if view.state not in ("starting", "loading") else None
        self._html.content = version_html(
            view.reload,
            view.load_milliseconds,
            task is not None,
            refused,
            notices,
            self._link,
            view.timeline_cleared,
        )
        self._loads_folder.visible = len(view.loads) > 1
        self._loads.content = loads_html(view.loads, self._link)


def version_html(
    report: ReloadReport | None,
    milliseconds: float,
    loaded: bool,
    refused: Problem | None = None,
    notices: tuple[str, ...] = (),
    link: LinkTo = no_links,
    timeline_cleared: bool = False,
) -> str:
    """The panel's text about the running version, and about the file if it was refused.

    Args:
        report: how the running version was loaded; None for the first version.
        milliseconds: duration of the load.
        loaded: whether a version runs.
        refused: why the file's present text does not run.
        notices: further notes for the author.
        link: links the line at which the file was refused.
        timeline_cleared: whether the load of the running version started a new history.
    """
    return render(
        "version",
        report=report,
        time=took(milliseconds),
        loaded=loaded,
        refused=refused,
        notices=notices,
        most=MAX_NAMED,
        link=link,
        timeline_cleared=timeline_cleared,
    )


def loads_html(loads: tuple[PastLoad, ...], link: LinkTo = no_links) -> str:
    """The list of the last loads, newest first: time, level, duration, reason."""

    def clock(at: float) -> str:
        return time.strftime("%H:%M:%S", time.localtime(at))

    def day(at: float) -> str:
        return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(at))

    return render("loads", loads=loads, link=link, clock=clock, day=day, took=took)


def took(milliseconds: float) -> str:
    """``43 ms``, ``1.2 s``."""
    return f"{milliseconds:.0f} ms" if milliseconds < 1000 else f"{milliseconds / 1000:.1f} s"

"""Time of a control step, as shares of its hooks and lines."""

from __future__ import annotations

import viser

from workbench.checks.commands import StopProfile, TimeStep
from workbench.checks.profile import ProfileView
from workbench.live.view import SessionView
from workbench.page.widgets.editor_links import LinkTo, no_links
from workbench.page.widgets.parts import PagePart, name_fold
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import tool, tools_html

TITLE = "Where does a step go"
PROFILE, STOP_PROFILE = "Time a step", "Stop timing"
MOST_HOOKS, MOST_LINES = 12, 12
FEWEST_LINES, SMALL = 5, 0.01
"""Number of lines that are always shown, and minimum share of a step for further lines to be shown."""


class StepProfilePanel(PagePart[SessionView]):
    """A button that times a step in the background process, and two tables of the result.

    Args:
        server: The page.
        link: Links the lines of the author's files.
    """

    every = 0.25

    def __init__(self, server: viser.ViserServer, link: LinkTo = no_links) -> None:
        self._link = link
        self._folder = server.gui.add_folder(TITLE, expand_by_default=False)
        with self._folder:
            self._tools = server.gui.add_html("")
            self._html = server.gui.add_html("")

    def key(self, view: SessionView) -> object:
        return view.of(ProfileView).serial, view.task_serial

    def draw(self, view: SessionView) -> None:
        running = view.of(ProfileView).state == "running"
        pressed = tool(STOP_PROFILE, StopProfile()) if running else tool(PROFILE, TimeStep())
        self._tools.content = tools_html([pressed] if running or view.task is not None else [])
        profile = view.of(ProfileView).profile
        name_fold(self._folder, TITLE, "" if profile is None else milliseconds(profile.milliseconds))
        self._html.content = profile_html(view.of(ProfileView), self._link)


def profile_html(shown: ProfileView, link: LinkTo = no_links) -> str:
    """HTML of the tables; without a profile, of a sentence that says what the tables will show."""
    lines = () if shown.profile is None else shown.profile.lines[:MOST_LINES]
    lines = [line for place, line in enumerate(lines) if place < FEWEST_LINES or line.share >= SMALL]
    known = {"lines": lines, "most_hooks": MOST_HOOKS, "ms": milliseconds, "part": share_text}
    return render("step_profile", shown=shown, link=link, **known)


def share_text(share: float) -> str:
    """``35 %``, ``0.4 %``."""
    return f"{100 * share:.0f} %" if share >= SMALL else f"{100 * share:.1f} %"


def milliseconds(value: float) -> str:
    """``12 ms``, ``1.2 ms``, ``0.03 ms``."""
    return f"{value:.0f} ms" if value >= 10 else f"{value:.1f} ms" if value >= 1 else f"{value:.2g} ms"

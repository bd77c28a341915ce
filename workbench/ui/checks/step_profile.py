"""Where a step goes: hooks and lines of a control step by their share."""

from __future__ import annotations

import viser

from workbench.session.checks.profile import ProfileView
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.ui.widgets.editor import LinkTo, no_links
from workbench.ui.widgets.parts import PagePart
from workbench.ui.widgets.templates import render

TITLE = "Where does a step go"
PROFILE, STOP_PROFILE = "Time a step", "Stop timing"
MOST_HOOKS, MOST_LINES = 12, 12
FEWEST_LINES, SMALL = 5, 0.01
"""Lines beyond the first ones are shown down to this share."""


class StepProfilePanel(PagePart[SessionView]):
    """A button that times a step in the background process, and two tables of what it came to.

    Args:
        server: The page.
        session: The session.
        link: Links the lines of the author's files.
    """

    every = 0.25

    def __init__(self, server: viser.ViserServer, session: Session, link: LinkTo = no_links) -> None:
        self._link = link
        with server.gui.add_folder(TITLE, expand_by_default=False):
            self._start = server.gui.add_button(
                PROFILE,
                icon=viser.Icon.CLOCK,
                color="gray",
                hint="Times each hook and line over some hundred control steps, in a process of its own.",
            )
            self._stop = server.gui.add_button(
                STOP_PROFILE, icon=viser.Icon.PLAYER_STOP, color="gray", visible=False
            )
            self._html = server.gui.add_html("")
        self._start.on_click(lambda _: session.profile_step())
        self._stop.on_click(lambda _: session.profiler.stop())

    def key(self, view: SessionView) -> object:
        return view.profile.serial, view.task_serial

    def draw(self, view: SessionView) -> None:
        running = view.profile.state == "running"
        self._start.visible = not running and view.task is not None
        self._stop.visible = running
        self._html.content = profile_html(view.profile, self._link)


def profile_html(shown: ProfileView, link: LinkTo = no_links) -> str:
    """The tables, or what to do for them."""
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

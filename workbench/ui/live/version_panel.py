"""How the version that is shown came in, and the ways to bring it in again.

A saved file comes in by the least that is safe, and a person must be able to see what that was: an author who
thinks that the scene was built anew, when only the reward was exchanged, looks for a bug that is not there. So
level, reason and time stand here, with what a build could not carry over; and beside them the buttons that choose
otherwise. Where a file has several tasks, this is where one of them is chosen.
"""

from __future__ import annotations

from typing import Any

import viser

from workbench.authoring.problem import Problem
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.session.protocol.messages import LoadLevel, ReloadReport
from workbench.ui.widgets.inputs import Control
from workbench.ui.widgets.parts import PagePart
from workbench.ui.widgets.templates import render

AS_NEEDED, PATCHED, CAMERAS, REBUILT = "Load again", "Patch", "Cameras", "Rebuild"
LEVELS: dict[str, LoadLevel] = {
    AS_NEEDED: "auto",
    PATCHED: "patched",
    CAMERAS: "cameras",
    REBUILT: "rebuilt",
}
MOST_SHOWN = 8
"""Things not carried that are named; the rest is counted."""


class VersionPanel(PagePart[SessionView]):
    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._session = session
        self._names: tuple[str, ...] = ("",)
        # viser's annotations take the first options for all that there will ever be.
        add_dropdown: Any = server.gui.add_dropdown
        with server.gui.add_folder("Version of the file"):
            self._task = Control(
                add_dropdown("Task", self._names, visible=False, hint="The file has several tasks."),
                send=session.versions.choose_class,
            )
            self._html = server.gui.add_html("")
            self._again = server.gui.add_button_group(
                "",
                tuple(LEVELS),
                hint="Load again: by the least that is safe. Patch: only the code. Cameras: code and cameras. "
                "Rebuild: the scene too, with the moment put back. A patch that was not found safe can leave old "
                "and new code mixed.",
            )
            self._again.on_click(lambda event: self._load(event.target.value))

    def draw(self, view: SessionView) -> None:
        task = view.task
        can_load = view.state != "stopped"
        self._again.visible = can_load
        if len(view.choices) > 1:
            # In one order, whichever of them is shown.
            if tuple(sorted(view.choices)) != self._names:
                self._names = tuple(sorted(view.choices))
                self._task.handle.options = self._names
            self._task.show(view.choices[0])
        self._task.handle.visible = len(view.choices) > 1
        notices = () if task is None else task.notices
        refused = view.refused if view.state not in ("starting", "loading") else None
        self._html.content = version_html(
            view.reload, view.load_milliseconds, task is not None, refused, notices
        )

    def _load(self, value: str) -> None:
        self._session.versions.reload(LEVELS[value])


def version_html(
    report: ReloadReport | None,
    milliseconds: float,
    loaded: bool,
    refused: Problem | None = None,
    notices: tuple[str, ...] = (),
) -> str:
    """What the page says of the version that runs, and of the file where it holds another; every value escaped.

    Args:
        report: how the version that runs came in; None for the first.
        milliseconds: that it took.
        loaded: whether one runs.
        refused: why what is in the file does not.
        notices: what the author should know of it besides.
    """
    return render(
        "version",
        report=report,
        time=took(milliseconds),
        loaded=loaded,
        refused=refused,
        notices=notices,
        most=MOST_SHOWN,
    )


def took(milliseconds: float) -> str:
    """``43 ms``, ``1.2 s``."""
    return f"{milliseconds:.0f} ms" if milliseconds < 1000 else f"{milliseconds / 1000:.1f} s"

"""The banner over the top of the view: what is wrong in the author's file, until it is right again.

It floats over the view and never over the controls, because the last good version keeps running
behind it and stays usable. First the sentence that is needed (what failed, where), then the line of
code and the message; the whole traceback only on demand.
"""

from __future__ import annotations

import viser

from workbench.authoring.problem import Problem
from workbench.session.view import SessionView
from workbench.ui.busy_banner import is_shown as busy_is_shown
from workbench.ui.fragments import render
from workbench.ui.over_the_view import GAP, FitsTheView
from workbench.ui.parts import Part

WIDEST, NARROWEST = 520, 240
"""Pixels. Between them it is as wide as the narrowest open view leaves room for: over the controls it
would hide the very buttons that the last good version is still used with."""

DOING = {
    "syntax": "cannot be read",
    "import": "failed to import",
    "build": "failed to build its scene",
    "reset": "failed in reset",
    "step": "failed in step",
    "evaluate": "failed in evaluate",
    "reward": "failed in its reward",
    "observation": "failed in its observation",
    "returns": "returned something of the wrong shape",
    "policy": "was stopped by its policy",
    "worker": "lost its worker process",
}
INTERRUPTED = {
    "import": "was interrupted while it was imported",
    "build": "was interrupted while it built its scene",
    "policy": "had its policy interrupted",
}


class Banner(Part[SessionView]):
    """A floating panel that is there only while a problem stands.

    Args:
        server: The page.
        reload: Asks the session to load the file again.
        restart: Asks the session for a new worker process.
    """

    def __init__(self, server: viser.ViserServer, reload, restart) -> None:
        self._panel = server.gui.add_panel(visible=False, order=-10.0)
        with self._panel.add_tab("Problem", viser.Icon.ALERT_TRIANGLE):
            self._html = server.gui.add_html("")
            self._reload = server.gui.add_button("Load the file again", icon=viser.Icon.REFRESH, color="gray")
            self._restart = server.gui.add_button(
                "Start a new worker", icon=viser.Icon.POWER, color="gray", visible=False
            )
        # From the right edge of the view: on the left are viser's own notices.
        self._panel.float(x=-GAP, y=GAP, width=WIDEST)
        self._server = server
        self._fits = FitsTheView(server, self._panel, WIDEST, NARROWEST)
        self._reload.on_click(lambda _: reload())
        self._restart.on_click(lambda _: restart())
        self._drawn: tuple[int, str] | None = None

    def draw(self, view: SessionView) -> None:
        problem = view.problem
        if problem is None or busy_is_shown(view):
            if self._panel.visible:
                self._panel.visible = False
            self._drawn = None
            return
        self._fits.fit()
        stopped = view.state == "stopped"
        self._restart.visible = stopped
        # Written once a problem: a new text would close the traceback that someone has open.
        drawn = view.problem_serial, _kept(view) if problem.stage == "worker" else ""
        if drawn != self._drawn:
            self._drawn = drawn
            self._html.content = banner_html(problem, view)
            self._panel.visible = True
            self._panel.expand()


def banner_html(problem: Problem, view: SessionView) -> str:
    """The banner's content; every value escaped."""
    if problem.stage == "syntax" or (view.task is None and problem.file is not None):
        subject = "The file"
    else:
        subject = "The task" if view.task is None else view.task.class_name or view.task.env_id
    doing = DOING.get(problem.stage, f"failed in {problem.stage}")
    if problem.interrupted:
        doing = INTERRUPTED.get(problem.stage, f"was interrupted in {problem.stage}")
    return render("banner", subject=subject, doing=doing, problem=problem, kept=_kept(view))


def _kept(view: SessionView) -> str:
    """What there still is."""
    if view.state == "stopped":
        return "The worker process is gone, so nothing moves until there is a new one."
    if view.task is None:
        return "There is no version to show yet. Mend the file and save it; the page follows."
    if view.problem is not None and view.problem.stage == "worker":
        if view.state in ("starting", "loading"):
            return "Another worker takes over; the last good version comes back where it was."
        return "The last good version is back where it was, and paused."
    if view.playing:
        return "The last good version keeps running."
    return "The last good version stays on the page."

"""The banners over the top of the view: what is wrong in the author's file, or what its code has been at for long.

They float over the view and never over the controls, because the last good version keeps running behind and stays
usable. Of a problem the sentence that is needed comes first (what failed, where), then the line of code and the message;
the whole traceback only on demand.

Code that is at one thing for long may only be slow, so nothing is done unasked, and the page says what is known instead:
the hook, the author's line, the seconds. *Interrupt* leaves the code there, with its traceback, and keeps the process and
the envs. Where that does not help (native code, a loop that catches everything), *Restart* ends the process, and the last
good version comes back in another, where it was.
"""

from __future__ import annotations

import viser

from workbench.authoring.problem import Problem
from workbench.session.live.view import SessionView
from workbench.session.process.heartbeat import Busy
from workbench.ui.live.timeline import GAP
from workbench.ui.widgets.parts import PagePart
from workbench.ui.widgets.templates import render

WIDEST, BUSY_WIDEST = 520, 460
"""Pixels. The style sheet makes them as narrow as the view: over the controls they would hide the very buttons that the
last good version is still used with."""

SHOWN_AFTER = 4.0
"""Seconds. The status line says it earlier; a banner is for what one may want to end."""

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


def is_busy_for_long(view: SessionView) -> bool:
    """Whether the banner stands over the view; it goes before that of a problem.

    Not for a worker that gets ready: nothing of the author's is at work then, and why the one before is gone
    must stay in sight. Nor for one that a debugger holds, which the status line says.
    """
    busy = view.busy
    return busy is not None and busy.seconds >= SHOWN_AFTER and not (busy.getting_ready or busy.held)


class Banner(PagePart[SessionView]):
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
        self._reload.on_click(lambda _: reload())
        self._restart.on_click(lambda _: restart())
        self._drawn: tuple[int, str] | None = None

    def draw(self, view: SessionView) -> None:
        problem = view.problem
        if problem is None or is_busy_for_long(view):
            if self._panel.visible:
                self._panel.visible = False
            self._drawn = None
            return
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


class BusyBanner(PagePart[SessionView]):
    """A floating panel that is there only while the worker is busy for long.

    Args:
        server: The page.
        interrupt: Asks the session to have the author's code left where it is.
        restart: Asks the session for another worker process.
    """

    def __init__(self, server: viser.ViserServer, interrupt, restart) -> None:
        self._panel = server.gui.add_panel(visible=False, order=-11.0)
        with self._panel.add_tab("Busy", viser.Icon.HOURGLASS):
            self._html = server.gui.add_html("")
            self._traceback = server.gui.add_html("", visible=False)
            self._interrupt = server.gui.add_button("Interrupt", icon=viser.Icon.HAND_STOP, color="orange")
            self._restart = server.gui.add_button("Restart", icon=viser.Icon.POWER, color="gray")
        self._panel.float(x=-GAP, y=GAP, width=BUSY_WIDEST)
        self._interrupt.on_click(lambda _: interrupt())
        self._restart.on_click(lambda _: restart())

    def draw(self, view: SessionView) -> None:
        busy = view.busy
        if busy is None or not is_busy_for_long(view):
            self._panel.visible = False
            return
        self._html.content = busy_html(busy, view)
        # Apart from the seconds, which would close it each time that they change.
        trace = render("traceback", traceback=busy.traceback) if busy.deaf and busy.traceback else ""
        self._traceback.content = trace
        self._traceback.visible = bool(trace)
        can_interrupt = not busy.deaf and not busy.drawing
        self._interrupt.visible = can_interrupt
        if not self._panel.visible:
            self._panel.visible = True
            self._panel.expand()


def busy_html(busy: Busy, view: SessionView) -> str:
    """The banner's content; every value escaped."""
    if busy.deaf:
        advice = (
            "It was interrupted and goes on: it is in native code, or it catches every exception. Restart ends the "
            "process; the last good version comes back where it was."
        )
    elif busy.drawing:
        advice = "The renderer is at work. The first picture may take long; Restart ends the process."
    else:
        advice = (
            "It may only be slow. Interrupt stops it there and shows the traceback; Restart ends the process, and "
            "the last good version comes back where it was. Saving a mended file does as much."
        )
    subject = "The task" if view.task is None else view.task.class_name or view.task.env_id
    return render("busy", subject=subject, busy=busy, advice=advice)

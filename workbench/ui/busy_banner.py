"""The banner that comes when the task's code has been at one thing for long: where it is, and a way out.

It may only be slow, so nothing is done unasked, and the page says what is known instead: the hook, the author's
line, the seconds. *Interrupt* leaves the code there, with its traceback, and keeps the process and the envs.
Where that does not help (native code, a loop that catches everything), *Restart* ends the process, and the last
good version comes back in another, where it was.
"""

from __future__ import annotations

import viser

from workbench.session.last_words import Busy
from workbench.session.view import SessionView
from workbench.ui.fragments import render
from workbench.ui.parts import Part

SHOWN_AFTER = 4.0
"""Seconds. The status line says it earlier; a banner is for what one may want to end."""
GAP = 12
WIDTH = 460


def is_shown(view: SessionView) -> bool:
    """Whether the banner stands over the view; it goes before that of a problem.

    Not for a worker that gets ready: nothing of the author's is at work then, and why the one before is gone
    must stay in sight. Nor for one that a debugger holds, which the status line says.
    """
    busy = view.busy
    return busy is not None and busy.seconds >= SHOWN_AFTER and not (busy.getting_ready or busy.held)


class BusyBanner(Part[SessionView]):
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
        self._panel.float(x=-GAP, y=GAP, width=WIDTH)
        self._interrupt.on_click(lambda _: interrupt())
        self._restart.on_click(lambda _: restart())

    def draw(self, view: SessionView) -> None:
        busy = view.busy
        if busy is None or not is_shown(view):
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

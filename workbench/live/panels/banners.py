"""Banners over the 3-D view: a problem in the author's file, or code that runs for long."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import viser

from workbench.live.commands import FillEmptyFile, Interrupt, RebuildScene, ReloadFile, RestartWorker
from workbench.live.panels.timeline_panel import step_in_words
from workbench.live.process.heartbeat import Busy
from workbench.live.view import SessionView
from workbench.machine.loop import BlockingPool
from workbench.page.command import Command, Refused
from workbench.page.widgets.editor_links import LinkTo, no_links
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Tool, tool, tools_html
from workbench.page.widgets.visitors import Done, Visitor
from workbench.task.new_task import CannotBegin, fill_blank_file, is_blank
from workbench.task.problem import Problem

WIDTH_PIXELS, BUSY_WIDTH_PIXELS = 520, 460
"""Widths if the view is wide enough. In a narrower view the style sheet narrows the banner: otherwise it
would cover the controls, which still work for the last good version."""

FILL = "Write the minimal task into it"
RELOAD, INTERRUPT, RESTART, NEW_WORKER = "Reload the file", "Interrupt", "Restart", "Restart the worker"
REBUILD = "Rebuild the scene"
REBUILD_HINT = (
    "A patch keeps the old scene. Rebuild if the new code needs something that _load_scene makes, such as a body or an "
    "attribute. The current state is restored."
)
_MAY_BE_OLD = ("reset", "step", "evaluate", "reward", "observation", "returns")
"""Stages that use objects made while the scene was built. A patch keeps the old objects, so objects that the
new code expects may be missing."""
SHOWN_AFTER_SECONDS = 4.0
"""Time after which the banner of long-running code is shown. The status line reports such code earlier; a
banner is for code that the user may want to end."""

DOING = {
    "syntax": "is not Python yet",
    "import": "failed to import",
    "build": "failed to build its scene",
    "reset": "failed in reset",
    "step": "failed in step",
    "evaluate": "failed in evaluate",
    "reward": "failed in its reward",
    "observation": "failed in its observation",
    "returns": "returned the wrong shape",
    "policy": "failed",
    "worker": "lost its worker process",
}
INTERRUPTED = {
    "import": "was interrupted during import",
    "build": "was interrupted while building its scene",
    "policy": "was interrupted",
}


def is_busy_for_a_long_time(view: SessionView) -> bool:
    """Whether to show the busy banner, which hides the problem banner.

    The busy banner is hidden while a worker starts: none of the author's code runs then, and the reason why
    the last worker ended must stay visible. It is also hidden while a debugger holds the worker; the status
    line shows that.
    """
    busy = view.busy
    return busy is not None and busy.seconds >= SHOWN_AFTER_SECONDS and not (busy.getting_ready or busy.held)


class Banner(PagePart[SessionView]):
    """A floating panel shown while there is a problem: what failed and where, the line of code, the message, and the
    traceback on demand.

    Args:
        server: The page.
        link: Makes the link to a source line.
        is_own: Returns whether the banner may write this file: it is the task's file, and was named by the
            user, not by a recording.
    """

    does = (FillEmptyFile,)

    def __init__(
        self,
        server: viser.ViserServer,
        link: LinkTo = no_links,
        is_own: Callable[[str], bool] = lambda file: False,
    ) -> None:
        self._link, self._is_own = link, is_own
        self._blank: Path | None = None
        """The empty file that the banner offers to fill."""
        self._disk = BlockingPool("fill-file")
        self._panel = server.gui.add_panel(visible=False, order=-10.0)
        with self._panel.add_tab("Problem", viser.Icon.ALERT_TRIANGLE):
            self._html = server.gui.add_html("")
            # A separate element, since its text changes: rewriting the element above would close a traceback
            # there.
            self._kept = server.gui.add_html("")
            self._tools = server.gui.add_html("")
        self._panel.float(width=WIDTH_PIXELS)
        self._drawn: int | None = None
        """Serial of the problem that is drawn."""

    def draw(self, view: SessionView) -> None:
        problem = view.problem
        if problem is None or is_busy_for_a_long_time(view):
            if self._panel.visible:
                self._panel.visible = False
            self._drawn = self._blank = None
            return
        # Written once per problem: rewriting would close an open traceback.
        if view.problem_serial != self._drawn:
            self._drawn = view.problem_serial
            file = Path(problem.file) if problem.file and self._is_own(problem.file) else None
            self._blank = file if view.task is None and file is not None and is_blank(file) else None
            self._html.content = banner_html(problem, view, self._link)
            self._panel.visible = True
            self._panel.expand()
        self._kept.content = kept_html(view)
        stopped = _stopped(view)
        may_be_old = view.task is not None and not stopped and problem.stage in _MAY_BE_OLD
        self._tools.content = tools_html(
            [tool(FILL, FillEmptyFile(), tone="main")] if self._blank is not None else [],
            [
                tool(RELOAD, ReloadFile()),
                *([Tool(REBUILD, RebuildScene(), REBUILD_HINT)] if may_be_old else []),
                *([tool(NEW_WORKER, RestartWorker())] if stopped else []),
            ],
        )

    def do(self, command: Command, visitor: Visitor) -> Done:
        if self._blank is None:
            raise Refused("No empty file is open.")
        return self._fill(self._blank)

    async def _fill(self, file: Path) -> None:
        try:
            await self._disk.run(partial(fill_blank_file, file))
        except CannotBegin as error:
            raise Refused(str(error)) from None


def banner_html(problem: Problem, view: SessionView, link: LinkTo = no_links) -> str:
    """The banner's content."""
    if problem.stage == "policy":
        subject = "The policy"
    elif problem.stage == "syntax" or (view.task is None and problem.file is not None):
        subject = "The file"
    else:
        subject = "The task" if view.task is None else view.task.class_name or view.task.env_id
    doing = DOING.get(problem.stage, f"failed in {problem.stage}")
    if problem.has_no_place:
        doing = "was not loaded"
    if problem.interrupted:
        doing = INTERRUPTED.get(problem.stage, f"was interrupted in {problem.stage}")
    return render("banner", subject=subject, doing=doing, problem=problem, link=link)


def kept_html(view: SessionView) -> str:
    """HTML of the text below the problem, see `_kept`."""
    return render("banner_kept", kept=_kept(view))


def _stopped(view: SessionView) -> bool:
    """Whether no worker has a version loaded, and no worker will start without a command."""
    lost = view.problem is not None and view.problem.stage == "worker"
    return view.state == "stopped" or (lost and view.state == "error")


def _kept(view: SessionView) -> str:
    """Text: which version still runs and how to continue."""
    if _stopped(view):
        return "No process runs the task. Restart the worker to load the file as it is now."
    if view.task is None and not (view.problem is not None and view.problem.file):
        return "There is nothing to show yet. Open another task (Ctrl+O) or change how the envs are made (Run tab)."
    if view.task is None:
        return "No version has loaded yet. Fix the file and save it, and the page will show it."
    if view.state in ("starting", "loading"):
        return "A new process is starting; it restores the version that ran, at the same moment."
    if view.problem is not None and view.problem.stage == "worker":
        return "The last good version was restored to its last moment, and is paused."
    if view.problem_at_run:
        if view.problem is not None and view.problem.stage == "policy":
            return "The task is paused. Save a fixed policy, or choose another source of actions (Run tab)."
        process = f" Another process has loaded this version: {view.spoiled}." if view.spoiled else ""
        return (
            f"The task failed while it ran, and is paused at {step_in_words(view)}.{process} Save a fixed "
            "file, or continue with this version: reset (Shift+R) or step (S)."
        )
    if view.playing:
        return "The last good version is still running."
    return "The last good version is still loaded, and paused."


class BusyBanner(PagePart[SessionView]):
    """A floating panel that is shown while the worker is busy for a long time, with the hook, line and seconds.

    The code may just be slow, so nothing is done automatically. *Interrupt* raises an exception in the
    author's code, and keeps the process and the envs. If that does not help (native code, a loop that catches
    everything), *Restart* ends the process. A new process loads the file as it is now; if the old process was
    loading the file, the new one restores the last good version instead.

    Args:
        server: The page.
        link: Makes the link to a source line.
    """

    def __init__(self, server: viser.ViserServer, link: LinkTo = no_links) -> None:
        self._link = link
        self._panel = server.gui.add_panel(visible=False, order=-11.0)
        with self._panel.add_tab("Busy", viser.Icon.HOURGLASS):
            self._html = server.gui.add_html("")
            self._traceback = server.gui.add_html("", visible=False)
            self._tools = server.gui.add_html("")
        self._panel.float(width=BUSY_WIDTH_PIXELS)

    def draw(self, view: SessionView) -> None:
        busy = view.busy
        if busy is None or not is_busy_for_a_long_time(view):
            self._panel.visible = False
            return
        self._html.content = busy_html(busy, view, self._link)
        # The traceback is a separate element: rewriting it with the changing seconds would close it.
        trace = (
            render("traceback", traceback=busy.traceback) if busy.ignores_interrupt and busy.traceback else ""
        )
        self._traceback.content = trace
        self._traceback.visible = bool(trace)
        can_interrupt = not busy.ignores_interrupt and not busy.drawing
        interrupt = [tool(INTERRUPT, Interrupt(), tone="main")] if can_interrupt else []
        self._tools.content = tools_html([*interrupt, tool(RESTART, RestartWorker())])
        if not self._panel.visible:
            self._panel.visible = True
            self._panel.expand()


def busy_html(busy: Busy, view: SessionView, link: LinkTo = no_links) -> str:
    """The banner's content."""
    if busy.ignores_interrupt:
        advice = (
            "It did not stop when it was interrupted: it is in native code, or it catches every exception. Restart "
            "ends the process and loads the file as it is now; if it is already being loaded, Restart brings "
            "back the last good version instead."
        )
    elif busy.drawing:
        advice = "The renderer is working. The first picture may take a while; Restart ends the process."
    else:
        advice = (
            "It may only be slow. Interrupt stops it there and shows the traceback. Saving a fixed file also "
            "stops it, and loads the file. Restart ends the process and loads the file as it is now."
        )
    subject = "The task" if view.task is None else view.task.class_name or view.task.env_id
    return render("busy", subject=subject, busy=busy, phase=phase_of(busy, view), advice=advice, link=link)


def phase_of(busy: Busy, view: SessionView) -> str:
    """What a long load does now; empty for other work, and inside a hook of the author."""
    return view.activity if busy.doing == "loading" else ""

"""Runs ``workbench``, ``workbench open`` and ``workbench review``: serves a page until a signal ends it."""

from __future__ import annotations

import os
import queue
import signal
import sys
from collections.abc import Callable
from concurrent import futures
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NoReturn

from rich.markup import escape

import workbench
from workbench.app.open_task import Choices
from workbench.app.pages import Which
from workbench.app.server import App
from workbench.app.session import HISTORY_BYTES, KeptWork, Session
from workbench.cli.output import out, print_addresses, print_event, print_line, print_text, refuse, warn
from workbench.envs.recorded_run import RUN_KEYWORDS
from workbench.episodes.reader.reading import start_reading
from workbench.live.messages import Event, Loaded, TaskFailed
from workbench.live.process.supervisor import WorkerOptions
from workbench.machine.loop import BlockingPool, loop_in_main, on_signal
from workbench.machine.preferences import preferences
from workbench.machine.software_vulkan import use_private_driver
from workbench.page.door.gated_server import GatedServer, ServerOptions, open_server
from workbench.page.door.listening_socket import ServerError
from workbench.start.recents import RecentTasks
from workbench.task.description import ShownPictures, TaskOptions
from workbench.task.reference import TaskName, named_file

CLOSING_SECONDS = 1.4
"""Closing is given up if no episode has been written for this time, because a disk may hang."""
_SAVING_SECONDS = 2.0
"""Maximum time for which closing waits for episodes that are being saved from the history."""
_Requests = queue.SimpleQueue[Callable[[], object] | int]
"""Queue of functions that the command calls in turn. An int in the queue ends the command with this exit
code."""


@loop_in_main
def open_in_terminal(
    task: str,
    options: TaskOptions,
    at: ServerOptions,
    worker: WorkerOptions,
    recordings: Path,
    history_bytes: int,
    trust: bool = False,
    editor: str = "",
    pictures: ShownPictures = "auto",
) -> int:
    """Serve the page of a task until the process ends. Returns an exit code if the server cannot start.

    Args:
        trust: whether code that recordings name runs without a question.
        editor: URL template that opens a line in the author's editor.
        pictures: how the page renders camera pictures.
    """
    gated_server = _start_server(at, "Workbench")
    if isinstance(gated_server, int):
        return gated_server
    requests = _Requests()
    waits_for_a_file = named_file(task) is not None
    shown = waits_for_a_file
    if shown:
        requests.put(partial(_print_address, gated_server))

    def on_event(event: Event) -> None:
        nonlocal shown
        print_event(event)
        # A broken file can be fixed and saved while its page is open. An env id that fails cannot be fixed on
        # the page, so the command ends.
        if not waits_for_a_file and isinstance(event, TaskFailed) and not event.kept:
            requests.put(1)
        elif not shown and isinstance(event, Loaded):
            shown = True
            requests.put(partial(_print_address, gated_server))

    how = _HowToOpen(recordings, worker, history_bytes, RecentTasks(), pictures)
    if waits_for_a_file:
        how.recents.add(task, options)
    session = how.open(task, options, on_event=on_event)
    app = _app(gated_server, how, _for_others(options), session, trust, editor=editor)
    _serve(gated_server, app, "live", f"{task}, {options.num_envs} envs", requests)


@loop_in_main
def start_in_terminal(
    options: TaskOptions,
    at: ServerOptions,
    worker: WorkerOptions,
    recordings: Path,
    history_bytes: int,
    trust: bool = False,
    editor: str = "",
) -> int:
    """Serve the page to choose a task from, until the process ends. Returns an exit code if the server cannot
    start.

    Args:
        options: options of the tasks that are opened from the page.
        trust: whether code runs without a question, as in `open_in_terminal`.
        editor: as in `open_in_terminal`.
    """
    gated_server = _start_server(at, "Workbench")
    if isinstance(gated_server, int):
        return gated_server
    how = _HowToOpen(recordings, worker, history_bytes, RecentTasks())
    app = _app(gated_server, how, options, None, trust, editor=editor)
    requests = _Requests()
    requests.put(partial(_print_address, gated_server))
    _serve(gated_server, app, "start", f"tasks in {Path.cwd()}", requests)


@loop_in_main
def review_in_terminal(
    folder: Path,
    tasks: tuple[Path, ...],
    at: ServerOptions,
    worker: WorkerOptions,
    base: TaskOptions,
    trust: bool = False,
    editor: str = "",
) -> int:
    """Serve the page of a folder of recordings until the process ends. Returns an exit code if the server
    cannot start.

    Args:
        worker, base: options of tasks that are opened from the page.
        trust: whether code that recordings name runs without a question.
        editor: URL template that opens a line in the author's editor.
    """
    gated_server = _start_server(at, "Recordings")
    if isinstance(gated_server, int):
        return gated_server
    how = _HowToOpen(folder, worker, HISTORY_BYTES, RecentTasks())
    app = _app(gated_server, how, base, None, trust, tasks, editor)
    requests = _Requests()
    requests.put(partial(_print_address, gated_server))
    _serve(gated_server, app, "review", f"recordings in {folder}", requests)


def _start_server(at: ServerOptions, label: str) -> GatedServer | int:
    """Start the server. Returns the server, or the exit code if it cannot start."""
    try:
        gated_server = open_server(at, label=label)
    except (ValueError, ServerError) as error:
        return refuse(str(error))
    use_private_driver()
    for line in (gated_server.warning, gated_server.notice):
        if line:
            warn(line)
    return gated_server


@dataclass(frozen=True)
class _HowToOpen:
    """Creates the sessions of this run."""

    recordings: Path
    worker: WorkerOptions
    history_bytes: int
    recents: RecentTasks
    pictures: ShownPictures = "auto"

    def open(
        self,
        task: TaskName,
        options: TaskOptions,
        kept: KeptWork | None = None,
        on_event: Callable[[Event], None] = print_event,
    ) -> Session:
        """Open a session of a task that a person chose; adds the task to the recent tasks once it is
        loaded."""
        noted: list[TaskOptions] = []

        def on_event_and_note(event: Event) -> None:
            on_event(event)
            if isinstance(event, Loaded):
                # Start the processes that read recordings only now: earlier, they would delay the load of the
                # task, for which the user waits.
                start_reading()
                made = replace(event.options or options, seed=0)
                if noted[-1:] != [made]:
                    noted.append(made)
                    self.recents.add(str(task), made)

        return self._session(task, options, self.worker, kept, on_event_and_note)

    def open_for_recording(self, task: TaskName, options: TaskOptions) -> Session:
        """Open a session for the task of a recording."""
        return self._session(task, options, WorkerOptions(self.worker.memory_limit), None, print_event)

    def _session(
        self,
        task: TaskName,
        options: TaskOptions,
        worker: WorkerOptions,
        kept: KeptWork | None,
        on_event: Callable[[Event], None],
    ) -> Session:
        callbacks = {"on_event": on_event, "on_line": print_line, "on_notice": warn}
        check = preferences().check_after_save
        given = {"history_bytes": self.history_bytes, "worker": worker, "kept": kept, "check": check}
        session = Session(task, options, recordings=self.recordings, **given, **callbacks)
        if kept is None:
            session.change(pictures=self.pictures)
        return session


def _for_others(options: TaskOptions) -> TaskOptions:
    """The options of one task, for use with other tasks. Of the keyword arguments, only `RUN_KEYWORDS` are
    kept: the others belong to the class of that task."""
    kwargs = {name: value for name, value in options.env_kwargs.items() if name in RUN_KEYWORDS}
    return replace(options, env_kwargs=kwargs)


def _app(
    gated_server: GatedServer,
    how: _HowToOpen,
    options: TaskOptions,
    session: Session | None,
    trust: bool,
    tasks: tuple[Path, ...] = (),
    editor: str = "",
) -> App:
    base = TaskOptions(rules=options.rules, imports=options.imports)
    return App(
        gated_server,
        how.recordings,
        how.open_for_recording,
        base,
        session,
        tasks,
        trust,
        warn,
        editor,
        Choices(how.recents, how.open, options),
    )


def _serve(
    gated_server: GatedServer,
    app: App,
    first: Which,
    what: str,
    requests: _Requests,
) -> NoReturn:
    renew = partial(requests.put, partial(_renew_token, gated_server))
    if gated_server.options.token:
        app.renew_token = renew
    # SIGUSR1, not SIGHUP: a terminal that is closed sends SIGHUP to end its processes.
    on_signal(signal.SIGUSR1, renew)
    for number in (signal.SIGINT, signal.SIGTERM):
        on_signal(number, partial(requests.put, 0))
    try:
        app.shared.pages.start(first)
        out.print(f"[bold]Workbench[/] {workbench.__version__}: {escape(what)}", soft_wrap=True)
        while not isinstance(request := requests.get(), int):
            request()
        code = request
    finally:
        out.print("closing")
        _close(app, gated_server)
    _exit(code)


def _close(app: App, gated_server: GatedServer) -> None:
    """Close everything. Gives up after `CLOSING_SECONDS` in which no episode was written."""
    app.finish_saving(_SAVING_SECONDS)
    closing = BlockingPool("closing").begin(app.close)
    written = _episodes_written(app)
    while not futures.wait([closing], CLOSING_SECONDS).done:
        if written == (written := _episodes_written(app)):
            warn("closing timed out; unfinished recordings are recovered at the next start")
            break
    gated_server.close()


def _episodes_written(app: App) -> int:
    return sum(session.episodes_written for session in app.shared.sessions)


def _renew_token(gated_server: GatedServer) -> None:
    if gated_server.options.token:
        gated_server.renew_token()
        print_text("  the token was renewed and every page was closed; open the new address:")
        print_addresses(gated_server.addresses())


def _print_address(gated_server: GatedServer) -> None:
    # Not with rich: it wraps the address in a narrow terminal.
    if gated_server.options.socket is not None:
        print_text(f"  socket  {gated_server.options.socket}")
        print_text(f"  first   {gated_server.ssh_hint}   on the machine with the browser")
        print_text(f"  page    {gated_server.url}   in that browser")
    else:
        print_addresses(gated_server.addresses())
        print_text(f"  remote  {gated_server.ssh_hint}")
    print_text("  Ctrl-C ends it.")


def _exit(code: int) -> NoReturn:
    """End the process. Everything must be closed and written."""
    # Skips the interpreter's shutdown, which takes a second after Ctrl-C, and several on a busy machine.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)

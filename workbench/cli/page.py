"""``workbench open`` and ``workbench review`` in a terminal: a page behind its door, until a signal ends it.

Both serve the same two pages, and differ in which comes first and in whether a task is open from the beginning.
"""

from __future__ import annotations

import os
import queue
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NoReturn

from rich.markup import escape

import workbench
from workbench.authoring.loading.reference import TaskName, named_file
from workbench.cli.terminal import out, print_event, print_line, refuse, say, say_addresses, warn
from workbench.jobs.task import TaskOptions
from workbench.machine.software_vulkan import use_private_driver
from workbench.recording.reader.reading import start_reading
from workbench.session.live.session import HISTORY_BYTES, Session
from workbench.session.process.supervisor import WorkerOptions
from workbench.session.protocol.messages import Event, Loaded, LoadFailed, Loading
from workbench.ui.app.workplace import Which, Workplace
from workbench.ui.server.gated_server import GatedServer, ServerOptions, open_server
from workbench.ui.server.listening import ServerError
from workbench.ui.widgets.hotkeys import Command


def open_in_terminal(
    task: str,
    options: TaskOptions,
    at: ServerOptions,
    worker: WorkerOptions,
    recordings: Path,
    history_bytes: int,
    trust: bool = False,
) -> int:
    """Serve the page of a task; returns only where the door cannot be opened.

    Args:
        trust: Run what recordings name without asking.
    """
    gated_server = _opened(at, "Workbench")
    if isinstance(gated_server, int):
        return gated_server
    end = _End()
    waits_for_a_file = named_file(task) is not None
    begun = 0
    if waits_for_a_file:
        end.show_address()

    def on_event(event: Event) -> None:
        nonlocal begun
        print_event(event)
        # A broken file is mended and saved; an env id that cannot be opened has nothing to wait for, and no page to go to.
        if not waits_for_a_file:
            if isinstance(event, LoadFailed) and not event.kept:
                end.now(1)
            elif isinstance(event, Loading):
                begun += 1
                if begun == 2:  # what is done first finds out whether the id is there
                    end.show_address()
        if isinstance(event, Loaded):
            # Not before: the task is what is waited for.
            start_reading()

    session = _session(task, options, recordings, worker, on_event, history_bytes)
    make_session = _opener(recordings, WorkerOptions(worker.memory_limit))
    base = TaskOptions(rules=options.rules, imports=options.imports)
    place = Workplace(gated_server, recordings, make_session, base, session, trust=trust, on_notice=warn)
    _serve(gated_server, place, "live", f"{task}, {options.num_envs} envs", end, session.close)


def review_in_terminal(
    folder: Path,
    tasks: tuple[Path, ...],
    at: ServerOptions,
    worker: WorkerOptions,
    base: TaskOptions,
    trust: bool = False,
) -> int:
    """Serve the page of a folder of recordings; returns only where the door cannot be opened.

    Args:
        worker, base: Of tasks that are opened from there.
        trust: Run what recordings name without asking.
    """
    gated_server = _opened(at, "Recordings")
    if isinstance(gated_server, int):
        return gated_server
    make_session = _opener(folder, worker)
    place = Workplace(gated_server, folder, make_session, base, tasks=tasks, trust=trust, on_notice=warn)
    end = _End()
    end.show_address()
    _serve(gated_server, place, "review", f"recordings in {folder}", end, lambda: None)


def _opened(at: ServerOptions, label: str) -> GatedServer | int:
    """The door, or the exit code where there is none."""
    try:
        gated_server = open_server(at, label=label)
    except (ValueError, ServerError) as error:
        return refuse(str(error))
    use_private_driver()
    for line in (gated_server.warning, gated_server.notice):
        if line:
            warn(line)
    return gated_server


def _session(
    task: TaskName,
    options: TaskOptions,
    recordings: Path,
    worker: WorkerOptions,
    on_event: Callable[[Event], None],
    history_bytes: int = HISTORY_BYTES,
) -> Session:
    said = {"on_event": on_event, "on_line": print_line, "on_notice": warn}
    return Session(task, options, recordings=recordings, history_bytes=history_bytes, worker=worker, **said)


def _opener(recordings: Path, worker: WorkerOptions) -> Callable[[TaskName, TaskOptions], Session]:
    """Opens the tasks that recordings name."""
    return lambda task, options: _session(task, options, recordings, worker, print_event)


def _serve(
    gated_server: GatedServer,
    place: Workplace,
    first: Which,
    what: str,
    end: _End,
    close_session: Callable[[], None],
) -> NoReturn:
    if gated_server.options.token:
        place.commands = (Command("Renew the token and close every page", end.renew),)
    end.at_signals()
    try:
        place.pages.start(first)
        out.print(f"[bold]Workbench[/] {workbench.__version__}: {escape(what)}", soft_wrap=True)
        end.wait(gated_server)
    finally:
        out.print("closing")
        place.close()
        close_session()
        gated_server.close()
    _leave(end.code)


_Asked = Literal["end", "renew", "show"]


class _End:
    """The end of a page: it comes from a signal or from an event, and with it the exit code."""

    def __init__(self) -> None:
        self.code = 0
        # A signal's handler may not take a lock that the main thread holds; putting into this queue takes none.
        self._asked: queue.SimpleQueue[_Asked] = queue.SimpleQueue()

    def now(self, code: int) -> None:
        self.code = code
        self._asked.put("end")

    def at_signals(self) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, frame: self._asked.put("end"))
        # Not SIGHUP, with which a terminal that is closed ends what runs in it.
        signal.signal(signal.SIGUSR1, lambda number, frame: self._asked.put("renew"))

    def renew(self) -> None:
        """Ask for another token. Returns at once."""
        self._asked.put("renew")

    def show_address(self) -> None:
        """Say where the page is. Returns at once."""
        self._asked.put("show")

    def wait(self, gated_server: GatedServer) -> None:
        """Return at the end; until then renew the token and say where the page is as often as that is asked for."""
        while (asked := self._next()) != "end":
            if asked == "show":
                _say_where(gated_server)
            if asked == "renew" and gated_server.options.token:
                gated_server.renew_token()
                say("  the token was renewed, and every page was closed; open the new address:")
                say_addresses(gated_server.addresses())

    def _next(self) -> _Asked | None:
        """What is asked for, or None after a while."""
        try:
            # Not for ever: the kernel may hand the signal to another thread, and the main one, which alone runs its
            # handler, would sleep on. So it does on a busy machine.
            return self._asked.get(timeout=0.2)
        except queue.Empty:
            return None


def _say_where(gated_server: GatedServer) -> None:
    # Not through rich, which would break the address in a narrow terminal.
    if gated_server.options.socket is not None:
        say(f"  socket  {gated_server.options.socket}")
        say(f"  first   {gated_server.ssh_hint}   on the machine with the browser")
        say(f"  page    {gated_server.url}   there")
    else:
        say_addresses(gated_server.addresses())
        say(f"  remote  {gated_server.ssh_hint}")
    say("  Ctrl-C ends it.")


def _leave(code: int) -> NoReturn:
    """End the process; all must be closed and written."""
    # The interpreter would now take its modules apart, one object after the other: a second of waiting after
    # Ctrl-C, and several on a machine that is at work.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)

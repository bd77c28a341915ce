"""``workbench open`` and ``workbench review`` in a terminal: a page behind its door, until a signal ends it.

Both serve the same two pages, and differ in which comes first and in whether a task is open from the beginning.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import NoReturn

from rich.markup import escape

import workbench
from workbench.authoring.reference import named_file
from workbench.machine.software_vulkan import use_private_driver
from workbench.session.kept_worker import WorkerOptions
from workbench.session.messages import Event, Failed, TaskOptions
from workbench.session.session import Session
from workbench.task_arguments import Rules
from workbench.terminal import out, print_event, print_line, refuse, warn
from workbench.ui.door import Door, DoorError, DoorOptions, open_door
from workbench.ui.pages import Which
from workbench.ui.put_together import Workplace
from workbench.ui.share_part import Sharing
from workbench.ui.step_in import offer_going_back_in


def open_in_terminal(
    task: str,
    options: TaskOptions,
    at: DoorOptions,
    worker: WorkerOptions,
    recordings: Path,
    history_bytes: int,
) -> int:
    """Serve the page of a task; returns only where the door cannot be opened."""
    door = _opened(at, "Workbench")
    if isinstance(door, int):
        return door
    end = _End()
    waits_for_a_file = named_file(task) is not None

    def on_event(event: Event) -> None:
        print_event(event)
        # A broken file is mended and saved; an env id that cannot be opened has nothing to wait for.
        if isinstance(event, Failed) and not event.kept and not waits_for_a_file:
            end.now(1)

    session = Session(
        task,
        options,
        recordings=recordings,
        history_bytes=history_bytes,
        worker=worker,
        on_event=on_event,
        on_line=print_line,
    )
    place = Workplace(door.server, recordings, session)
    what = f"{task}, {options.num_envs} envs"
    beside = WorkerOptions(worker.memory_limit)
    _serve(door, place, "live", what, recordings, beside, options.rules, end, session.close)


def review_in_terminal(
    folder: Path, tasks: tuple[Path, ...], at: DoorOptions, worker: WorkerOptions, rules: Rules
) -> int:
    """Serve the page of a folder of recordings; returns only where the door cannot be opened.

    Args:
        worker, rules: Of tasks that are opened from there.
    """
    door = _opened(at, "Recordings")
    if isinstance(door, int):
        return door
    place = Workplace(door.server, folder, tasks=tasks)
    _serve(door, place, "review", f"recordings in {folder}", folder, worker, rules, _End(), lambda: None)


def _opened(at: DoorOptions, label: str) -> Door | int:
    """The door, or the exit code where there is none."""
    try:
        door = open_door(at, label=label)
    except (ValueError, DoorError) as error:
        return refuse(str(error))
    use_private_driver()
    for line in (door.warning, door.notice):
        if line:
            warn(line)
    return door


def _serve(
    door: Door,
    place: Workplace,
    first: Which,
    what: str,
    recordings: Path,
    worker: WorkerOptions,
    rules: Rules,
    end: _End,
    close_session: Callable[[], None],
) -> NoReturn:
    def open_task(task: str, options: TaskOptions) -> Session:
        return Session(
            task, options, recordings=recordings, worker=worker, on_event=print_event, on_line=print_line
        )

    sharing = Sharing(door)
    place.offer(sharing.offer)
    close_others = offer_going_back_in(place, open_task, rules)
    end.at_signals()
    try:
        place.pages.start(first)
        _announce(door, what)
        end.wait()
    finally:
        out.print("closing")
        place.close()
        sharing.close()
        close_others()
        close_session()
        door.close()
    _leave(end.code)


class _End:
    """The end of a page: it comes from a signal or from an event, and with it the exit code."""

    def __init__(self) -> None:
        self.code = 0
        self._due = threading.Event()

    def now(self, code: int) -> None:
        self.code = code
        self._due.set()

    def at_signals(self) -> None:
        def on_signal(number: int, frame: FrameType | None) -> None:
            self._due.set()

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, on_signal)

    def wait(self) -> None:
        self._due.wait()


def _announce(door: Door, what: str) -> None:
    out.print(f"[bold]Workbench[/] {workbench.__version__}: {escape(what)}", soft_wrap=True)
    # Not through rich, which would break the address in a narrow terminal.
    print(f"  page    {door.url}", flush=True)
    print(f"  remote  {door.ssh_hint}", flush=True)
    print("  Ctrl-C ends it.", flush=True)


def _leave(code: int) -> NoReturn:
    """End the process; all must be closed and written."""
    # The interpreter would now take its modules apart, one object after the other: a second of waiting after
    # Ctrl-C, and several on a machine that is at work.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)

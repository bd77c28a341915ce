"""A worker that is always there: one process after the other, with a reason for each end.

The author's code may crash its process, exit it, or loop for ever, and the page must not care. One
thread starts a worker, greets it, hands on its events, and when it ends says why and starts the next.
Two things it will not do: start workers without end, when each dies before a task ever loads; and leave
a mended file waiting behind a worker that hangs, so a load that is not taken up in time ends the worker.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from workbench.session.messages import Event, Load, Loading, Request
from workbench.session.process import WorkerProcess, describe_exit

_LONGEST_SILENCE = 5.0
"""Seconds in which a worker must begin a load that it was sent."""
_MOST_DEATHS = 3
"""Workers that may die one after the other without a load in between."""


@dataclass(frozen=True)
class Death:
    """The end of a worker."""

    why: str | None
    """For example ``was killed by SIGSEGV``; None when it was replaced because somebody asked."""
    hung: bool
    """It was ended because it did not take up a load."""
    gives_up: bool
    """Too many died: the next is started only when `KeptWorker.replace` is called."""


class KeptWorker:
    """Requests go to whichever worker there is; `greet` tells each new one what the last one knew."""

    def __init__(
        self,
        greet: Callable[[], list[Request]],
        on_event: Callable[[Event], None],
        on_death: Callable[[Death], None],
        on_line: Callable[[str, str], None],
    ) -> None:
        """The callbacks are called on this object's threads, and may call `send` and `replace`."""
        self._greet, self._on_event, self._on_death, self._on_line = greet, on_event, on_death, on_line
        self._condition = threading.Condition()
        self._worker: WorkerProcess | None = None
        self._load_sent: float | None = None
        self._replace_asked = False
        self._closing = False
        self._deaths = 0
        self._thread = threading.Thread(target=self._run, name="session", daemon=True)

    def start(self) -> None:
        """Start the first worker, on a thread of its own."""
        self._thread.start()

    @property
    def pid(self) -> int | None:
        """Of the present worker; None between two."""
        with self._condition:
            return None if self._worker is None else self._worker.pid

    def send(self, request: Request) -> None:
        """To the present worker; between two it is lost, and `greet` must make up for it."""
        with self._condition:
            worker = self._worker
            if isinstance(request, Load) and self._load_sent is None:
                self._load_sent = time.monotonic()
        if worker is not None:
            worker.send(request)

    def replace(self) -> None:
        """End the worker, whatever it is doing, and start another."""
        with self._condition:
            self._replace_asked, self._deaths = True, 0
            worker = self._worker
            self._condition.notify_all()
        if worker is not None:
            worker.kill()

    def ran(self) -> None:
        """A task was loaded: earlier deaths are forgiven."""
        self._deaths = 0

    def stop(self) -> None:
        """End the worker for good; returns when the thread has ended."""
        with self._condition:
            self._closing = True
            worker = self._worker
            self._condition.notify_all()
        if worker is not None:
            worker.stop()
        self._thread.join()

    def _run(self) -> None:
        while True:
            worker = WorkerProcess(self._on_line)
            with self._condition:
                self._worker, self._load_sent, self._replace_asked = worker, None, False
                closing = self._closing
            if closing:
                worker.stop()
                return
            for request in self._greet():
                worker.send(request)
            hung = self._hand_on_events(worker)
            code = worker.exit_code()
            worker.stop(grace=0.0)
            with self._condition:
                self._worker = None
                if self._closing:
                    return
                asked = self._replace_asked
                self._deaths += 0 if asked or hung else 1
                gives_up = self._deaths >= _MOST_DEATHS
            why = f"did not answer for {_LONGEST_SILENCE:.0f} s" if hung else describe_exit(code)
            self._on_death(Death(None if asked else why, hung, gives_up))
            with self._condition:
                if gives_up:
                    self._condition.wait_for(lambda: self._replace_asked or self._closing)
                if self._closing:
                    return

    def _hand_on_events(self, worker: WorkerProcess) -> bool:
        """Until the worker is gone; True if it hung."""
        hung = False
        try:
            while True:
                event = worker.receive(timeout=1.0)
                if isinstance(event, Loading):
                    self._load_sent = None
                if event is not None:
                    self._on_event(event)
                elif self._load_sent is not None and time.monotonic() - self._load_sent > _LONGEST_SILENCE:
                    hung = True
                    worker.kill()
        except EOFError:
            return hung

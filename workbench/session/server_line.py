"""The worker's end of the line to the server: what is asked, in order, and what is told.

A server that is gone is an end like any other: nothing raises here, and `closed` says so. What is sent is sent whole,
whatever the person at the page interrupts meanwhile.
"""

from __future__ import annotations

from collections import deque
from multiprocessing.connection import Connection
from typing import get_args

from workbench.jobs.wire import Unpacker, Unreadable, pack_message
from workbench.session.interrupts import Interrupts
from workbench.session.messages import Event, Load, Request, is_a_step
from workbench.session.questions import QUESTIONS


class ServerLine:
    """See the module's text."""

    def __init__(self, connection: Connection, interrupts: Interrupts) -> None:
        self._connection, self._interrupts = connection, interrupts
        self._unpacker = Unpacker(get_args(Request), QUESTIONS)
        self._queue: deque[Request] = deque()
        """What has come and was not carried out."""
        self.closed = False
        """The server hung up."""

    def listen(self, timeout: float) -> None:
        """Wait so many seconds for requests, and queue what has come."""
        self._queue.extend(self._requests(timeout))

    def next(self) -> Request | None:
        """The next request that is queued."""
        return self._queue.popleft() if self._queue else None

    def waits(self) -> bool:
        """Whether something has come that is not even queued."""
        return self._connection.poll(0)

    def send(self, event: Event) -> None:
        try:
            with self._interrupts.shielded():
                self._connection.send_bytes(pack_message(event))
        except (BrokenPipeError, OSError):
            self.closed = True

    def drop_steps(self) -> None:
        """What was pressed while a hook hung is not to make it hang again. Before the page is told of the
        interrupt: what is pressed after that is meant."""
        with self._interrupts.shielded():
            waiting = [*self._queue, *self._requests(0.0)]
            self._queue = deque(request for request in waiting if not is_a_step(request))

    def _requests(self, timeout: float) -> list[Request]:
        """What has come; of several loads only the last, since each replaces the one before."""
        requests: list[Request] = []
        try:
            while self._connection.poll(timeout if not requests else 0):
                requests.append(self._unpacker.message(self._connection.recv_bytes()))
        except Unreadable:
            raise  # the server is believed: what it sent and cannot be read is a fault of ours
        except (EOFError, OSError):
            self.closed = True
        loads = [request for request in requests if isinstance(request, Load)]
        return [request for request in requests if not isinstance(request, Load) or request is loads[-1]]

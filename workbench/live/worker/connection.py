"""The worker's connection to the server."""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Sequence
from typing import get_args

from workbench.live.messages import Event, Load, Request, without_steps
from workbench.live.process.heartbeat import Interrupts
from workbench.machine.processes.wire import MessageSocket, Unreadable


class ServerConnection:
    """The connection to the server: receives requests in order and sends events. If the server has ended, no
    method raises, and `closed` becomes True. An interrupt never cuts a message in two."""

    def __init__(self, connection: int, interrupts: Interrupts, questions: Sequence[type]) -> None:
        """
        Args:
            connection: file descriptor of the socket.
            questions: all types that a `Call` may contain.
        """
        self._line = MessageSocket(socket.socket(fileno=connection), get_args(Request), questions)
        self._interrupts = interrupts
        self._queue: deque[Request] = deque()
        """Received requests that are not handled yet."""
        self.closed = False
        """Whether the server closed the connection."""

    def listen(self, timeout: float) -> None:
        """Wait at most `timeout` seconds for requests, and queue them."""
        self._queue.extend(self._requests(timeout))

    def next(self) -> Request | None:
        """The next queued request; None if there is none."""
        return self._queue.popleft() if self._queue else None

    def waits(self) -> bool:
        """Whether a request has arrived that is not queued yet."""
        return self._line.waits()

    def send(self, event: Event) -> None:
        try:
            with self._interrupts.shielded():
                self._line.send(event)
        except OSError:
            self.closed = True

    def drop_steps(self) -> None:
        """Drop waiting control steps: they were requested while a hook hung, and would make it hang again.
        Call this before the interrupt is reported to the page: steps that the user requests after the report
        must be kept."""
        with self._interrupts.shielded():
            waiting = [*self._queue, *self._requests(0.0)]
            self._queue = deque(without_steps(waiting))

    def _requests(self, timeout: float) -> list[Request]:
        """New requests; of several loads only the last, since each replaces the previous one."""
        requests: list[Request] = []
        try:
            while (request := self._line.receive(0.0 if requests else timeout)) is not None:
                requests.append(request)
        except Unreadable:
            raise  # the server is trusted: an unreadable request is a bug of the workbench
        except EOFError:
            self.closed = True
        loads = [request for request in requests if isinstance(request, Load)]
        return [request for request in requests if not isinstance(request, Load) or request is loads[-1]]

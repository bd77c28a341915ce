"""The worker's end of its connection: which requests wait, and what remains of them after an interrupt."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from workbench.live.messages import Load, Play, Request, Reset, SingleStep, Status
from workbench.live.process.heartbeat import Interrupts
from workbench.live.worker.connection import ServerConnection
from workbench.machine.processes.wire import MessageSocket
from workbench.task.description import TaskOptions


@dataclass
class Line:
    """A worker's connection and the server's end of it."""

    worker: ServerConnection
    server: MessageSocket

    def handled(self) -> list[Request]:
        """The requests that the worker handles now, in order."""
        self.worker.listen(0.0)
        found: list[Request] = []
        while (request := self.worker.next()) is not None:
            found.append(request)
        return found


@pytest.fixture
def line() -> Iterator[Line]:
    ours, theirs = socket.socketpair()
    server = MessageSocket(ours, (Status,))
    yield Line(ServerConnection(theirs.detach(), Interrupts(), ()), server)
    ours.close()


def load(number: int) -> Load:
    return Load("push.py", TaskOptions(1), number=number)


def test_requests_are_handled_in_order_and_only_the_last_load(line: Line) -> None:
    assert line.handled() == [] and not line.worker.waits()
    for request in (Reset((1,), 7), load(1), SingleStep(), load(2), Play(True, 3)):
        line.server.send(request)
    assert line.worker.waits()
    assert line.handled() == [Reset((1,), 7), SingleStep(), load(2), Play(True, 3)]
    line.server.send(load(3))
    assert line.handled() == [load(3)] and not line.worker.closed


def test_steps_that_wait_while_a_hook_hangs_are_dropped_and_the_rest_is_kept(line: Line) -> None:
    line.server.send(Reset((0,)))
    line.server.send(SingleStep())
    line.worker.listen(0.0)
    for request in (Play(True, 4), Play(False, 5), Reset((1,))):
        line.server.send(request)
    line.worker.drop_steps()
    assert line.handled() == [Reset((0,)), Play(False), Play(False, 5), Reset((1,))]
    line.server.send(SingleStep())
    assert line.handled() == [SingleStep()], "steps of after the interrupt count"


def test_events_arrive_until_the_server_has_ended(line: Line) -> None:
    line.worker.send(Status(True, 20.0, 1.0))
    assert line.server.receive(1.0) == Status(True, 20.0, 1.0)
    line.server.send(SingleStep())
    line.server.end.close()
    assert line.handled() == [SingleStep()] and line.worker.closed
    line.worker.send(Status(False, 0.0, 0.0))


def test_a_send_to_a_server_that_has_ended_closes_the_connection(line: Line) -> None:
    line.server.end.close()
    line.worker.send(Status(False, 0.0, 0.0))
    assert line.worker.closed

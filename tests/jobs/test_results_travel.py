"""Every type of result and progress that workers send reaches the scheduler unchanged, through a real socket."""

from __future__ import annotations

import dataclasses
import socket
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec import convert, inspect

from tests.drive.messages import of_schema, same
from workbench.checks.job_items import CheckUpdate, ItemOutcome
from workbench.checks.results import RuleResult, Seen
from workbench.checks.run_rules import as_sent
from workbench.jobs.scheduler import Scheduler, Work
from workbench.jobs.worker_messages import MESSAGES, Listener, Message, WorkerQueue
from workbench.machine.processes.wire import MessageSocket, Unreadable
from workbench.planning.seeds_report import SolveReport
from workbench.record.job_worker import RecordUpdate, Written
from workbench.rescore.job import RescoredRecording, RescoreUpdate

pytestmark = pytest.mark.thorough

KINDS = (
    ItemOutcome,
    CheckUpdate,
    RuleResult,
    Written,
    RecordUpdate,
    RescoredRecording,
    RescoreUpdate,
    SolveReport,
)


class SocketQueue(WorkerQueue):
    """The queue of a worker at the other end of a socket."""

    def __init__(self, line: MessageSocket) -> None:
        self._line = line

    def next(self) -> None: ...

    def limit(self) -> int:
        return 1

    def send(self, message: Message) -> None:
        self._line.send(message)


def sent(kind: Any, value: Any) -> list[Any]:
    """Send a result and an update; returns what the scheduler receives."""
    ours, theirs = (MessageSocket(end, MESSAGES) for end in socket.socketpair())
    received: list[Any] = []
    scheduler: Scheduler[Any, Any] = Scheduler(
        [0], lambda number, result: received.append(result), received.append
    )
    listener = Listener("a worker", Work(print, None, kind, kind, "x"), scheduler, print)
    scheduler.next("worker")
    queue = SocketQueue(theirs)
    with ours.end, theirs.end:
        for send in (queue.send_update, lambda value: queue.send_result(0, value)):
            send(value)
            message = ours.receive(5)
            assert message is not None and listener.take("worker", message) == "goes on"
    return received


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@settings(max_examples=20, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(st.data())
def test_each_result_arrives_as_it_was_sent(kind: type, data: st.DataObject) -> None:
    made = data.draw(of_schema(inspect.type_info(kind), 0.0))
    value = convert(made, kind, strict=False, dec_hook=lambda to, of: to(of.decode("latin1")) if isinstance(of, bytes) else of)  # fmt: skip
    for one in sent(kind, value):
        assert same(one, value)


def test_numpy_numbers_are_accepted_and_wrong_types_are_refused_by_the_sender() -> None:
    seen = Seen(tried=np.int64(3), size=np.float32(0.5), numbers=(np.float64(2.0),))  # type: ignore[arg-type]
    (row,) = as_sent(RuleResult("runs", "kept", seen=(seen,))).seen
    assert (row.tried, row.size, row.numbers) == (3, 0.5, (2.0,)) and type(row.tried) is int
    for wrong in (dataclasses.replace(seen, count=True), dataclasses.replace(seen, texts=(1,))):
        with pytest.raises(Unreadable):
            as_sent(RuleResult("runs", "kept", seen=(wrong,)))

"""How a worker's end is told, and the broker between the workers of a cluster and the dealing process."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from workbench.jobs.ray_cluster import MessageBroker
from workbench.jobs.scheduler import NO_LIMIT, Chunk, ItemQueue, PoolError, Scheduler, Work
from workbench.jobs.worker_messages import (
    ChunkRequest,
    ItemResult,
    Listener,
    Message,
    WorkerEnded,
    WorkerQueue,
    work_on,
)
from workbench.task.problem import Problem, TaskError

PROBLEM = Problem("step", "it broke", "/copy/task.py", 3, "1 / 0", 'File "/copy/task.py"')
WORK: Work[Any, int, str] = Work(lambda setup, queue: None, None, int, str, "that squares")


class Sent(WorkerQueue):
    """Collects the messages of a worker whose files are a copy of ``/mine``."""

    origin = {"/copy": "/mine"}

    def __init__(self) -> None:
        self.sent: list[Message] = []

    def next(self) -> None: ...

    def limit(self) -> int:
        return 1

    def send(self, message: Message) -> None:
        self.sent.append(message)


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (None, ""),
        (ValueError("wrong /copy/a.npy"), "wrong /mine/a.npy"),
        (OSError(), "OSError"),
        (RuntimeError("it is full"), "it is full"),
    ],
)
def test_the_end_of_a_worker_names_the_files_of_the_submitting_side(
    error: Exception | None, why: str
) -> None:
    def run(setup: None, queue: ItemQueue) -> None:
        if error is not None:
            raise error

    queue = Sent()
    work_on(run, None, queue)
    assert queue.sent == [WorkerEnded(why)]
    listener = Listener("a worker", WORK, Scheduler[int, str]([], print), print)
    if why:
        with pytest.raises(PoolError, match=why):
            listener.take("w", queue.sent[0])
    else:
        assert listener.take("w", queue.sent[0]) == "done"


def test_the_authors_error_fails_its_chunk_and_the_job_goes_on() -> None:
    def run(setup: None, queue: ItemQueue) -> None:
        raise TaskError(PROBLEM)

    queue, failures = Sent(), list[Any]()
    work_on(run, None, queue)
    scheduler = Scheduler[int, str](range(2), print, on_failure=failures.append)
    scheduler.next("w")
    assert Listener("a worker", WORK, scheduler, print).take("w", queue.sent[0]) == "failed"
    (failure,) = failures
    assert failure.numbers == (0,) and failure.problem.file == "/mine/task.py"
    assert "/copy" not in failure.problem.traceback
    with pytest.raises(KeyError):  # a fault of our own is not the author's
        work_on(lambda setup, queue: {}["x"], None, Sent())


def test_a_death_is_reported_while_the_job_goes_on() -> None:
    reports: list[str] = []
    scheduler = Scheduler[int, str](range(4), print, tries=3)
    listener = Listener("a worker", WORK, scheduler, reports.append)
    scheduler.next("w")
    listener.died("w", "was killed", -9)
    assert len(reports) == 1 and "a worker that squares was killed" in reports[0]
    assert listener.take("w", ChunkRequest()) == "asks" and scheduler.next("w") is not None
    queue = Sent()
    queue.send_result(1, 4)
    assert listener.take("w", queue.sent[0]) == "goes on"
    with pytest.raises(PoolError, match="a worker that squares .* not given"):
        listener.take("w", ItemResult(3, b"\0\0\0\1\3"))
    scheduler.lower(0)
    listener.died("w", "was killed", -9)
    assert len(reports) == 1, "the job is over"


def test_the_broker_keeps_messages_and_answers_each_worker_with_its_own_chunk() -> None:
    chunks = [Chunk((number,), frozenset({number})) for number in range(2)]

    async def talk() -> None:
        broker = MessageBroker()
        assert await broker.take(0.0) == [] and await broker.take(0.001) == []
        assert await broker.put(0, [b"a", b"b"]) == NO_LIMIT
        asks = [asyncio.ensure_future(broker.ask(number, [b"c%d" % number])) for number in (0, 1)]
        await asyncio.sleep(0)
        assert await broker.take(60.0) == [(0, b"a"), (0, b"b"), (0, b"c0"), (1, b"c1")]
        assert await broker.take(0.0) == [] and not any(one.done() for one in asks)
        await broker.set_limit(7)
        await broker.answer(1, chunks[1])
        assert await asks[1] == (chunks[1], 7) and not asks[0].done()
        await broker.answer(0, None)
        await broker.answer(5, chunks[0])  # of a worker that is gone
        assert await asks[0] == (None, 7) and await broker.put(0, []) == 7
        waiting = asyncio.ensure_future(broker.take(60.0))
        await asyncio.sleep(0)
        await broker.put(1, [b"d"])
        assert await waiting == [(1, b"d")]

    asyncio.run(asyncio.wait_for(talk(), 30))


def test_a_worker_of_a_cluster_sees_paths_of_its_own_copy() -> None:
    queue = Sent()
    queue.send_update(Path("/copy/sub/a.py"))
    queue.send_result(0, {"/copy/x": ["at /copy/y", 3]})
    texts = [message.value for message in queue.sent if not isinstance(message, ChunkRequest | WorkerEnded)]
    assert all(b"/mine" in text and b"/copy" not in text for text in texts)

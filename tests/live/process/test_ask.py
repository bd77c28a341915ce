"""Questions to a worker: each gets its own answer, and a process's messages are trusted as little as a task."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from queue import Queue
from typing import Any

import psutil
import pytest

from tests.drive.waiting import TIMEOUT_SECONDS, until
from tests.live.hazards import calm, provoke, provoked, write_task
from workbench.cameras.questions import MeasureCamera
from workbench.live.messages import Answer, Load, Progress, Request, Reset
from workbench.live.process import ask as askers
from workbench.live.process.ask import Background, OnProgress, Priority, QuestionClient
from workbench.live.process.background_jobs import Job, JobFailed, ProcessDied
from workbench.live.questions_without_task import MakeScene
from workbench.machine import loop
from workbench.machine.loop import do
from workbench.machine.processes.wire import Call, Question, pack
from workbench.task.description import TaskOptions
from workbench.task.problem import Problem

Work = Callable[[], Awaitable[Any]]
BASE = ("sensor", "base_camera")
PROBLEM = Problem("step", "it broke", None, None, None, "")


def question(env: int) -> MeasureCamera:
    return MeasureCamera(BASE, None, env)


class Line:
    """A connection that queues the requests to a worker."""

    def __init__(self) -> None:
        self.calls: Queue[Call] = Queue()
        self.asker = QuestionClient(self.send)

    def send(self, request: Request) -> None:
        assert isinstance(request, Call)
        self.calls.put(request)

    def next(self) -> int:
        return self.calls.get(timeout=TIMEOUT_SECONDS).number

    def take(self, event: Answer | Progress) -> None:
        do(lambda: self.asker.take(event))

    def ask(self, question: Question[Any], on_progress: OnProgress = lambda *at: None) -> Future[Any]:
        return start(self.asker.ask(question, on_progress))


def start(work: Coroutine[Any, Any, Any]) -> Future[Any]:
    """Start this coroutine on the loop; cancelling the future cancels it, as stopping a job does."""
    made: Future[Any] = Future()

    def begin() -> None:
        task = loop.begin(work)
        made.add_done_callback(lambda made: made.cancelled() and do(task.cancel))

        def tell(task: Any) -> None:
            if not made.cancelled():
                made.set_exception(error) if (error := task.exception()) else made.set_result(task.result())

        task.add_done_callback(tell)

    do(begin)
    return made


def test_concurrent_questions_each_get_their_own_answer_in_any_order() -> None:
    line = Line()
    asked = [line.ask(Reset((env,), env)) for env in range(2)]
    calls: list[Any] = [line.calls.get(timeout=TIMEOUT_SECONDS) for _ in range(2)]
    line.take(Answer(99, why="nobody's"))
    for call in reversed(calls):
        line.take(Answer(call.number, why=f"env {call.request.env_idx[0]}"))
    for env, future in enumerate(asked):
        with pytest.raises(JobFailed, match=f"env {env}"):
            future.result(timeout=TIMEOUT_SECONDS)


def test_progress_arrives_in_order_before_the_answer_and_a_failed_answer_has_its_problem() -> None:
    line, progress = Line(), list[tuple[int, int, Any]]()
    scene = MakeScene("PushCube-v1", (), {}, 0, {}, {})
    asked = line.ask(scene, lambda *at: progress.append(at))
    number = line.next()
    for done in range(3):
        line.take(Progress(number, done, 3, pack(f"state {done}")))
    line.take(Answer(number, why="no such camera", problem=PROBLEM))
    with pytest.raises(JobFailed, match="no such camera") as failed:
        asked.result(timeout=TIMEOUT_SECONDS)
    assert failed.value.problem is PROBLEM and progress == [(done, 3, f"state {done}") for done in range(3)]
    asked = line.ask(question(0))
    line.take(Answer(line.next(), pack(("no", "report"))))
    with pytest.raises(JobFailed, match="unreadable"):
        asked.result(timeout=TIMEOUT_SECONDS)


def test_a_cancelled_question_ends_and_its_late_answer_is_ignored() -> None:
    line = Line()
    asked = line.ask(question(0))
    number = line.next()
    assert asked.cancel()
    line.take(Answer(number, why="late"))
    again = line.ask(question(1))
    second = line.next()
    assert second != number
    line.take(Answer(second, why="mine"))
    with pytest.raises(JobFailed, match="mine"):
        again.result(timeout=TIMEOUT_SECONDS)


# --- the background process ---------------------------------------------------------------------------


def load_of(folder: Path, num_envs: int = 1) -> Load:
    return Load(str(write_task(folder)), TaskOptions(num_envs, env_kwargs={"render_backend": "none"}))


@pytest.fixture
def background(child_process: None) -> Iterator[Background]:
    process = Background()
    yield process
    process.close()


def in_turns(background: Background, job: Job, work: Work, priority: Priority = "person") -> Future[Any]:
    """Start work that takes turns with other jobs."""
    return start(background.in_turns(job, work, priority))


@pytest.mark.parametrize("what", ["garbage", pytest.param("half", marks=pytest.mark.slow)])
def test_garbage_from_a_process_ends_its_job_and_the_next_job_gets_a_new_process(
    background: Background, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    monkeypatch.setattr(askers, "LOAD_CANCEL_TIMEOUT_SECONDS", 1.0)
    job, load = Job("rescoring"), load_of(tmp_path)
    file = Path(str(load.task))
    provoke(file, "import", what)
    asked = in_turns(background, job, lambda: background.ensure(job, load))
    until(lambda: provoked(file), "the hazard")
    pid = background.pid
    if what == "half":
        # The process hangs in the middle of a message: stopping the job still works and ends the process.
        assert asked.cancel()
    else:
        with pytest.raises(JobFailed):
            asked.result(timeout=TIMEOUT_SECONDS)
    until(lambda: not (pid and psutil.pid_exists(pid)), "its end")
    calm(file)
    in_turns(background, job, lambda: background.ensure(job, load)).result(timeout=TIMEOUT_SECONDS)
    assert background.pid is not None


def test_a_version_is_loaded_once_and_again_after_a_death_or_failure(
    background: Background, tmp_path: Path
) -> None:
    (tmp_path / "other").mkdir()
    job, load = Job("rescoring"), load_of(tmp_path, 2)
    steps = list[str]()
    job.report = lambda done, total, what="": steps.append(what)  # type: ignore[method-assign]

    async def work() -> int | None:
        assert await background.ensure(job, load) == 2 and len(steps) == 2
        assert await background.ensure(job, load) == 2 and len(steps) == 2, "it is already loaded"
        assert (await background.ask(Reset((1,), 7))).poses.shape[0] == 2
        with pytest.raises(JobFailed, match="nothing"):
            await background.ask(MeasureCamera(("human", "nothing"), None, 0))
        first = background.pid
        assert first is not None
        assert psutil.Process(first).nice() > psutil.Process().nice(), "the playing worker has priority"
        os.kill(first, signal.SIGKILL)
        with pytest.raises(ProcessDied, match="SIGKILL"):
            await background.ask(Reset((1,), 7))
        return first

    async def again(first: int | None) -> None:
        assert await background.ensure(job, load) == 2 and background.pid not in (None, first)
        # A failed load leaves the last version open, and `or_else` is tried if given.
        provoke(Path(str(load.task)), "build", "ctrl_c")
        with pytest.raises(JobFailed) as failed:
            await background.ensure(job, replace(load, level="rebuilt"))
        assert failed.value.problem is not None and background.num_envs == 2
        other = load_of(tmp_path / "other")
        assert await background.ensure(job, replace(load, level="rebuilt"), or_else=other) == 1

    first = in_turns(background, job, work).result(timeout=TIMEOUT_SECONDS)
    in_turns(background, job, lambda: again(first)).result(timeout=TIMEOUT_SECONDS)


@pytest.mark.parametrize("aside", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_newest_job_goes_first_and_an_interrupted_one_is_repeated(
    background: Background, tmp_path: Path, aside: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(askers, "CANCEL_TIMEOUT_SECONDS", TIMEOUT_SECONDS)  # also on a busy machine
    load = load_of(tmp_path)
    done, under_way, seen = list[str](), threading.Event(), threading.Event()
    pids = set[int | None]()

    async def side_work(job: Job) -> None:
        done.append("begins")
        await background.ensure(job, load)
        pids.add(background.pid)
        while not seen.is_set():
            await background.ask(Reset((0,), 1))
            under_way.set()
        done.append("ends")

    async def foreground_work(job: Job) -> None:
        await background.ensure(job, load)
        await background.ask(Reset((0,), 2))
        pids.add(background.pid)
        done.append("answered")
        seen.set()

    # A low-priority job also gives way to jobs that were started before it.
    one, other = Job("one"), Job("other")
    job, waiting = (other, one) if aside else (one, other)
    steps = list[str]()
    job.report = lambda done, total, what="": steps.append(what)  # type: ignore[method-assign]
    # It would run forever if it did not give way.
    side = in_turns(background, job, lambda: side_work(job), "low" if aside else "person")
    assert under_way.wait(TIMEOUT_SECONDS)
    in_turns(background, waiting, lambda: foreground_work(waiting)).result(TIMEOUT_SECONDS)
    side.result(TIMEOUT_SECONDS)
    assert done == ["begins", "answered", "begins", "ends"] and steps[-1] == askers.WAITING
    assert len(pids) == 1, "the interrupted question was answered in time, and its process goes on"


def test_two_jobs_stopped_at_once_free_the_process_for_the_next(background: Background) -> None:
    async def forever() -> None:
        await asyncio.Event().wait()

    async def at_once() -> str:
        return "done"

    tasks = do(lambda: [loop.begin(background.in_turns(Job(name), forever)) for name in ("one", "other")])
    do(lambda: None)  # one has the process, the other waits for it

    def stop() -> None:
        # A save stops two jobs like this: neither has ended when the other is stopped.
        for task in tasks:
            task.cancel()

    do(stop)
    until(lambda: all(task.done() for task in tasks), "their end")
    assert all(task.cancelled() for task in tasks)
    assert in_turns(background, Job("next"), at_once).result(TIMEOUT_SECONDS) == "done"


@pytest.mark.slow
def test_a_dead_process_fails_only_its_own_job_and_the_queue_goes_on_with_a_new_one(
    background: Background, tmp_path: Path
) -> None:
    load = load_of(tmp_path)
    pids, has_it, done = list[int | None](), threading.Event(), list[str]()
    killed = do(asyncio.Event)

    async def work(job: Job, waits: bool = False) -> None:
        await background.ensure(job, load)
        pids.append(background.pid)
        has_it.set()
        if waits:
            await killed.wait()
        await background.ask(Reset((0,), 1))
        done.append("person")

    async def nothing() -> None:
        done.append("low")

    stopped, before, aside, last = (Job("one of four") for _ in range(4))
    fails = in_turns(background, last, lambda: work(last, waits=True))
    assert has_it.wait(TIMEOUT_SECONDS)
    low = in_turns(background, aside, nothing, "low")
    queue = in_turns(background, before, lambda: work(before))
    given_up = in_turns(background, stopped, lambda: work(stopped))
    assert given_up.cancel(), "while another has its turn"
    os.kill(pids[0] or 0, signal.SIGKILL)
    do(killed.set)
    with pytest.raises(ProcessDied, match="SIGKILL"):
        fails.result(timeout=TIMEOUT_SECONDS)
    queue.result(timeout=TIMEOUT_SECONDS)
    low.result(timeout=TIMEOUT_SECONDS)
    assert done == ["person", "low"] and pids[1] == background.pid not in (None, pids[0])


@pytest.mark.slow
def test_an_idle_process_is_ended_and_one_in_use_is_not(
    background: Background, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load, job = load_of(tmp_path), Job("rescoring")
    in_turns(background, job, lambda: background.ensure(job, load)).result(TIMEOUT_SECONDS)
    monkeypatch.setattr(askers, "IDLE_SECONDS", 0.0)
    first = background.pid
    assert first is not None, "it is kept for the next job"

    async def look() -> None:
        assert background.has_loaded(load) and background.pid == first

    in_turns(background, job, look).result(TIMEOUT_SECONDS)
    until(lambda: background.pid is None, "its end")
    assert not psutil.pid_exists(first)


def test_a_long_question_outside_a_turn_is_not_idle_time(
    background: Background, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(askers, "IDLE_SECONDS", 0.01)
    load, job = load_of(tmp_path), Job("rescoring")

    async def work() -> int:
        await background.ensure(job, load)
        return await background.ensure(job, replace(load, level="rebuilt"))

    assert start(work()).result(TIMEOUT_SECONDS) == 1

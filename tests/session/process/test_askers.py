"""Who asks a worker: each question has its own answer, and what a process sends is believed as little as a task is."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from queue import Queue
from typing import Any

import psutil
import pytest

from tests.drive.waiting import until
from tests.session.hazards import calm, provoke, provoked, write_task
from workbench.authoring.problem import Problem
from workbench.jobs.task import TaskOptions
from workbench.machine.processes.wire import Call, pack
from workbench.session.process.askers import Asker, Background
from workbench.session.process.job_lane import Job, JobFailed, JobLane, Stopped
from workbench.session.protocol.messages import Answer, Load, Progress, Request, Reset
from workbench.session.protocol.questions import MakeScene, MeasureCamera

BASE = ("sensor", "base_camera")
PROBLEM = Problem("step", "it broke", None, None, None, "")


def go_on() -> None:
    """Nobody stops it."""


def question(env: int) -> MeasureCamera:
    return MeasureCamera(BASE, None, env)


class Line:
    """What a worker was sent."""

    def __init__(self) -> None:
        self.calls: Queue[Call] = Queue()

    def send(self, request: Request) -> None:
        assert isinstance(request, Call)
        self.calls.put(request)


def test_two_that_ask_at_once_each_hear_their_own_whatever_comes_first() -> None:
    line = Line()
    asker = Asker(line.send)
    with ThreadPoolExecutor(2) as threads:
        asked = [threads.submit(asker.ask, go_on, Reset((env,), env)) for env in range(2)]
        calls = [line.calls.get(timeout=10) for _ in range(2)]
        asker.take(Answer(99, why="nobody's"))
        for call in reversed(calls):
            asker.take(Answer(call.number, why=f"env {call.request.env_idx[0]}"))  # type: ignore[attr-defined]
        for env, future in enumerate(asked):
            with pytest.raises(JobFailed, match=f"env {env}"):
                future.result(timeout=10)


def test_progress_comes_in_order_before_the_answer_and_an_answer_brings_its_problem() -> None:
    line, heard = Line(), list[tuple[int, int, Any]]()
    asker, scene = Asker(line.send), MakeScene("PushCube-v1", (), {}, 0, {}, {})
    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(asker.ask, go_on, scene, lambda *at: heard.append(at))
        number = line.calls.get(timeout=10).number
        for done in range(3):
            asker.take(Progress(number, done, 3, pack(f"state {done}")))
        asker.take(Answer(number, why="no such camera", problem=PROBLEM))
        with pytest.raises(JobFailed, match="no such camera") as failed:
            asked.result(timeout=10)
    assert failed.value.problem is PROBLEM
    assert heard == [(done, 3, f"state {done}") for done in range(3)]


def test_an_answer_of_another_kind_is_none() -> None:
    line = Line()
    asker = Asker(line.send)
    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(asker.ask, go_on, question(0))
        asker.take(Answer(line.calls.get(timeout=10).number, pack(("no", "report"))))
        with pytest.raises(JobFailed, match="answered with unreadable data"):
            asked.result(timeout=10)


def test_who_is_told_to_stop_waits_no_longer_and_a_late_answer_is_nobody_s() -> None:
    line, stopped = Line(), threading.Event()
    asker = Asker(line.send)

    def check() -> None:
        if stopped.is_set():
            raise Stopped

    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(asker.ask, check, question(0))
        number = line.calls.get(timeout=10).number
        stopped.set()
        with pytest.raises(Stopped):
            asked.result(timeout=10)
        asker.take(Answer(number, why="late"))
        again = threads.submit(asker.ask, go_on, question(1))
        assert (second := line.calls.get(timeout=10).number) != number
        asker.take(Answer(second, why="mine"))
        with pytest.raises(JobFailed, match="mine"):
            again.result(timeout=10)


def a_job() -> Job:
    return Job(JobLane("test", go_on, lambda job, failure: None), "rescoring", lambda job: None)


@pytest.fixture
def background(child_process: None) -> Iterator[Background]:
    process = Background()
    yield process
    process.end()


@pytest.mark.parametrize("what", ["garbage", pytest.param("half", marks=pytest.mark.slow)])
def test_a_process_that_sends_garbage_ends_its_job_and_the_next_can_have_another(
    background: Background, tmp_path: Path, what: str
) -> None:
    file = write_task(tmp_path)
    provoke(file, "import", what)
    job, load = a_job(), Load(str(file), TaskOptions(num_envs=1))
    pids = list[int | None]()

    def ensure() -> None:
        with background.turn(job):
            background.ensure(job, load)

    if what == "half":
        # It hangs in the middle of a message: that is no end, and a job that is stopped must get out all the same.
        with ThreadPoolExecutor(1) as threads:
            asked = threads.submit(ensure)
            until(lambda: provoked(file), "it hangs in the middle of a message")
            pids.append(background.pid)
            job.stopped = True
            with pytest.raises(Stopped):
                asked.result(timeout=30)
    else:
        with pytest.raises(JobFailed, match="the process in the background sent unreadable data"):
            ensure()
    assert background.pid is None and not any(pid is not None and psutil.pid_exists(pid) for pid in pids)
    calm(file)
    job.stopped = False
    ensure()
    assert background.pid is not None


@pytest.mark.slow
def test_what_is_loaded_is_loaded_once_and_a_process_that_dies_ends_only_the_job_that_asked(
    background: Background, tmp_path: Path
) -> None:
    (tmp_path / "other").mkdir()
    file, job = write_task(tmp_path), a_job()
    load = Load(str(file), TaskOptions(num_envs=2, env_kwargs={"render_backend": "none"}))
    told = list[str]()
    job.report = lambda done, total, what="": told.append(what)  # type: ignore[method-assign]
    with background.turn(job):
        assert background.ensure(job, load) == 2
        assert told == ["starting a process in the background", "building envs in the background"]
        assert background.ensure(job, load) == 2 and len(told) == 2, "it is there already"
        step = background.ask(job.check, Reset((1,), 7))
        assert step.poses.shape[0] == 2
        with pytest.raises(JobFailed, match="no human camera 'nothing'"):
            background.ask(job.check, MeasureCamera(("human", "nothing"), None, 0))
        first = background.pid
        assert first is not None
        assert psutil.Process(first).nice() > psutil.Process().nice(), "what plays comes first"
        os.kill(first, signal.SIGKILL)
        with pytest.raises(JobFailed, match="the process in the background was killed by SIGKILL"):
            background.ask(job.check, Reset((1,), 7))
    with background.turn(job):
        assert background.ensure(job, load) == 2 and background.pid not in (None, first)
        # What fails to load leaves the version before open, and is tried otherwise if there is another way.
        provoke(file, "build", "ctrl_c")
        with pytest.raises(JobFailed, match="the task failed in the background") as failed:
            background.ensure(job, replace(load, level="rebuilt"))
        assert failed.value.problem is not None and background.num_envs == 2
        other = Load(
            str(write_task(tmp_path / "other")), TaskOptions(1, env_kwargs={"render_backend": "none"})
        )
        assert background.ensure(job, replace(load, level="rebuilt"), or_else=other) == 1


@pytest.mark.parametrize("aside", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_what_nobody_waits_for_or_was_begun_before_gives_way_and_is_done_again_afterwards(
    background: Background, tmp_path: Path, aside: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.session.process.askers._PATIENCE", 30.0)  # also of a machine that is busy
    load = Load(str(write_task(tmp_path)), TaskOptions(1, env_kwargs={"render_backend": "none"}))
    done, under_way, seen = list[str](), threading.Event(), threading.Event()
    pids = set[int | None]()

    def side_work(job: Job) -> None:
        done.append("begins")
        background.ensure(job, load)
        pids.add(background.pid)
        while not seen.is_set():
            background.ask(job.check, Reset((0,), 1))
            under_way.set()
        done.append("ends")

    def somebody_waits(job: Job) -> None:
        with background.turn(job):
            background.ensure(job, load)
            background.ask(job.check, Reset((0,), 2))
            pids.add(background.pid)
            done.append("answered")
            seen.set()

    # What nobody waits for gives way to what was begun before it, too.
    one, other = a_job(), a_job()
    job, waiting = (other, one) if aside else (one, other)
    told = list[str]()
    job.report = lambda done, total, what="": told.append(what)  # type: ignore[method-assign]
    with ThreadPoolExecutor(2) as threads:
        # It would go on for ever if it did not give way.
        side = threads.submit(background.in_turns, job, lambda: side_work(job), "low" if aside else "person")
        assert under_way.wait(90)
        threads.submit(somebody_waits, waiting).result(timeout=90)
        side.result(timeout=90)
    assert done == ["begins", "answered", "begins", "ends"]
    assert len(pids) == 1, "what was left gave its answer in time, and its process goes on"
    assert told[-1] == "waiting for other work in the background"


@pytest.mark.parametrize("aside", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_what_was_begun_last_is_left_alone_by_what_waits_behind_it(
    background: Background, tmp_path: Path, aside: bool
) -> None:
    load = Load(str(write_task(tmp_path)), TaskOptions(1, env_kwargs={"render_backend": "none"}))
    done, has_it, waits = list[str](), threading.Event(), threading.Event()
    one, other = a_job(), a_job()
    behind, job = (other, one) if aside else (one, other)
    behind.check = waits.set  # type: ignore[method-assign]

    def first() -> str:
        background.ensure(job, load)
        has_it.set()
        assert waits.wait(90)
        for _ in range(5):
            background.ask(job.check, Reset((0,), 1))
        done.append("first")
        return "what it comes to"

    with ThreadPoolExecutor(2) as threads:
        asked = threads.submit(background.in_turns, job, first)
        assert has_it.wait(90)
        threads.submit(
            background.in_turns, behind, lambda: done.append("behind"), "low" if aside else "person"
        ).result(90)
        assert asked.result(timeout=90) == "what it comes to"
    assert done == ["first", "behind"]


@pytest.mark.slow
def test_when_the_process_dies_only_the_job_that_has_it_fails_and_the_queue_goes_on_with_another(
    background: Background, tmp_path: Path
) -> None:
    load = Load(str(write_task(tmp_path)), TaskOptions(1, env_kwargs={"render_backend": "none"}))
    pids, has_it, killed = list[int | None](), threading.Event(), threading.Event()

    def first(job: Job) -> None:
        with background.turn(job):
            background.ensure(job, load)
            pids.append(background.pid)
            has_it.set()
            assert killed.wait(90)
            background.ask(job.check, Reset((0,), 1))

    def waiting(job: Job) -> None:
        with background.turn(job):
            background.ensure(job, load)
            background.ask(job.check, Reset((0,), 1))
            pids.append(background.pid)

    stopped, *before, aside, last = (a_job() for _ in range(5))
    with ThreadPoolExecutor(5) as threads:
        fails = threads.submit(first, last)
        assert has_it.wait(90)
        queue: list[Future[Any]] = [threads.submit(waiting, job) for job in before]
        queue.append(
            threads.submit(background.in_turns, aside, lambda: background.ensure(aside, load), priority="low")
        )
        given_up = threads.submit(waiting, stopped)
        stopped.stopped = True
        with pytest.raises(Stopped):
            given_up.result(timeout=90)  # while another has its turn
        assert pids[0] is not None
        os.kill(pids[0], signal.SIGKILL)
        killed.set()
        with pytest.raises(JobFailed, match="the process in the background was killed by SIGKILL"):
            fails.result(timeout=90)
        for one in queue:
            one.result(timeout=90)
    assert pids[1] == pids[2] == background.pid != pids[0]


@pytest.mark.slow
def test_a_process_that_nobody_wants_is_ended_and_one_that_is_wanted_is_not(
    background: Background, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load = Load(str(write_task(tmp_path)), TaskOptions(1, env_kwargs={"render_backend": "none"}))
    job = a_job()
    with background.turn(job):
        background.ensure(job, load)
    monkeypatch.setattr("workbench.session.process.askers.IDLE_SECONDS", 0.0)
    first = background.pid
    assert first is not None, "it is kept for the next job"
    with background.turn(job):
        assert background.has_loaded(load) and background.pid == first
    until(lambda: background.pid is None, "its end")
    assert not psutil.pid_exists(first)
    with background.turn(job):
        background.ensure(job, load)
        assert background.pid is not None
        background.ask(job.check, Reset((0,), 1))

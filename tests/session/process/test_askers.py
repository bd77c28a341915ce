"""Who asks a worker: each question has its own answer, and what a process sends is believed as little as a task is."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from queue import Queue
from typing import Any

import psutil
import pytest

from tests.drive.waiting import PATIENCE, until
from tests.session.hazards import calm, provoke, provoked, write_task
from workbench.authoring.problem import Problem
from workbench.jobs.task import TaskOptions
from workbench.machine.processes.wire import Call, pack
from workbench.session.process import askers
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
        self.asker = Asker(self.send)

    def send(self, request: Request) -> None:
        assert isinstance(request, Call)
        self.calls.put(request)

    def next(self) -> int:
        return self.calls.get(timeout=PATIENCE).number


def test_two_that_ask_at_once_each_hear_their_own_whatever_comes_first() -> None:
    line = Line()
    with ThreadPoolExecutor(2) as threads:
        asked = [threads.submit(line.asker.ask, go_on, Reset((env,), env)) for env in range(2)]
        calls: list[Any] = [line.calls.get(timeout=PATIENCE) for _ in range(2)]
        line.asker.take(Answer(99, why="nobody's"))
        for call in reversed(calls):
            line.asker.take(Answer(call.number, why=f"env {call.request.env_idx[0]}"))
        for env, future in enumerate(asked):
            with pytest.raises(JobFailed, match=f"env {env}"):
                future.result(timeout=PATIENCE)


def test_progress_comes_in_order_before_the_answer_and_an_answer_brings_its_problem() -> None:
    line, heard = Line(), list[tuple[int, int, Any]]()
    scene = MakeScene("PushCube-v1", (), {}, 0, {}, {})
    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(line.asker.ask, go_on, scene, lambda *at: heard.append(at))
        number = line.next()
        for done in range(3):
            line.asker.take(Progress(number, done, 3, pack(f"state {done}")))
        line.asker.take(Answer(number, why="no such camera", problem=PROBLEM))
        with pytest.raises(JobFailed, match="no such camera") as failed:
            asked.result(timeout=PATIENCE)
        assert failed.value.problem is PROBLEM and heard == [(done, 3, f"state {done}") for done in range(3)]
        asked = threads.submit(line.asker.ask, go_on, question(0))
        line.asker.take(Answer(line.next(), pack(("no", "report"))))
        with pytest.raises(JobFailed, match="unreadable"):
            asked.result(timeout=PATIENCE)


def test_who_is_told_to_stop_waits_no_longer_and_a_late_answer_is_nobody_s() -> None:
    line, stopped = Line(), threading.Event()

    def check() -> None:
        if stopped.is_set():
            raise Stopped

    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(line.asker.ask, check, question(0))
        number = line.next()
        stopped.set()
        with pytest.raises(Stopped):
            asked.result(timeout=PATIENCE)
        line.asker.take(Answer(number, why="late"))
        again = threads.submit(line.asker.ask, go_on, question(1))
        second = line.next()
        assert second != number
        line.asker.take(Answer(second, why="mine"))
        with pytest.raises(JobFailed, match="mine"):
            again.result(timeout=PATIENCE)


# --- a process in the background ---------------------------------------------------------------------------


def a_job() -> Job:
    return Job(JobLane("test", go_on, lambda job, failure: None), "rescoring", lambda job: None)


def load_of(folder: Path, num_envs: int = 1) -> Load:
    return Load(str(write_task(folder)), TaskOptions(num_envs, env_kwargs={"render_backend": "none"}))


@pytest.fixture
def background(child_process: None) -> Iterator[Background]:
    process = Background()
    yield process
    process.end()


@pytest.mark.parametrize("what", ["garbage", pytest.param("half", marks=pytest.mark.slow)])
def test_a_process_that_sends_garbage_ends_its_job_and_the_next_can_have_another(
    background: Background, tmp_path: Path, what: str
) -> None:
    job, load = a_job(), load_of(tmp_path)
    file = Path(str(load.task))
    provoke(file, "import", what)

    def ensure() -> None:
        with background.turn(job):
            background.ensure(job, load)

    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(ensure)
        until(lambda: provoked(file), "that it is provoked")
        pid = background.pid
        # It may hang in the middle of a message: a job that is stopped must get out all the same.
        job.stopped = what == "half"
        with pytest.raises(Stopped if what == "half" else JobFailed):
            asked.result(timeout=PATIENCE)
    assert background.pid is None and not (pid and psutil.pid_exists(pid))
    calm(file)
    job.stopped = False
    ensure()
    assert background.pid is not None


def test_what_is_loaded_is_loaded_once_and_what_dies_or_fails_is_loaded_anew(
    background: Background, tmp_path: Path
) -> None:
    (tmp_path / "other").mkdir()
    job, load = a_job(), load_of(tmp_path, 2)
    told = list[str]()
    job.report = lambda done, total, what="": told.append(what)  # type: ignore[method-assign]
    with background.turn(job):
        assert background.ensure(job, load) == 2 and len(told) == 2
        assert background.ensure(job, load) == 2 and len(told) == 2, "it is there already"
        assert background.ask(job.check, Reset((1,), 7)).poses.shape[0] == 2
        with pytest.raises(JobFailed, match="nothing"):
            background.ask(job.check, MeasureCamera(("human", "nothing"), None, 0))
        first = background.pid
        assert first is not None
        assert psutil.Process(first).nice() > psutil.Process().nice(), "what plays comes first"
        os.kill(first, signal.SIGKILL)
        with pytest.raises(JobFailed, match="SIGKILL"):
            background.ask(job.check, Reset((1,), 7))
    with background.turn(job):
        assert background.ensure(job, load) == 2 and background.pid not in (None, first)
        # What fails to load leaves the version before open, and is tried otherwise if there is another way.
        provoke(Path(str(load.task)), "build", "ctrl_c")
        with pytest.raises(JobFailed) as failed:
            background.ensure(job, replace(load, level="rebuilt"))
        assert failed.value.problem is not None and background.num_envs == 2
        other = load_of(tmp_path / "other")
        assert background.ensure(job, replace(load, level="rebuilt"), or_else=other) == 1


@pytest.mark.parametrize("aside", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_job_that_was_begun_last_comes_first_and_what_gave_way_is_done_again(
    background: Background, tmp_path: Path, aside: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(askers, "_PATIENCE", PATIENCE)  # also of a machine that is busy
    load = load_of(tmp_path)
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
        assert under_way.wait(PATIENCE)
        threads.submit(background.in_turns, waiting, lambda: somebody_waits(waiting)).result(PATIENCE)
        side.result(PATIENCE)
    assert done == ["begins", "answered", "begins", "ends"] and told[-1] == askers.WAITING
    assert len(pids) == 1, "what was left gave its answer in time, and its process goes on"


@pytest.mark.slow
def test_when_the_process_dies_only_the_job_that_has_it_fails_and_the_queue_goes_on_with_another(
    background: Background, tmp_path: Path
) -> None:
    load = load_of(tmp_path)
    pids, has_it, killed = list[int | None](), threading.Event(), threading.Event()
    done = list[str]()

    def work(job: Job, wait: Callable[[], object] = go_on) -> None:
        background.ensure(job, load)
        pids.append(background.pid)
        has_it.set()
        wait()
        background.ask(job.check, Reset((0,), 1))
        done.append("person")

    stopped, before, aside, last = (a_job() for _ in range(4))
    with ThreadPoolExecutor(4) as threads:
        fails = threads.submit(background.in_turns, last, lambda: work(last, lambda: killed.wait(PATIENCE)))
        assert has_it.wait(PATIENCE)
        low = threads.submit(background.in_turns, aside, lambda: done.append("low"), "low")
        queue = threads.submit(background.in_turns, before, lambda: work(before))
        given_up = threads.submit(background.in_turns, stopped, lambda: work(stopped))
        stopped.stopped = True
        with pytest.raises(Stopped):
            given_up.result(timeout=PATIENCE)  # while another has its turn
        os.kill(pids[0] or 0, signal.SIGKILL)
        killed.set()
        with pytest.raises(JobFailed, match="SIGKILL"):
            fails.result(timeout=PATIENCE)
        queue.result(timeout=PATIENCE)
        low.result(timeout=PATIENCE)
    assert done == ["person", "low"] and pids[1] == background.pid not in (None, pids[0])


@pytest.mark.slow
def test_a_process_that_nobody_wants_is_ended_and_one_that_is_wanted_is_not(
    background: Background, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load, job = load_of(tmp_path), a_job()
    with background.turn(job):
        background.ensure(job, load)
    monkeypatch.setattr(askers, "IDLE_SECONDS", 0.0)
    first = background.pid
    assert first is not None, "it is kept for the next job"
    with background.turn(job):
        assert background.has_loaded(load) and background.pid == first
    until(lambda: background.pid is None, "its end")
    assert not psutil.pid_exists(first)

"""The past judged again: a second worker lives through the recorded moments with the new code.

After an edit of a reward the question is what it would have said of the episodes that one has just watched. They
are all in the history: a snapshot for every beginning, and every action. So they are run again with the new code and
compared with the record. That takes seconds or minutes, and the worker that plays must go on playing; so it happens in
a process of its own, with a lower priority, started at the first judgement (0.75 GB for 16 PushCube envs, and some seconds)
and ended when none was asked for in a while.

One thread does all of it: it sends some moments, waits for the answer, compares, and sends the next. So one
stops it by not sending more, and a process that does not answer (the new code may loop for ever) is ended.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

from workbench.authoring.problem import Problem
from workbench.session.judgement import JudgedCurve, Judgement, Summary
from workbench.session.messages import (
    Event,
    Failed,
    Judged,
    JudgeMoments,
    Load,
    Loaded,
    MomentToJudge,
    TaskDescription,
)
from workbench.session.process import WorkerProcess, describe_exit, start_in_background

IDLE_SECONDS = 300.0
"""How long the process is kept without a judgement."""
FILE_SAVED = "the file was saved again"
"""Why a save stops a judgement."""
_CHUNK_SECONDS = 0.1
"""About how long one answer takes: how soon progress is seen, and stopping heard."""
_MOST_AT_ONCE = 64
_SUMMARY_EVERY = 0.5
"""Seconds; making one takes some milliseconds for a long history."""
_LOOK = 0.05
_MOMENT_PATIENCE = 2.0
_LOAD_PATIENCE = 10.0
"""Seconds after which a process that was told to stop, and is still at a chunk or a load, is ended."""

JudgeState = Literal["none", "loading", "judging", "done", "stopped", "failed"]


@dataclass(frozen=True)
class JudgementView:
    """How far the judgement is and what it came to."""

    state: JudgeState = "none"
    """``loading``: the new code is being loaded by the process that judges. ``stopped``: by a person or a save."""
    serial: int = 0
    """Grows with every change."""
    done: int = 0
    total: int = 0
    """Control steps of the batch."""
    why: str = ""
    """Why it stopped or failed."""
    problem: Problem | None = None
    """What the new code raised."""
    not_carried: tuple[str, ...] = ()
    """What could not be put back at the beginnings of episodes, each with its reason."""
    steps_per_second: float = 0.0
    """Control steps of the batch per second of wall time."""
    summary: Summary | None = None


def what_a_load_means(
    before: TaskDescription | None, loaded: Loaded, view: JudgementView
) -> Literal["judge", "keep", "forget"]:
    """Whether the episodes of the version before are to be judged with the one that was loaded.

    If not, what the last judgement said is kept to be seen, or forgotten with the episodes.
    """
    level = None if before is None or loaded.reload is None else loaded.reload.level
    if level == "patched":
        return "judge"
    if level in ("same", "cameras"):
        # Saved again without a change that matters: what that stopped is to be had all the same.
        return "judge" if view.state == "stopped" and view.why == FILE_SAVED else "keep"
    return "forget"


@dataclass
class _Job:
    load: Load
    judgement: Judgement
    stopped: str = ""
    """Why it is to stop; empty while it is to go on."""
    not_carried: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    summed: float = 0.0


class _Stopped(Exception):
    """The job is to go no further."""


class _Failure(Exception):
    """The job cannot go on."""

    def __init__(self, why: str, problem: Problem | None = None) -> None:
        super().__init__(why)
        self.why, self.problem = why, problem


class Judge:
    """Judges one record at a time; a new one takes the place of the one before."""

    def __init__(self, on_change: Callable[[], None]) -> None:
        """
        Args:
            on_change: called on the judge's thread when `view` has something new.
        """
        self._on_change = on_change
        self._wake = threading.Condition()
        self._waiting: _Job | None = None
        self._job: _Job | None = None
        self._view = JudgementView()
        self._closing = False
        self._process: WorkerProcess | None = None
        self._owed: type[Judged] | type[Loaded] | None = None
        self._thread = threading.Thread(target=self._run, name="judge", daemon=True)
        self._started = False

    @property
    def view(self) -> JudgementView:
        return self._view

    @property
    def pid(self) -> int | None:
        """Of the process that judges; None while there is none."""
        process = self._process
        return None if process is None else process.pid

    def curve(self, name: str, env: int) -> JudgedCurve | None:
        """See `Judgement.curve`; None also while nothing is judged."""
        with self._wake:
            return None if self._job is None else self._job.judgement.curve(name, env)

    def judge(self, load: Load, judgement: Judgement) -> None:
        """Begin, in place of whatever was judged before.

        Args:
            load: the new code.
            judgement: of the record; it is this object's from now on.
        """
        with self._wake:
            if self._closing or judgement.steps == 0:
                return
            self._stop_job("another version was loaded")
            self._waiting = _Job(load, judgement)
            self._wake.notify_all()
            if not self._started:
                self._started = True
                self._thread.start()

    def stop(self, why: str) -> None:
        """Go no further with what is under way; what is known by then stays to be seen."""
        with self._wake:
            self._waiting = None
            self._stop_job(why)

    def forget(self) -> None:
        """Stop, and have nothing to show: the record is gone."""
        with self._wake:
            self._waiting = None
            self._stop_job("the episodes are gone")
            self._job = None
            self._view = JudgementView(serial=self._view.serial + 1)
        self._on_change()

    def close(self) -> None:
        """End the process; returns when the thread has ended."""
        with self._wake:
            self._closing = True
            self._stop_job("closing")
            self._wake.notify_all()
        if self._started:
            self._thread.join()

    def _stop_job(self, why: str) -> None:
        if self._job is not None and not self._job.stopped:
            self._job.stopped = why

    # --- the thread --------------------------------------------------------------------------------

    def _run(self) -> None:
        while (job := self._next_job()) is not None:
            try:
                self._load(job)
                for rows in job.judgement.runs():
                    self._live_through(job, rows)
                self._tell(job, "done")
            except _Stopped:
                self._tell(job, "stopped", job.stopped)
                self._settle()
            except EOFError:
                code = None if self._process is None else self._process.exit_code()
                self._end_process()
                self._tell(job, "failed", f"the process that judges {describe_exit(code)}")
            except _Failure as failure:
                self._tell(job, "failed", failure.why, failure.problem)
            with self._wake:
                job.judgement.let_go()
        self._end_process()

    def _next_job(self) -> _Job | None:
        """The next one; None when all is to end."""
        with self._wake:
            while self._waiting is None and not self._closing:
                if not self._wake.wait(IDLE_SECONDS):
                    self._end_process()
            if self._closing:
                return None
            job, self._waiting = self._waiting, None
            assert job is not None
            self._job = job
            self._view = JudgementView(serial=self._view.serial)
        return job

    def _load(self, job: _Job) -> None:
        self._tell(job, "loading")
        if self._process is None:
            try:
                self._process = start_in_background()
            except OSError as error:
                raise _Failure(f"no process could be started to judge with: {error}") from error
        else:
            # A version is tried at the moment at which the env stands, which is where the judgement before
            # ended: there the new code may raise or loop though it runs from the beginnings in the record.
            self._owed = Judged
            self._process.send(JudgeMoments((self._to_judge(job, job.judgement.runs()[0].start),)))
            self._answer(job)
        event = self._ask_to_load(job, job.load)
        if isinstance(event, Failed):
            event = self._ask_to_load(job, replace(job.load, level="rebuilt"))
        if isinstance(event, Failed):
            raise _Failure("the new code could not be loaded to judge with", event.problem)

    def _ask_to_load(self, job: _Job, load: Load) -> Event:
        assert self._process is not None
        self._owed = Loaded
        self._process.send(load)
        return self._answer(job)

    def _live_through(self, job: _Job, rows: range) -> None:
        assert self._process is not None
        at, count = rows.start, 2
        while at < rows.stop:
            chunk = range(at, min(at + count, rows.stop))
            began = time.monotonic()
            self._owed = Judged
            self._process.send(JudgeMoments(tuple(self._to_judge(job, row) for row in chunk)))
            answer = self._answer(job)
            took = time.monotonic() - began
            if isinstance(answer, Failed):
                raise _Failure("the episodes could not be run again", answer.problem)
            assert isinstance(answer, Judged)
            with self._wake:
                for row, step in zip(chunk, answer.steps, strict=False):
                    try:
                        job.judgement.add(row, step)
                    except ValueError as error:
                        raise _Failure(f"the episodes cannot be compared: {error}") from error
                job.not_carried |= answer.not_carried
                job.seconds += took
            if answer.problem is not None:
                raise _Failure("the new code raised", answer.problem)
            self._tell(job, "judging")
            wanted = count * _CHUNK_SECONDS / max(took, 1e-3)
            count = max(1, min(int(wanted), 2 * count, _MOST_AT_ONCE))
            at = chunk.stop

    def _to_judge(self, job: _Job, row: int) -> MomentToJudge:
        jump = job.judgement.snapshot(row)
        if jump is None:
            return MomentToJudge(job.judgement.moment(row).step.action)
        whole, envs = jump
        return MomentToJudge(None, pickle.dumps(whole), envs)

    def _answer(self, job: _Job) -> Event:
        """What the process owes us.

        Raises:
            _Stopped: the job is to stop; what is owed then still is.
            EOFError: the process died.
        """
        while not job.stopped:
            event = self._receive()
            if event is not None:
                return event
        raise _Stopped

    def _settle(self) -> None:
        """Take the answer that is still owed, or end the process that does not give it in time."""
        patience = _LOAD_PATIENCE if self._owed is Loaded else _MOMENT_PATIENCE
        deadline = time.monotonic() + patience
        try:
            while self._owed is not None and not self._closing:
                if time.monotonic() > deadline:
                    self._end_process()
                    return
                self._receive()
        except EOFError:
            self._end_process()  # of what it was asked for last; the next judgement starts another

    def _receive(self) -> Event | None:
        """The event that is owed, or that it cannot be had; None if it has not come yet."""
        assert self._process is not None and self._owed is not None
        event = self._process.receive(timeout=_LOOK)
        if not isinstance(event, (self._owed, Failed)):
            return None
        self._owed = None
        return event

    def _end_process(self) -> None:
        if self._process is not None:
            self._process.stop(grace=0.0)
        self._process = self._owed = None

    def _tell(self, job: _Job, state: JudgeState, why: str = "", problem: Problem | None = None) -> None:
        with self._wake:
            if self._job is not job:
                return  # it was forgotten
            before, judgement = self._view, job.judgement
            now = time.monotonic()
            summary = before.summary
            if state != "judging" or now - job.summed > _SUMMARY_EVERY:
                summary = judgement.summary() if judgement.judged_steps else None
                job.summed = now
            self._view = replace(
                before,
                state=state,
                serial=before.serial + 1,
                done=judgement.judged_steps,
                total=judgement.steps,
                why=why,
                problem=problem,
                not_carried=tuple(f"{what}: {reason}" for what, reason in job.not_carried.items()),
                steps_per_second=judgement.judged_steps / job.seconds if job.seconds else 0.0,
                summary=summary,
            )
        self._on_change()

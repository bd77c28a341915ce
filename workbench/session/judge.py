"""The past judged again: a second worker lives through the recorded moments with the new code.

After an edit of a reward the question is what it would have said of the episodes that one has just watched. They
are all in the history: a snapshot for every beginning, and every action. So they are run again with the new code and
compared with the record. That takes seconds or minutes, and the worker that plays must go on playing; so it happens in
a process of its own, with a lower priority, started at the first judgement (0.75 GB for 16 PushCube envs, and some seconds)
and ended when none was asked for in a while.

A lane's thread does all of it: it sends some moments, waits for the answer, compares, and sends the next. So one
stops it by not sending more, and a process that does not answer (the new code may loop for ever) is ended.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

from workbench.authoring.problem import Problem
from workbench.session.askers import IDLE_SECONDS, Background
from workbench.session.judgement import JudgedCurve, Judgement
from workbench.session.judging import JudgedState, JudgedView, StoppedBy
from workbench.session.lane import Job, JobFailed, Lane, Stopped
from workbench.session.messages import Load, Loaded, TaskDescription
from workbench.session.moment_messages import JudgeMoments, MomentToJudge

_CHUNK_SECONDS = 0.1
"""About how long one answer takes: how soon progress is seen, and stopping heard."""
_MOST_AT_ONCE = 64
_SUMMARY_EVERY = 0.5
"""Seconds between two looks at what it comes to so far."""


def what_a_load_means(
    before: TaskDescription | None, loaded: Loaded, view: JudgedView
) -> Literal["judge", "keep", "forget"]:
    """Whether the episodes of the version before are to be judged with the one that was loaded.

    If not, what the last judgement said is kept to be seen, or forgotten with the episodes.
    """
    level = None if before is None or loaded.reload is None else loaded.reload.level
    if level == "patched":
        return "judge"
    if level in ("same", "cameras"):
        # Saved again without a change that matters: what that stopped is to be had all the same.
        return "judge" if view.stopped_by is StoppedBy.SAVE else "keep"
    return "forget"


@dataclass
class _Case:
    """What is judged, and how far that is."""

    load: Load
    judgement: Judgement
    stopped: StoppedBy | None = None
    """Why it is to stop; None while it is to go on."""
    not_carried: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    summed: float = 0.0


class Judge:
    """Judges one record at a time; a new one takes the place of the one before."""

    def __init__(self, on_change: Callable[[], None], process: Background) -> None:
        """
        Args:
            on_change: called on the judge's thread when `view` has something new.
            process: in which it is judged. Whoever else wants it need not wait.
        """
        self._on_change = on_change
        self._lock = threading.Lock()
        self._case: _Case | None = None
        """What is shown: what is being judged, or was last."""
        self._view = JudgedView()
        self._process = process
        # Changes and failures are told by `_tell`, with all that there is to them.
        self._lane = Lane("judge", lambda: None, lambda why: None, IDLE_SECONDS, process.rest)

    @property
    def view(self) -> JudgedView:
        return self._view

    def curve(self, name: str, env: int) -> JudgedCurve | None:
        """See `Judgement.curve`; None also while nothing is judged."""
        with self._lock:
            return None if self._case is None else self._case.judgement.curve(name, env)

    def judge(self, load: Load, judgement: Judgement) -> None:
        """Begin, in place of whatever was judged before.

        Args:
            load: the new code.
            judgement: of the record; it is this object's from now on.
        """
        if judgement.steps == 0:
            return
        case = _Case(load, judgement)
        with self._lock:
            self._stop(StoppedBy.LOAD)
            self._lane.start("judging", lambda job: self._run(job, case))

    def stop(self, why: StoppedBy) -> None:
        """Go no further with what is under way; what is known by then stays to be seen."""
        with self._lock:
            self._stop(why)

    def forget(self) -> None:
        """Stop, and have nothing to show: the record is gone."""
        with self._lock:
            self._stop(StoppedBy.LOSS)
            self._case = None
            self._view = JudgedView(serial=self._view.serial + 1)
        self._on_change()

    def close(self) -> None:
        """End the process; returns when the thread has ended."""
        self.stop(StoppedBy.CLOSING)
        self._lane.close()

    def _stop(self, why: StoppedBy) -> None:
        if self._case is not None and self._case.stopped is None:
            self._case.stopped = why
        self._lane.stop()

    # --- on the lane ---------------------------------------------------------------------------------

    def _run(self, job: Job, case: _Case) -> None:
        with self._lock:
            job.check()  # stopped before it began: what was judged before stays to be seen
            self._case, self._view = case, JudgedView(serial=self._view.serial)
        try:
            self._tell(case, "loading")
            for rows in case.judgement.runs():
                self._process.in_turns(job, partial(self._judge_run, job, case, rows))
            self._tell(case, "done")
        except Stopped:
            self._tell(case, "stopped")
        except JobFailed as failure:
            self._tell(case, "failed", str(failure), failure.problem)
        except Exception as error:
            self._tell(case, "failed", f"it failed within the workbench ({type(error).__name__}: {error})")
            raise
        with self._lock:
            case.judgement.let_go()

    def _load(self, job: Job, case: _Case) -> None:
        if self._process.has(case.load):
            return
        self._tell(case, "loading")
        if self._process.num_envs == len(case.judgement.moment(case.judgement.runs()[0].start).step.reward):
            # A version is tried at the moment at which the env stands, which is where the judgement before
            # ended: there the new code may raise or loop though it runs from the beginnings in the record.
            begin = _to_judge(case.judgement, case.judgement.runs()[0].start)
            self._process.ask(job.check, JudgeMoments((begin,)))
        try:
            self._process.ensure(job, case.load, or_else=replace(case.load, level="rebuilt"))
        except JobFailed as failure:
            if failure.problem is None:
                raise
            raise JobFailed("the new code could not be loaded to judge with", failure.problem) from failure

    def _judge_run(self, job: Job, case: _Case, rows: range) -> None:
        try:
            self._load(job, case)
            self._live_through(job, case, rows)
        except Stopped:
            self._tell(case, "stopped")  # before what the process still owes is waited for
            raise

    def _live_through(self, job: Job, case: _Case, rows: range) -> None:
        at, count = rows.start, 2
        while at < rows.stop:
            chunk = range(at, min(at + count, rows.stop))
            began = time.monotonic()
            moments = tuple(_to_judge(case.judgement, row) for row in chunk)
            answer = self._process.ask(job.check, JudgeMoments(moments))
            took = time.monotonic() - began
            with self._lock:
                for row, step in zip(chunk, answer.steps, strict=False):
                    try:
                        case.judgement.add(row, step)
                    except ValueError as error:
                        raise JobFailed(f"the episodes cannot be compared: {error}") from error
                case.not_carried |= answer.not_carried
                case.seconds += took
            if answer.problem is not None:
                raise JobFailed("the new code raised", answer.problem)
            self._tell(case, "judging")
            wanted = count * _CHUNK_SECONDS / max(took, 1e-3)
            count = max(1, min(int(wanted), 2 * count, _MOST_AT_ONCE))
            at = chunk.stop

    def _tell(self, case: _Case, state: JudgedState, why: str = "", problem: Problem | None = None) -> None:
        with self._lock:
            if self._case is not case:
                return  # it was forgotten
            before, judgement = self._view, case.judgement
            stopped = case.stopped if state == "stopped" else None
            now = time.monotonic()
            names = before.names, before.differing_names
            verdicts = before.verdicts
            if state != "judging" or now - case.summed > _SUMMARY_EVERY:
                verdicts, names = tuple(judgement.verdicts()), judgement.names()
                case.summed = now
            self._view = replace(
                before,
                state=state,
                serial=before.serial + 1,
                done=judgement.judged_steps,
                total=judgement.steps,
                steps=judgement.judged_steps,
                seconds=case.seconds,
                task="the new code",
                stopped_by=stopped,
                why=why if stopped is None else stopped.value,
                problem=problem,
                warnings=tuple(
                    f"not put back: {what}: {reason}" for what, reason in case.not_carried.items()
                ),
                verdicts=verdicts,
                names=names[0],
                differing_names=names[1],
            )
        self._on_change()


def _to_judge(judgement: Judgement, row: int) -> MomentToJudge:
    jump = judgement.snapshot(row)
    if jump is None:
        return MomentToJudge(judgement.moment(row).step.action)
    whole, envs = jump
    return MomentToJudge(None, pickle.dumps(whole), envs)

"""The past judged again: the recorded moments lived through with the new code.

After an edit of a reward the question is what it would have said of the episodes that one has just watched. They
are all in the history: a snapshot for every beginning, and every action. So they are run again with the new code and
compared with the record. Some moments are sent, the answer is compared, and the next are sent: so one stops it by not
sending more, and a process that does not answer (the new code may loop for ever) is ended.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Literal

from workbench.session.askers import Background
from workbench.session.judgement import JudgedCurve, Judgement
from workbench.session.judging import JudgedView, Judging, StoppedBy
from workbench.session.lane import Job, JobFailed
from workbench.session.messages import Load, Loaded, TaskDescription
from workbench.session.questions import Judged, JudgeMoments

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


class Judge:
    """Judges the past."""

    def __init__(self, on_change: Callable[[], None], process: Background) -> None:
        """
        Args:
            on_change: called when `judging` has something new.
            process: in which it is judged. Whoever else wants it need not wait.
        """
        self.judging = Judging("judge", on_change)
        self._process, self._lock = process, threading.Lock()
        self._judgement: Judgement | None = None
        """What is shown: what is being judged, or was last."""

    def curve(self, name: str, env: int) -> JudgedCurve | None:
        """See `Judgement.curve`; None also while nothing is judged."""
        with self._lock:
            return None if self._judgement is None else self._judgement.curve(name, env)

    def judge(self, load: Load, judgement: Judgement) -> None:
        """Begin, in place of whatever was judged before.

        Args:
            load: the new code.
            judgement: of the record; it is this object's from now on.
        """
        if judgement.steps == 0:
            return
        self.stop(StoppedBy.LOAD)
        with self._lock:
            self._judgement = judgement
        view = JudgedView("loading", total=judgement.steps, task="the new code")
        self.judging.begin(view, lambda job: self._judge(job, load, judgement))

    def stop(self, why: StoppedBy = StoppedBy.HAND) -> None:
        """As `Judging.stop`."""
        self.judging.stop(why)
        with self._lock:
            if self._judgement is not None:
                self._judgement.let_go()  # a job that still waited does not come to it

    def forget(self) -> None:
        """Stop, and have nothing to show: the record is gone."""
        self.judging.forget()
        with self._lock:
            self._judgement = None

    # --- on the lane ---------------------------------------------------------------------------------

    def _judge(self, job: Job, load: Load, judgement: Judgement) -> None:
        looked, missed = 0.0, dict[str, str]()

        def tell(answer: Judged, seconds: float) -> None:
            nonlocal looked
            missed.update(answer.not_carried)
            now, done = time.monotonic(), judgement.judged_steps
            if answer.problem is not None or done == judgement.steps or now - looked > _SUMMARY_EVERY:
                looked = now
                with self._lock:
                    names, differing = judgement.names()
                    verdicts = tuple(judgement.verdicts())
                self.judging.tell(job, verdicts=verdicts, names=names, differing_names=differing)
            self.judging.tell(
                job,
                state="judging",
                done=done,
                steps=done,
                seconds=self.judging.view.seconds + seconds,
                warnings=tuple(f"not put back: {what}: {why}" for what, why in missed.items()),
            )
            if answer.problem is not None:
                raise JobFailed("the new code raised", answer.problem)

        def judge_run(rows: range) -> None:
            self._load(job, load, judgement)
            self._live_through(job, judgement, rows, tell)

        try:
            for rows in judgement.runs():
                self._process.in_turns(job, partial(judge_run, rows), aside=True)
        finally:
            with self._lock:
                judgement.let_go()

    def _load(self, job: Job, load: Load, judgement: Judgement) -> None:
        if self._process.has(load):
            return
        self.judging.tell(job, state="loading")
        if self._process.num_envs == judgement.num_envs:
            # A version is tried at the moment at which the env stands, which is where the judgement before
            # ended: there the new code may raise or loop though it runs from the beginnings in the record.
            self._ask(job, judgement, judgement.runs()[0][:1])
        try:
            self._process.ensure(job, load, or_else=replace(load, level="rebuilt"))
        except JobFailed as failure:
            if failure.problem is None:
                raise
            raise JobFailed("the new code could not be loaded to judge with", failure.problem) from failure

    def _live_through(
        self, job: Job, judgement: Judgement, rows: range, tell: Callable[[Judged, float], None]
    ) -> None:
        at, count = rows.start, 2
        while at < rows.stop:
            chunk = range(at, min(at + count, rows.stop))
            began = time.monotonic()
            answer = self._ask(job, judgement, chunk)
            took = time.monotonic() - began
            with self._lock:
                job.check()
                for row, step in zip(chunk, answer.steps, strict=False):
                    try:
                        judgement.add(row, step)
                    except ValueError as error:
                        raise JobFailed(f"the episodes cannot be compared: {error}") from error
            tell(answer, took)
            wanted = count * _CHUNK_SECONDS / max(took, 1e-3)
            count = max(1, min(int(wanted), 2 * count, _MOST_AT_ONCE))
            at = chunk.stop

    def _ask(self, job: Job, judgement: Judgement, rows: range) -> Judged:
        with self._lock:
            job.check()
            moments = tuple(judgement.to_judge(row) for row in rows)
        return self._process.ask(job.check, JudgeMoments(moments))

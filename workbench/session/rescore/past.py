"""The past judged again: the recorded moments lived through with the new code, and compared with the record.

After an edit of a reward the question is what it would have said of the episodes that one has just watched. They
are all in the history: a snapshot for every beginning, and every action. So they are run again with the new code. Some
moments are sent, the answer is compared, and the next are sent: so one stops it by not sending more, and a process that
does not answer (the new code may loop for ever) is ended.

A `RescoredPast` is begun from a history and filled as the moments come back from the worker. Each is a row: the reward, every
number that ``evaluate`` returned, and how far the bodies are from where they were, since what is judged is the run anew
and not the record itself. That drift is what makes a comparison good or bad, so it is kept for every moment and every
env. Where an episode begins at a kept reset it is mostly zero to the last bit, because the envs get the same physics without a past there (measured: PushCube,
PickCube and StackCube none, PushT 7e-8 m, PushCube with a going back among its moments 6e-8 m). It may grow where the
oldest kept moment is in the middle of an episode, and for tasks whose state a snapshot cannot hold whole (see
`core.snapshots.snapshot`).

A *run* here is what one env lived through without a jump, up to its reset or to going back.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workbench.core.capture.recorded_run import pose_distances
from workbench.core.env.step_result import StepResult
from workbench.jobs.task import TaskDescription
from workbench.jobs.verdict import Scores, Verdict, compare, single_numbers
from workbench.session.history.history import History, Moment
from workbench.session.process.askers import Background
from workbench.session.process.job_lane import Job, JobFailed
from workbench.session.protocol.messages import Load, Loaded
from workbench.session.protocol.questions import MomentToRescore, RescoredMoments, RescoreMoments
from workbench.session.rescore.background import RescoreView, Rescoring, StoppedBy

MOST_ENTRIES = 24
"""Entries of ``evaluate`` that are compared; each takes 8 bytes for every moment and env."""


@dataclass(frozen=True, eq=False)
class PastRun:
    """What one env lived through without a jump."""

    env: int
    begin: int
    """Control steps of its episode before its first moment."""
    serials: NDArray[np.int64]
    """(T + 1,) of its moments."""

    @property
    def name(self) -> str:
        return f"env {self.env}"

    def at(self, step: int) -> int:
        """Serial of the moment after a step of its episode."""
        return int(self.serials[step - self.begin])


@dataclass(frozen=True)
class RescoredCurve:
    """One number of one env at the control steps of the record, oldest first."""

    tick: NDArray[np.int64]
    """(T,) as `Curves.tick`."""
    serial: NDArray[np.int64]
    """(T,) of the moments."""
    old: NDArray[np.float32]
    """(T,) NaN where the old code did not have it."""
    new: NDArray[np.float32]
    """(T,) NaN where it is not judged (yet)."""


class RescoredPast:
    """The record and what is said of it now, side by side. Not thread-safe: its owner locks."""

    def __init__(self, history: History) -> None:
        """Take everything that `history` has, up to the first jump whose snapshot could not be made."""
        self._moments: list[Moment] = []
        for moment in history.between(history.first, history.last):
            if moment.snapshot is None and (not self._moments or moment.jumped.any()):
                break
            self._moments.append(moment)
        count = len(self._moments)
        envs = len(self._moments[0].step.reward) if count else 0
        self._jumped: NDArray[np.bool_] = np.array([m.jumped for m in self._moments], bool).reshape(
            count, envs
        )
        self._is_step: NDArray[np.bool_] = np.logical_not(self._jumped.any(axis=1))
        if count:
            self._jumped[0], self._is_step[0] = True, False
        self._serial = np.array([m.serial for m in self._moments], np.int64)
        self._tick = np.array([m.tick for m in self._moments], np.int64)
        self._elapsed = np.array([m.step.elapsed_steps for m in self._moments]).reshape(count, envs)
        self._rescored = np.zeros(count, bool)
        self._old: dict[str, NDArray[np.float32]] = {}
        self._new: dict[str, NDArray[np.float32]] = {}
        for row, moment in enumerate(self._moments):
            self._write(self._old, row, moment.as_recorded)
        self._drift = np.zeros((count, envs, 2), np.float32)
        # Runs by number over the batch: which one each env is in at each row.
        within = np.cumsum(self._jumped, axis=0) - 1
        sizes = within[-1] + 1 if count else np.zeros(0, np.int64)
        self._run = within + (np.cumsum(sizes) - sizes)
        self._changed: set[int] = set()
        """Numbers of runs of which more was judged since `verdicts` was asked."""
        self._verdicts: dict[int, Verdict[PastRun]] = {}

    @property
    def steps(self) -> int:
        """Control steps of the batch that there are to judge."""
        return int(self._is_step.sum())

    @property
    def rescored_steps(self) -> int:
        return int((self._is_step & self._rescored).sum())

    def runs(self) -> list[range]:
        """Rows to be lived through in order, each run beginning with a jump of all envs; the newest run first.

        What a person looks at is mostly what was last, and a history may hold minutes of simulation.
        """
        begins = [int(row) for row in np.flatnonzero(self._jumped.all(axis=1))]
        ends = [*begins[1:], len(self._serial)]
        return [range(begin, end) for begin, end in zip(begins, ends, strict=True)][::-1]

    @property
    def num_envs(self) -> int:
        return self._jumped.shape[1]

    def to_rescore(self, row: int) -> MomentToRescore:
        """This row, for whoever lives through it again."""
        if self._is_step[row]:
            return MomentToRescore(self._moments[row].step.action)
        envs = tuple(int(env) for env in np.flatnonzero(self._jumped[row]))
        return MomentToRescore(None, pickle.dumps(self._moments[row].snapshot), envs)

    def add(self, row: int, step: StepResult) -> None:
        """What the new code says of this row.

        Raises:
            ValueError: the bodies are not those of the record, so that nothing can be compared.
        """
        was = self._moments[row].step.poses
        if step.poses.shape != was.shape:
            raise ValueError(f"the bodies are others now: poses {step.poses.shape}, were {was.shape}")
        far = pose_distances(step.poses, was)
        self._drift[row] = np.stack([each.max(axis=1, initial=0.0) for each in far], axis=1)
        self._write(self._new, row, step)
        self._rescored[row] = True
        self._changed.update(self._run[row].tolist())

    def let_go(self) -> None:
        """Forget the moments and their snapshots, when no more rows will come."""
        self._moments = []

    def curve(self, name: str, env: int) -> RescoredCurve | None:
        """One number of one env; None if neither version has one of this name."""
        old, new = self._old.get(name), self._new.get(name)
        if (old is None and new is None) or not 0 <= env < self.num_envs:
            return None
        steps, missing = self._is_step, np.full(self.steps, np.nan, np.float32)
        return RescoredCurve(
            self._tick[steps],
            self._serial[steps],
            missing if old is None else old[steps, env],
            missing if new is None else new[steps, env],
        )

    # --- what it comes to --------------------------------------------------------------------------

    def verdicts(self) -> list[Verdict[PastRun]]:
        """Of each run of which a step was judged, as far as it was."""
        for number in self._changed:
            if (verdict := self._compared(number)) is not None:
                self._verdicts[number] = verdict
        self._changed.clear()
        return [*self._verdicts.values()]

    def names(self) -> tuple[tuple[str, ...], frozenset[str]]:
        """What `curve` has: ``reward`` first, then what differs, then the rest; and what differs."""
        names = dict.fromkeys(["reward", *self._old, *self._new])
        differing = {name for verdict in self.verdicts() for name in verdict.differing}
        if self._new:
            differing |= self._old.keys() ^ self._new.keys()
        return tuple(sorted(names, key=lambda name: (name != "reward", name not in differing))), frozenset(
            differing
        )

    def _compared(self, number: int) -> Verdict[PastRun] | None:
        """A run by the rows of it that are judged, its jump and its control steps; None before there are two."""
        env = int(self._run[0].searchsorted(number, side="right")) - 1
        first, end = self._run[:, env].searchsorted([number, number + 1])
        counts = self._rescored[first:end] & self._is_step[first:end]
        counts[0] = self._rescored[first]
        # A run that nobody else's jump is in is a slice, which is ten times as quick.
        rows = slice(first, end) if counts.all() else first + counts.nonzero()[0]
        serials = self._serial[rows]
        if len(serials) < 2:
            return None
        old, new = (
            Scores(
                table["reward"][rows, env][1:],
                {name: column[rows, env] for name, column in table.items() if name != "reward"},
            )
            for table in (self._old, self._new)
        )
        begin = int(self._elapsed[serials[0] - self._serial[0], env])
        return compare(PastRun(env, begin, serials), old, new, self._drift[rows, env], begin=begin)

    def _write(self, table: dict[str, NDArray[np.float32]], row: int, step: StepResult) -> None:
        for name, value in (("reward", step.reward), *single_numbers(step.evaluate).items()):
            if name not in table:
                if len(table) > MOST_ENTRIES:
                    continue
                table[name] = np.full(self._jumped.shape, np.nan, np.float32)
            table[name][row] = value


_CHUNK_SECONDS = 0.1
"""About how long one answer takes: how soon progress is seen, and stopping heard."""
_MOST_AT_ONCE = 64
_SUMMARY_EVERY = 0.5
"""Seconds between two looks at what it comes to so far."""


def what_a_load_means(
    before: TaskDescription | None, loaded: Loaded, view: RescoreView
) -> Literal["rescore", "keep", "forget"]:
    """Whether the episodes of the version before are to be judged with the one that was loaded.

    If not, what the last judgement said is kept to be seen, or forgotten with the episodes.
    """
    level = None if before is None or loaded.reload is None else loaded.reload.level
    if level == "patched":
        return "rescore"
    if level in ("same", "cameras"):
        # Saved again without a change that matters: what that stopped is to be had all the same.
        return "rescore" if view.stopped_by is StoppedBy.SAVE else "keep"
    return "forget"


class PastRescorer:
    """Judges the past."""

    def __init__(self, on_change: Callable[[], None], process: Background) -> None:
        """
        Args:
            on_change: called when `rescoring` has something new.
            process: in which it is judged. Whoever else wants it need not wait.
        """
        self.rescoring = Rescoring("rescore", on_change)
        self._process, self._lock = process, threading.Lock()
        self._rescored: RescoredPast | None = None
        """What is shown: what is being judged, or was last."""

    def curve(self, name: str, env: int) -> RescoredCurve | None:
        """See `RescoredPast.curve`; None also while nothing is judged."""
        with self._lock:
            return None if self._rescored is None else self._rescored.curve(name, env)

    def rescore(self, load: Load, rescored: RescoredPast) -> None:
        """Begin, in place of whatever was judged before.

        Args:
            load: the new code.
            judgement: of the record; it is this object's from now on.
        """
        if rescored.steps == 0:
            return
        self.stop(StoppedBy.LOAD)
        with self._lock:
            self._rescored = rescored
        view = RescoreView("loading", total=rescored.steps, task="the new code")
        self.rescoring.begin(view, lambda job: self._rescore(job, load, rescored))

    def stop(self, why: StoppedBy = StoppedBy.HAND) -> None:
        """As `Rescoring.stop`."""
        self.rescoring.stop(why)
        with self._lock:
            if self._rescored is not None:
                self._rescored.let_go()  # a job that still waited does not come to it

    def forget(self) -> None:
        """Stop, and have nothing to show: the record is gone."""
        self.rescoring.forget()
        with self._lock:
            self._rescored = None

    # --- on the lane ---------------------------------------------------------------------------------

    def _rescore(self, job: Job, load: Load, rescored: RescoredPast) -> None:
        looked, missed = 0.0, dict[str, str]()

        def tell(answer: RescoredMoments, seconds: float) -> None:
            nonlocal looked
            missed.update(answer.not_carried)
            now, done = time.monotonic(), rescored.rescored_steps
            if answer.problem is not None or done == rescored.steps or now - looked > _SUMMARY_EVERY:
                looked = now
                with self._lock:
                    names, differing = rescored.names()
                    verdicts = tuple(rescored.verdicts())
                self.rescoring.tell(job, verdicts=verdicts, names=names, differing_names=differing)
            self.rescoring.tell(
                job,
                state="rescoring",
                done=done,
                steps=done,
                seconds=self.rescoring.view.seconds + seconds,
                warnings=tuple(f"not put back: {what}: {why}" for what, why in missed.items()),
            )
            if answer.problem is not None:
                raise JobFailed("the new code raised", answer.problem)

        def rescore_rows(rows: range) -> None:
            self._load(job, load, rescored)
            self._replay_steps(job, rescored, rows, tell)

        try:
            for rows in rescored.runs():
                self._process.in_turns(job, partial(rescore_rows, rows), aside=True)
        finally:
            with self._lock:
                rescored.let_go()

    def _load(self, job: Job, load: Load, rescored: RescoredPast) -> None:
        if self._process.has(load):
            return
        self.rescoring.tell(job, state="loading")
        if self._process.num_envs == rescored.num_envs:
            # A version is tried at the moment at which the env stands, which is where the judgement before
            # ended: there the new code may raise or loop though it runs from the beginnings in the record.
            self._ask(job, rescored, rescored.runs()[0][:1])
        try:
            self._process.ensure(job, load, or_else=replace(load, level="rebuilt"))
        except JobFailed as failure:
            if failure.problem is None:
                raise
            raise JobFailed("the new code could not be loaded to judge with", failure.problem) from failure

    def _replay_steps(
        self, job: Job, rescored: RescoredPast, rows: range, tell: Callable[[RescoredMoments, float], None]
    ) -> None:
        at, count = rows.start, 2
        while at < rows.stop:
            chunk = range(at, min(at + count, rows.stop))
            began = time.monotonic()
            answer = self._ask(job, rescored, chunk)
            took = time.monotonic() - began
            with self._lock:
                job.check()
                for row, step in zip(chunk, answer.steps, strict=False):
                    try:
                        rescored.add(row, step)
                    except ValueError as error:
                        raise JobFailed(f"the episodes cannot be compared: {error}") from error
            tell(answer, took)
            wanted = count * _CHUNK_SECONDS / max(took, 1e-3)
            count = max(1, min(int(wanted), 2 * count, _MOST_AT_ONCE))
            at = chunk.stop

    def _ask(self, job: Job, rescored: RescoredPast, rows: range) -> RescoredMoments:
        with self._lock:
            job.check()
            moments = tuple(rescored.to_rescore(row) for row in rows)
        return self._process.ask(job.check, RescoreMoments(moments))

"""What new code says of moments that were lived through with the old: the comparison, in plain arrays.

A `Judgement` is begun from a history and filled as the moments come back from the worker that lives through them
again (see `session.judge`). Each is a row: the reward, every number that ``evaluate`` returned, and how far the bodies
are from where they were, since what is judged is the run anew and not the record itself. That drift is what
makes a comparison good or bad, so it is kept for every moment and every env. Where an episode begins at a kept reset
it is mostly zero to the last bit, because the envs get the same physics without a past there (measured: PushCube,
PickCube and StackCube none, PushT 7e-8 m, PushCube with a going back among its moments 6e-8 m). It may grow where the
oldest kept moment is in the middle of an episode, and for tasks whose state a snapshot cannot hold whole (see
`core.snapshot`).

A *run* here is what one env lived through without a jump, up to its reset or to going back.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.core.recorded_run import pose_distances
from workbench.core.snapshot_parts import WholeSnapshot
from workbench.core.step import StepResult
from workbench.session.history import History, Moment
from workbench.session.questions import MomentToJudge
from workbench.session.verdict import Said, Verdict, compare, single_numbers

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
class JudgedCurve:
    """One number of one env at the control steps of the record, oldest first."""

    tick: NDArray[np.int64]
    """(T,) as `Curves.tick`."""
    serial: NDArray[np.int64]
    """(T,) of the moments."""
    old: NDArray[np.float32]
    """(T,) NaN where the old code did not have it."""
    new: NDArray[np.float32]
    """(T,) NaN where it is not judged (yet)."""


class Judgement:
    """The record and what is said of it now, side by side. Not thread-safe: its owner locks."""

    def __init__(self, history: History) -> None:
        """Take everything that `history` has, up to the first jump whose snapshot could not be made."""
        self._moments: list[Moment] = []
        self._snapshots: dict[int, WholeSnapshot] = {}
        """By row."""
        for moment in history.between(history.first, history.last):
            if not self._moments or moment.jumped.any():
                whole = history.whole_at(moment.serial)
                if whole is None:
                    break
                self._snapshots[len(self._moments)] = whole
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
        self._judged = np.zeros(count, bool)
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
    def judged_steps(self) -> int:
        return int((self._is_step & self._judged).sum())

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

    def to_judge(self, row: int) -> MomentToJudge:
        """This row, for whoever lives through it again."""
        if self._is_step[row]:
            return MomentToJudge(self._moments[row].step.action)
        envs = tuple(int(env) for env in np.flatnonzero(self._jumped[row]))
        return MomentToJudge(None, pickle.dumps(self._snapshots[row]), envs)

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
        self._judged[row] = True
        self._changed.update(self._run[row].tolist())

    def let_go(self) -> None:
        """Forget the moments and their snapshots, when no more rows will come."""
        self._moments, self._snapshots = [], {}

    def curve(self, name: str, env: int) -> JudgedCurve | None:
        """One number of one env; None if neither version has one of this name."""
        old, new = self._old.get(name), self._new.get(name)
        if (old is None and new is None) or not 0 <= env < self.num_envs:
            return None
        steps, missing = self._is_step, np.full(self.steps, np.nan, np.float32)
        return JudgedCurve(
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
        counts = self._judged[first:end] & self._is_step[first:end]
        counts[0] = self._judged[first]
        # A run that nobody else's jump is in is a slice, which is ten times as quick.
        rows = slice(first, end) if counts.all() else first + counts.nonzero()[0]
        serials = self._serial[rows]
        if len(serials) < 2:
            return None
        old, new = (
            Said(
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

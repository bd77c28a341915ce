"""Old and new scores of the history, and their comparison."""

from __future__ import annotations

import pickle
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.envs.recorded_run import pose_distances
from workbench.envs.step_result import StepResult
from workbench.live.history.moments import History, Moment
from workbench.rescore.verdict import MomentToRescore, Scores, Verdict, compare, scalar_entries

MAX_ENTRIES = 24
"""Maximum number of entries of ``evaluate`` that are compared; each takes 8 bytes for every moment and env."""


@dataclass(frozen=True, eq=False)
class PastRun:
    """Moments of one env from a jump (a reset, or a restored past moment) to the next jump."""

    env: int
    begin: int
    """Control steps of the episode before the first moment of the run."""
    serials: NDArray[np.int64]
    """(T + 1,) serials of the moments."""
    tick: int = 0
    """Control steps before the first moment, counted as on the timeline."""

    @property
    def name(self) -> str:
        return f"env {self.env}"

    def at(self, step: int) -> int:
        """Serial of the moment after this control step of the episode."""
        return int(self.serials[step - self.begin])


@dataclass(frozen=True)
class RescoredCurve:
    """Values of one number of one env at the recorded control steps, oldest first."""

    tick: NDArray[np.int64]
    """(T,) ticks, counted as in `Moment.tick`."""
    serial: NDArray[np.int64]
    """(T,) serials of the moments."""
    old: NDArray[np.float32]
    """(T,) recorded numbers; NaN if the old code lacks the number."""
    new: NDArray[np.float32]
    """(T,) rescored numbers; NaN at moments that are not rescored (yet)."""


class RescoredPast:
    """Old and new scores of the history, one row per moment, filled as results arrive. Used on the loop.

    The bodies' drift from the record is stored for each moment and env, because it decides whether a
    comparison is reliable. After a reset that is in the history, the drift is exactly zero in most tasks,
    because envs start there with fresh physics (measured: zero in PushCube, PickCube and StackCube, 7e-8 m in
    PushT, 6e-8 m in PushCube with a restored past moment). The drift may grow if the oldest moment of the
    history is in the middle of an episode, and in tasks whose state does not fit a snapshot (see
    `envs.snapshots.snapshot`).
    """

    def __init__(self, history: History, seen: int | None = None, has_reward: bool = True) -> None:
        """Take the moments of `history` up to the first jump without a snapshot; none if its oldest moment
        has no snapshot.

        Args:
            seen: serial of the moment that the page shows; its run is replayed first.
            has_reward: whether the old or the new version has a reward.
        """
        self._seen, self._has_reward = seen, has_reward
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
        self._elapsed = np.array([m.as_recorded.elapsed_steps for m in self._moments]).reshape(count, envs)
        self._rescored = np.zeros(count, bool)
        self._old: dict[str, NDArray[np.float32]] = {}
        self._new: dict[str, NDArray[np.float32]] = {}
        for row, moment in enumerate(self._moments):
            self._write(self._old, row, moment.as_recorded)
        self._drift = np.zeros((count, envs, 2), np.float32)
        # The run of each env at each row; runs are numbered over the whole batch.
        within = np.cumsum(self._jumped, axis=0) - 1
        sizes = within[-1] + 1 if count else np.zeros(0, np.int64)
        self._run = within + (np.cumsum(sizes) - sizes)
        self._changed: set[int] = set()
        """Numbers of the runs that got new rows since the last call of `verdicts`."""
        self._verdicts: dict[int, Verdict[PastRun]] = {}

    @property
    def steps(self) -> int:
        """Control steps of the batch in total."""
        return int(self._is_step.sum())

    @property
    def rescored_steps(self) -> int:
        return int((self._is_step & self._rescored).sum())

    def runs(self) -> list[range]:
        """Rows to replay, as runs that each begin with a jump of all envs. A history may contain minutes of
        simulation, so the shown run comes first, then the others from the newest to the oldest.
        """
        begins = [int(row) for row in np.flatnonzero(self._jumped.all(axis=1))]
        ends = [*begins[1:], len(self._serial)]
        newest_first = [range(begin, end) for begin, end in zip(begins, ends, strict=True)][::-1]
        seen = -1 if self._seen is None else int(self._serial.searchsorted(self._seen))
        return sorted(newest_first, key=lambda rows: seen not in rows)

    @property
    def num_envs(self) -> int:
        return self._jumped.shape[1]

    def moment_to_rescore(self, row: int) -> MomentToRescore:
        """The data that a worker needs to replay this row."""
        if self._is_step[row]:
            return MomentToRescore(self._moments[row].step.action)
        envs = tuple(int(env) for env in np.flatnonzero(self._jumped[row]))
        return MomentToRescore(None, pickle.dumps(self._moments[row].snapshot), envs)

    def add(self, row: int, step: StepResult) -> None:
        """Store the new scores of a row.

        Raises:
            ValueError: the env has other bodies than the record, so the two cannot be compared.
        """
        was = self._moments[row].step.poses
        if step.poses.shape != was.shape:
            raise ValueError(f"the bodies have changed: poses {step.poses.shape}, recorded {was.shape}")
        far = pose_distances(step.poses, was)
        self._drift[row] = np.stack([each.max(axis=1, initial=0.0) for each in far], axis=1)
        self._write(self._new, row, step)
        self._rescored[row] = True
        self._changed.update(self._run[row].tolist())

    def release(self) -> None:
        """Free the moments and their snapshots; `add` must not be called afterwards."""
        self._moments = []

    def curve(self, name: str, env: int) -> RescoredCurve | None:
        """Curve of one number of one env; None if neither version has that number."""
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

    # --- results -----------------------------------------------------------------------------------

    def verdicts(self) -> list[Verdict[PastRun]]:
        """One verdict for each run with a rescored step, over the rescored part of the run."""
        for number in self._changed:
            if (verdict := self._compared(number)) is not None:
                self._verdicts[number] = verdict
        self._changed.clear()
        return [*self._verdicts.values()]

    def names(self) -> tuple[tuple[str, ...], frozenset[str]]:
        """Names for `curve` (``reward`` first, then the differing ones, then the rest), and the set of
        differing names."""
        names = dict.fromkeys(["reward", *self._old, *self._new])
        differing = {name for verdict in self.verdicts() for name in verdict.differing}
        if self._new:
            differing |= self._old.keys() ^ self._new.keys()
        return tuple(sorted(names, key=lambda name: (name != "reward", name not in differing))), frozenset(
            differing
        )

    def _compared(self, number: int) -> Verdict[PastRun] | None:
        """Compare the rescored rows of a run (its jump and its control steps); None for fewer than two rows."""
        env = int(self._run[0].searchsorted(number, side="right")) - 1
        first, end = self._run[:, env].searchsorted([number, number + 1])
        counts = self._rescored[first:end] & self._is_step[first:end]
        counts[0] = self._rescored[first]
        # If no other env jumped during the run, its rows are a slice, which is ten times as fast.
        rows = slice(first, end) if counts.all() else first + counts.nonzero()[0]
        serials = self._serial[rows]
        if len(serials) < 2:
            return None
        old, new = (
            Scores(
                table["reward"][rows, env][1:],
                {name: column[rows, env] for name, column in table.items() if name != "reward"},
                self._has_reward,
            )
            for table in (self._old, self._new)
        )
        begin = int(self._elapsed[serials[0] - self._serial[0], env])
        tick = int(self._tick[serials[0] - self._serial[0]])
        return compare(PastRun(env, begin, serials, tick), old, new, self._drift[rows, env], begin=begin)

    def _write(self, table: dict[str, NDArray[np.float32]], row: int, step: StepResult) -> None:
        for name, value in (("reward", step.reward), *scalar_entries(step.evaluate).items()):
            if name not in table:
                if len(table) > MAX_ENTRIES:
                    continue
                table[name] = np.full(self._jumped.shape, np.nan, np.float32)
            table[name][row] = value

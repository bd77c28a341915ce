"""What new code says of moments that were lived through with the old: the comparison, in plain arrays.

A `Judgement` is begun from a history and filled as the moments come back from the worker that lives through them
again (see `session.judge`). Each is a row: the reward, every number that ``evaluate`` returned, and how far the bodies
are from where they were, since what is judged is the run anew and not the record itself. That drift is what
makes a comparison good or bad, so it is kept for every moment and every env. Where an episode begins at a kept reset
it is mostly zero to the last bit, because the envs get the same physics without a past there (measured: PushCube,
PickCube and StackCube none, PushT 7e-8 m, PushCube with a going back among its moments 6e-8 m). It may grow where the
oldest kept moment is in the middle of an episode, and for tasks whose state a snapshot cannot hold whole (see
`core.snapshot`).

An *episode* here is what one env lived through without a jump, up to its reset or to going back. It is judged as
far as it was recorded, also where the new code would have ended it before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workbench.core.snapshot_bytes import WholeSnapshot
from workbench.core.step import StepResult
from workbench.session.history import History, Moment
from workbench.session.number_text import lost_text

MOST_ENTRIES = 24
"""Entries of ``evaluate`` that are compared; each takes 8 bytes for every moment and env."""
SAME_REWARD = 1e-5
"""Rewards that differ by no more than this share of the largest recorded one count as the same."""
MOST_DIFFERENCES = 200

Flag = Literal["success", "fail"]


@dataclass(frozen=True)
class EpisodeDifference:
    """One episode of one env that is judged otherwise now."""

    env: int
    first: int
    """Serial of its first moment."""
    at: int
    """Serial of the moment to look at: where success or failure is, or else where the reward differs most."""
    success: tuple[int | None, int | None]
    """Steps of the episode at which it was first true, as recorded and now; None for never."""
    fail: tuple[int | None, int | None]
    returns: tuple[float, float]
    """Sums of the rewards, as recorded and now."""
    largest: float
    """The largest change of one reward."""
    drift: float
    """Metres."""


@dataclass(frozen=True)
class Summary:
    """What is known so far."""

    episodes: int
    """Those with at least one judged step."""
    differing: int
    """Of these, those judged otherwise now."""
    differences: tuple[EpisodeDifference, ...]
    """What changed most first: success and failure, then return. At most `MOST_DIFFERENCES`."""
    successes: tuple[int, int] | None
    """Episodes with a success, as recorded and now; None for a task without one."""
    mean_return: tuple[float, float]
    """Of those whose return is finite, as recorded and now; NaN where none is."""
    lost_returns: tuple[str, str]
    """How many are not, as `lost_text` says it."""
    drift_metres: float
    drift_radians: float
    drift_at: tuple[int, int] | None
    """Env and serial where the bodies are furthest from the record; None where nothing drifted."""
    names: tuple[str, ...]
    """What `Judgement.curve` has; ``reward`` first, then what differs, then the rest."""
    differing_names: frozenset[str]


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
        for moment in history.between(history.first, history.last):
            if not self._moments or moment.jumped.any():
                whole = history.whole_at(moment.serial)
                if whole is None:
                    break
                self._snapshots[moment.serial] = whole
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
        self._metres = np.zeros((count, envs), np.float32)
        self._radians = np.zeros((count, envs), np.float32)
        # Episodes by number over the batch: which one each env is in at each row.
        within = np.cumsum(self._jumped, axis=0) - 1
        sizes = within[-1] + 1 if count else np.zeros(0, np.int64)
        self._episode = within + (np.cumsum(sizes) - sizes)
        self._episodes = int(sizes.sum())

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
        ends = [*begins[1:], len(self._moments)]
        return [range(begin, end) for begin, end in zip(begins, ends, strict=True)][::-1]

    def moment(self, row: int) -> Moment:
        return self._moments[row]

    def snapshot(self, row: int) -> tuple[WholeSnapshot, tuple[int, ...]] | None:
        """Where this row is a jump: the snapshot, and the envs to be put back to it."""
        if self._is_step[row]:
            return None
        envs = tuple(int(env) for env in np.flatnonzero(self._jumped[row]))
        return self._snapshots[int(self._serial[row])], envs

    def add(self, row: int, step: StepResult) -> None:
        """What the new code says of this row.

        Raises:
            ValueError: the bodies are not those of the record, so that nothing can be compared.
        """
        was = self._moments[row].step.poses
        if step.poses.shape != was.shape:
            raise ValueError(f"the bodies are others now: poses {step.poses.shape}, were {was.shape}")
        self._metres[row], self._radians[row] = drift(step.poses, was)
        self._write(self._new, row, step)
        self._judged[row] = True

    def let_go(self) -> None:
        """Forget the moments and their snapshots, when no more rows will come."""
        self._moments, self._snapshots = [], {}

    def curve(self, name: str, env: int) -> JudgedCurve | None:
        """One number of one env; None if neither version has one of this name."""
        old, new = self._old.get(name), self._new.get(name)
        if (old is None and new is None) or not 0 <= env < self._jumped.shape[1]:
            return None
        steps, missing = self._is_step, np.full(self.steps, np.nan, np.float32)
        return JudgedCurve(
            self._tick[steps],
            self._serial[steps],
            missing if old is None else old[steps, env],
            missing if new is None else new[steps, env],
        )

    # --- what it comes to --------------------------------------------------------------------------

    def summary(self) -> Summary:
        steps = self._is_step & self._judged
        old, new = self._old.get("reward", self._metres[:0]), self._new.get("reward")
        if new is None or not steps.any():
            return Summary(0, 0, (), None, (0.0, 0.0), ("", ""), 0.0, 0.0, None, ("reward",), frozenset())
        rows, envs = np.nonzero(np.broadcast_to(steps[:, None], self._jumped.shape))
        episode = self._episode[rows, envs]
        change = _difference(new[rows, envs], old[rows, envs])
        largest = self._most(episode, change)
        seen = np.bincount(episode, minlength=self._episodes) > 0
        returns = [np.zeros(self._episodes), np.zeros(self._episodes)]
        for total, values in zip(returns, (old, new), strict=True):
            np.add.at(total, episode, values[rows, envs])
        success, fail = self._first_true("success"), self._first_true("fail")
        scale = np.max(np.abs(old[steps]), initial=0.0, where=np.isfinite(old[steps]))
        otherwise = largest > SAME_REWARD * scale
        for before, now in (success, fail):
            otherwise |= before != now
        otherwise &= seen
        far = self._most(episode, self._metres[rows, envs])
        names = self._names()
        furthest = np.unravel_index(int(np.argmax(self._metres)), self._metres.shape)
        metres = float(self._metres[furthest])
        differences = self._differences(
            otherwise, largest, change, rows, episode, success, fail, returns, far
        )
        return Summary(
            episodes=int(seen.sum()),
            differing=int(otherwise.sum()),
            differences=tuple(differences),
            successes=None
            if "success" not in self._old and "success" not in self._new
            else (int((success[0][seen] >= 0).sum()), int((success[1][seen] >= 0).sum())),
            mean_return=(_mean(returns[0][seen]), _mean(returns[1][seen])),
            lost_returns=(lost_text(returns[0][seen]), lost_text(returns[1][seen])),
            drift_metres=metres,
            drift_radians=float(self._radians.max()),
            drift_at=(int(furthest[1]), int(self._serial[furthest[0]])) if metres > 0 else None,
            names=names,
            differing_names=frozenset(name for name in names if self._differs(name)),
        )

    def _differences(
        self,
        otherwise: NDArray[np.bool_],
        largest: NDArray[np.float64],
        change: NDArray[np.float64],
        rows: NDArray[np.int64],
        episode: NDArray[np.int64],
        success: tuple[NDArray[np.int64], NDArray[np.int64]],
        fail: tuple[NDArray[np.int64], NDArray[np.int64]],
        returns: list[NDArray[np.float64]],
        far: NDArray[np.float64],
    ) -> Iterator[EpisodeDifference]:
        moved = (success[0] != success[1]).astype(int) * 2 + (fail[0] != fail[1])
        by = _difference(returns[1], returns[0])
        order = np.lexsort((-by, -moved))
        order = order[otherwise[order]][:MOST_DIFFERENCES]
        # The row where an episode's reward differs most: of equal ones the first.
        is_largest = change == largest[episode]
        at = np.full(self._episodes, len(self._serial), np.int64)
        np.minimum.at(at, episode[is_largest], rows[is_largest])
        begins, env_of = (
            np.empty(self._episodes, np.int64),
            np.empty(self._episodes, np.int64),
        )
        first_rows, first_envs = np.nonzero(self._jumped)
        begins[self._episode[first_rows, first_envs]] = first_rows
        env_of[self._episode[first_rows, first_envs]] = first_envs
        for number in order:
            row, env = int(at[number]), int(env_of[number])
            for before, now in (success, fail):
                if before[number] != now[number]:
                    row = int(now[number] if now[number] >= 0 else before[number])
                    break
            yield EpisodeDifference(
                env=env,
                first=int(self._serial[begins[number]]),
                at=int(self._serial[row]),
                success=self._steps_at(success, number, env),
                fail=self._steps_at(fail, number, env),
                returns=(float(returns[0][number]), float(returns[1][number])),
                largest=float(largest[number]),
                drift=float(far[number]),
            )

    def _steps_at(
        self, rows: tuple[NDArray[np.int64], NDArray[np.int64]], episode: int, env: int
    ) -> tuple[int | None, int | None]:
        before, now = int(rows[0][episode]), int(rows[1][episode])
        return (
            None if before < 0 else int(self._elapsed[before, env]),
            None if now < 0 else int(self._elapsed[now, env]),
        )

    def _first_true(self, name: Flag) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """For each episode the first judged row at which this was true, as recorded and now; -1 for none."""
        # At a jump only the envs that jumped live through something.
        counts = self._judged[:, None] & (self._is_step[:, None] | self._jumped)
        found: list[NDArray[np.int64]] = []
        for values in (self._old.get(name), self._new.get(name)):
            first = np.full(self._episodes, len(self._serial), np.int64)
            if values is not None:
                rows, envs = np.nonzero(counts & (values > 0.5))
                np.minimum.at(first, self._episode[rows, envs], rows)
            found.append(np.where(first < len(self._serial), first, -1))
        return found[0], found[1]

    def _most(self, episode: NDArray[np.int64], values: NDArray) -> NDArray[np.float64]:
        most = np.zeros(self._episodes)
        np.maximum.at(most, episode, values)
        return most

    def _names(self) -> tuple[str, ...]:
        names = list(dict.fromkeys([*self._old, *self._new]))
        return ("reward", *sorted((n for n in names if n != "reward"), key=lambda n: not self._differs(n)))

    def _differs(self, name: str) -> bool:
        old, new = self._old.get(name), self._new.get(name)
        if old is None or new is None:
            return True
        rows = self._is_step & self._judged
        scale = np.max(np.abs(old[rows]), initial=0.0, where=np.isfinite(old[rows]))
        return bool((_difference(new[rows], old[rows]) > SAME_REWARD * scale).any())

    def _write(self, table: dict[str, NDArray[np.float32]], row: int, step: StepResult) -> None:
        for name, value in (("reward", step.reward), *_numbers(step)):
            if name not in table:
                if len(table) > MOST_ENTRIES:
                    continue
                table[name] = np.full(self._jumped.shape, np.nan, np.float32)
            table[name][row] = value


def drift(
    now: NDArray[np.float32], was: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How far the bodies of each env are from where they were: (N,) metres and (N,) radians of the furthest.

    Args:
        now, was: (N, B, 7) as `StepResult.poses`; a body that an env does not have is NaN in both.
    """
    a, b = now.astype(np.float64), was.astype(np.float64)
    metres = np.linalg.norm(a[..., :3] - b[..., :3], axis=-1)
    # The angle from the chord between the quaternions: the arc cosine of their product cannot tell angles
    # below 3e-4 from none in single precision. q and -q are the same rotation.
    same = np.where((a[..., 3:] * b[..., 3:]).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0)
    chord = np.linalg.norm(a[..., 3:] - same * b[..., 3:], axis=-1)
    radians = 4 * np.arcsin(np.clip(chord / 2, 0, 1))
    absent = np.isnan(a).any(axis=-1) & np.isnan(b).any(axis=-1)
    for values in (metres, radians):
        values[absent] = 0.0
        values[np.isnan(values)] = np.inf
    return metres.max(axis=1, initial=0.0), radians.max(axis=1, initial=0.0)


def _numbers(step: StepResult) -> Iterator[tuple[str, NDArray]]:
    """The entries of ``evaluate`` that are one number or flag for each env."""
    count = len(step.reward)
    for name, values in step.evaluate.items():
        if values.dtype.kind in "fiub" and values.shape in ((count,), (count, 1)):
            yield name, values.reshape(count)


def _mean(values: NDArray) -> float:
    """Of those that are finite; NaN where none is."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else float("nan")


def _difference(new: NDArray, old: NDArray) -> NDArray[np.float64]:
    """How far apart; infinite where one is not a number, zero where both are not or are the same infinity."""
    with np.errstate(invalid="ignore"):
        apart = np.abs(np.asarray(new, np.float64) - np.asarray(old, np.float64))
    apart[(np.isnan(new) & np.isnan(old)) | (new == old)] = 0.0
    return np.where(np.isnan(apart), np.inf, apart)

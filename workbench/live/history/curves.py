"""Numbers of all envs over all steps, as arrays for curves and the time slider."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.envs.step_result import TERM_PREFIX, StepResult

MAX_COLUMNS = 64
"""Maximum number of columns: the first ones of `columns_of` are kept."""
MAX_PARTS = 8
"""Maximum number of numbers in one entry; a longer entry has no curve."""
_MAX_SPANS = 400
"""Maximum number of spans of a curve, two points each: more do not fit into the panel's 300 pixels."""
_MAX_SPANS_TIMES_ENVS = 2**17
"""Limit of spans times envs: with `MAX_COLUMNS` columns of 17 bytes the curves take at most 140 MB, 7 MB for 16 envs."""
_MIN_SPANS = 64
_FIRST_ROWS = 1024


class Columns:
    """Columns of numbers by name, each (rows, N). Rows are numbered upwards; the oldest are dropped when space runs out.

    Curves are drawn several times a second: reading them from some thousand moments would take longer than a step.
    """

    def __init__(self, num_envs: int, first: int = 0) -> None:
        """
        Args:
            first: the number of the first row.
        """
        self._num_envs, self._base, self._room = num_envs, first, _FIRST_ROWS
        self._columns: dict[str, NDArray[np.float32]] = {}

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._columns)

    def write(self, number: int, oldest: int, values: Mapping[str, ArrayLike]) -> None:
        """
        Args:
            number: the row to write: the newest one, or the one after it.
            oldest: number of the oldest row to keep.
            values: (N,) by name of the column; missing columns become NaN in this row.
        """
        if number - self._base == self._room:
            kept = slice(oldest - self._base, self._room)
            self._base, self._room = oldest, max(_FIRST_ROWS, 2 * (number - oldest))
            before, self._columns = self._columns, {}
            for name, column in before.items():
                if not np.isnan(column[kept]).all():
                    self._new(name)[: number - oldest] = column[kept]
        for name in values:
            if name not in self._columns:
                self._new(name)
        for name, column in self._columns.items():
            column[number - self._base] = values.get(name, np.nan)

    def between(self, name: str, low: int, high: int) -> NDArray[np.float32]:
        """(K, N) values of the rows `low` to `high` inclusive, which must be kept; NaN if there is no such column.

        A view, not a copy: it changes if one of these rows is written again.
        """
        rows = slice(low - self._base, max(low, high + 1) - self._base)
        column = self._columns.get(name)
        if column is None:
            return np.full((rows.stop - rows.start, self._num_envs), np.nan, np.float32)
        return column[rows]

    def _new(self, name: str) -> NDArray[np.float32]:
        column = self._columns[name] = np.full((self._room, self._num_envs), np.nan, np.float32)
        return column


# --- which numbers have a curve -----------------------------------------------------------------------


class Group(Enum):
    """Group of a column."""

    REWARD = "reward"
    TERM = "reward term"
    EVALUATE = "evaluate"
    JOINT = "joint"


class Column(NamedTuple):
    """A number of each env that changes over the steps."""

    group: Group
    name: str
    part: int | None = None
    """Index of the number in an entry with several."""

    @property
    def label(self) -> str:
        return self.name if self.part is None else f"{self.name}[{self.part}]"


REWARD = Column(Group.REWARD, "reward")
SUCCESS = Column(Group.EVALUATE, "success")


def columns_of(step: StepResult, joints: Sequence[str] = ()) -> dict[Column, NDArray]:
    """(N,) values of each column that a step has: the reward, success, the reward's terms, ``evaluate``, the joints.

    Args:
        joints: names of `StepResult.qpos`.
    """
    num_envs = len(step.reward)
    found: dict[Column, NDArray] = {REWARD: step.reward}
    terms: dict[Column, NDArray] = {}
    entries: dict[Column, NDArray] = {}
    for name, values in step.evaluate.items():
        if name.startswith(TERM_PREFIX):
            if values.size == num_envs:
                terms[Column(Group.TERM, name.removeprefix(TERM_PREFIX))] = values.reshape(num_envs)
            continue
        if not values.size:
            continue
        flat = values.reshape(num_envs, -1)
        if name == SUCCESS.name:
            found[SUCCESS] = flat[:, 0]
        elif flat.shape[1] == 1:
            entries[Column(Group.EVALUATE, name)] = flat[:, 0]
        elif flat.shape[1] <= MAX_PARTS:
            entries |= {Column(Group.EVALUATE, name, k): flat[:, k] for k in range(flat.shape[1])}
    for name, entry in step.others.items():
        if entry.numbers is not None and entry.numbers.size == 1 and not name.startswith(TERM_PREFIX):
            entries[Column(Group.EVALUATE, name)] = np.broadcast_to(entry.numbers.reshape(-1), num_envs)
    moved = () if step.qpos is None else step.qpos.T
    positions = {Column(Group.JOINT, name): values for name, values in zip(joints, moved, strict=False)}
    return {**found, **terms, **entries, **positions}


def without_curve(step: StepResult) -> tuple[str, ...]:
    """Names of the reward's terms that are not one number per env."""
    there = {column.name for column in columns_of(step) if column.group is Group.TERM}
    named = [
        name
        for name in [*step.evaluate, *step.others]
        if name.startswith(TERM_PREFIX) or name == TERM_PREFIX[:-1]
    ]
    return tuple(
        name.removeprefix(TERM_PREFIX) for name in named if name.removeprefix(TERM_PREFIX) not in there
    )


# --- all steps in bounded memory ----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Spans:
    """L lines over steps, cut into B spans of equal width. The minimum and maximum of each span are kept, so that a peak of
    one step stays visible."""

    width: int
    """Steps of a span; the last one may have fewer."""
    end: int
    """The last step. The first one of span k is ``k * width + first``."""
    low: NDArray[np.floating]
    high: NDArray[np.floating]
    """(L, B) least and greatest finite number; NaN if there is none."""
    low_at: NDArray[np.int32]
    high_at: NDArray[np.int32]
    """(L, B) the first step with the least number, the last step with the greatest."""
    gap: NDArray[np.bool_]
    """(L, B) whether some number is NaN or infinite."""
    last: NDArray[np.floating]
    """(L,) numbers at the last step."""
    first: int = 1

    def points(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(K,) steps and (L, K) numbers to draw.

        The steps are those of the first line's extremes, so that its points are exact; points of the other lines are off
        by less than a span. NaN where a line has a gap.
        """
        lines, count = self.low.shape
        starts = self.first + self.width * np.arange(count)
        if not count or not lines:
            return np.zeros(0), np.zeros((lines, 0))
        if self.width == 1:
            return starts.astype(np.float64), self.low.astype(np.float64)
        rises = self.low_at <= self.high_at
        values = np.full((lines, count, 3), np.nan)
        values[..., 0] = np.where(rises, self.low, self.high)
        values[..., 1] = np.where(rises, self.high, self.low)
        values[..., 2] = np.where(self.gap, np.nan, values[..., 1])
        known = np.isfinite(self.low[0])
        at = np.zeros((count, 3))
        at[:, 0] = np.where(known, np.minimum(self.low_at[0], self.high_at[0]), starts)
        at[:, 1] = np.where(known, np.maximum(self.low_at[0], self.high_at[0]), starts)
        at[:, 2] = at[:, 1] + 0.5
        wanted = np.ones((count, 3), bool)
        wanted[:, 1] = at[:, 1] > at[:, 0]
        wanted[:, 2] = self.gap.any(axis=0)
        x, drawn = at[wanted], values[:, wanted]
        if x[-1] < self.end:
            x = np.append(x, float(self.end))
            last = np.where(np.isfinite(self.last), self.last, np.nan)
            drawn = np.concatenate([drawn, last[:, None].astype(np.float64)], axis=1)
        return x, drawn


def spans_of(values: NDArray[np.floating], most: int = _MAX_SPANS, first: int = 1) -> Spans:
    """The spans of whole lines (L, T), at most `most` of them; equal to those that `StepCurves` builds step by step.

    Args:
        first: the step of the first number.
    """
    lines, count = values.shape
    width = 1
    while -(-count // width) > most:
        width *= 2
    spans = -(-count // width)
    padded = np.full((lines, spans * width), np.nan, values.dtype)
    padded[:, :count] = values
    cut = padded.reshape(lines, spans, width)
    finite = np.isfinite(cut)
    some = finite.any(axis=2)
    low, high = np.where(finite, cut, np.inf), np.where(finite, cut, -np.inf)
    starts = first + width * np.arange(spans)
    inside = (np.arange(spans * width) < count).reshape(spans, width)
    return Spans(
        width,
        first + count - 1,
        np.where(some, low.min(axis=2, initial=np.inf), np.nan),
        np.where(some, high.max(axis=2, initial=-np.inf), np.nan),
        np.where(some, starts + low.argmin(axis=2), 0).astype(np.int32),
        np.where(some, starts + width - 1 - high[..., ::-1].argmax(axis=2), 0).astype(np.int32),
        (~finite & inside).any(axis=2),
        values[:, -1] if count else np.full(lines, np.nan),
        first,
    )


@dataclass(frozen=True, eq=False)
class Curves:
    """Curves of one env and of the mean over the batch, over all control steps."""

    serial: int
    """Control steps so far, resets left out: the step of the newest numbers. The first is 1, as in a recording."""
    env: int
    columns: tuple[Column, ...]
    spans: Spans
    """Two lines for each of `columns`, in turn: the env's, and the mean of the envs whose number is finite."""
    newest: NDArray[np.float32]
    """(N,) rewards of the newest step."""
    no_curve: tuple[str, ...] = ()
    """Names of the last step's reward terms that are not one number per env."""

    def lines(self, wanted: Sequence[tuple[Column, bool]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(K,) steps and (L, K) numbers of these columns, each of the env or (True) the mean; NaN for a missing column.
        See `Spans.points`."""
        places = {column: 2 * k for k, column in enumerate(self.columns)}
        rows = [places[column] + mean for column, mean in wanted]
        of = self.spans
        picked: list[Any] = [part[rows] for part in (of.low, of.high, of.low_at, of.high_at, of.gap, of.last)]
        return Spans(of.width, of.end, *picked, first=of.first).points()


_Parts = tuple[NDArray, NDArray, NDArray, NDArray, NDArray]
"""``low``, ``high``, ``low_at``, ``high_at`` and ``gap`` of spans, each (N + 1, C, B); the last row is the mean."""


class StepCurves:
    """The numbers of all envs over all control steps, in bounded memory: when the spans are full, each two are joined into
    one of twice the width."""

    def __init__(self, num_envs: int, joints: Sequence[str] = ()) -> None:
        """
        Args:
            joints: names of `StepResult.qpos`.
        """
        self._num_envs, self._joints = num_envs, tuple(joints)
        self._most = min(_MAX_SPANS, max(_MIN_SPANS, _MAX_SPANS_TIMES_ENVS // (num_envs + 1))) // 2 * 2
        self._columns: list[Column] = []
        self._width = 1
        self._parts = self._empty(0)
        self._last = np.full((num_envs + 1, 0), np.nan, np.float32)
        self._newest = np.full(num_envs, np.nan, np.float32)
        self._no_curve: tuple[str, ...] = ()
        self._found: Curves | None = None
        self.count = 0
        """Control steps so far."""

    def add(self, step: StepResult) -> None:
        """Add a control step; do not add resets, since they have no reward."""
        found = columns_of(step, self._joints)
        self._no_curve, self._newest, self._found = without_curve(step), step.reward, None
        self._make_columns(found)
        values = np.full((self._num_envs + 1, len(self._columns)), np.nan, np.float32)
        for k, column in enumerate(self._columns):
            if column in found:
                values[:-1, k] = found[column]
        values[-1] = mean_of_numbers(values[:-1])
        if self.count // self._width == self._most:
            self._join()
        span = self.count // self._width
        self.count += 1
        low, high, low_at, high_at, gap = (part[..., span] for part in self._parts)
        finite = np.isfinite(values)
        lower, higher = finite & ~(low <= values), finite & ~(high > values)
        low[lower], high[higher] = values[lower], values[higher]
        low_at[lower] = high_at[higher] = self.count
        gap |= ~finite
        self._last = values

    def curves(self, env: int) -> Curves:
        """Curves of one env, as copies, since spans change until they are full and when they are joined."""
        if self._found is None or self._found.env != env:
            rows, used = [min(env, self._num_envs - 1), self._num_envs], -(-self.count // self._width)

            def taken(part: NDArray) -> NDArray:
                return part[rows].swapaxes(0, 1).reshape(2 * len(self._columns), *part.shape[2:])

            low, high, low_at, high_at, gap = (taken(part[..., :used]) for part in self._parts)
            last = taken(self._last)
            spans = Spans(self._width, self.count, low, high, low_at, high_at, gap, last)
            columns = tuple(self._columns)
            self._found = Curves(self.count, env, columns, spans, self._newest, self._no_curve)
        return self._found

    def _make_columns(self, found: Mapping[Column, NDArray]) -> None:
        new = [column for column in found if column not in self._columns]
        if not new:
            return
        if len(self._columns) + len(new) > MAX_COLUMNS:
            # Drop columns that a new version of the task no longer has.
            places = [k for k, column in enumerate(self._columns) if column in found]
            self._columns = [self._columns[k] for k in places]
            low, high, low_at, high_at, gap = (part[:, places] for part in self._parts)
            self._parts = low, high, low_at, high_at, gap
        new = new[: MAX_COLUMNS - len(self._columns)]
        self._columns += new
        self._extend(self._parts, self._empty(len(new)), axis=1)

    def _join(self) -> None:
        """Join each two spans."""
        self._width *= 2
        left, right = ([part[..., side::2] for part in self._parts] for side in (0, 1))
        lower = np.isnan(left[0]) | (right[0] < left[0])
        higher = np.isnan(left[1]) | (right[1] >= left[1])
        joined = (
            np.where(lower, right[0], left[0]),
            np.where(higher, right[1], left[1]),
            np.where(lower, right[2], left[2]),
            np.where(higher, right[3], left[3]),
            left[4] | right[4],
        )
        low, high, low_at, high_at, gap = (
            part[..., self._most // 2 :] for part in self._empty(len(self._columns))
        )
        self._extend(joined, (low, high, low_at, high_at, gap), axis=2)

    def _extend(self, parts: _Parts, further: _Parts, axis: int) -> None:
        low, high, low_at, high_at, gap = (
            np.concatenate(pair, axis=axis) for pair in zip(parts, further, strict=True)
        )
        self._parts = low, high, low_at, high_at, gap

    def _empty(self, columns: int) -> _Parts:
        shape = self._num_envs + 1, columns, self._most
        low, high = (np.full(shape, np.nan, np.float32) for _ in range(2))
        low_at, high_at = (np.zeros(shape, np.int32) for _ in range(2))
        return low, high, low_at, high_at, np.zeros(shape, bool)


def mean_of_numbers(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(...) mean of (N, ...) over the envs with a finite value; NaN where there is none."""
    there = np.isfinite(values)
    total, count = np.where(there, values, 0.0).sum(axis=0, dtype=np.float64), there.sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)

"""Numbers of all envs over all steps, as arrays for curves and the time slider."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.envs.step_result import TERM_PREFIX, StepResult

MAX_PARTS = 8
"""Maximum number of numbers in one entry; a longer entry has no curve."""
_MAX_SPANS = 400
"""Maximum number of spans of a curve, two points each: more do not fit into the panel's 300 pixels."""
_FIRST_ROWS = 1024


class Columns:
    """Columns of numbers by name, each (rows, N). Rows are numbered upwards; the oldest rows are dropped when
    space runs out.

    Curves are drawn several times a second: collecting their numbers from some thousand moments would take
    longer than a step.
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
            number: number of the row to write: the newest row, or the row after it.
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
    FORCE = "contact force"


class Column(NamedTuple):
    """A number of each env that changes over the steps."""

    group: Group
    name: str
    part: int | None = None
    """Index of the number in an entry with several numbers; None if the entry has only one."""

    @property
    def label(self) -> str:
        return self.name if self.part is None else f"{self.name}[{self.part}]"


REWARD = Column(Group.REWARD, "reward")
SUCCESS = Column(Group.EVALUATE, "success")


def force_column(body: str, other: str) -> Column:
    """The column of the contact force between two bodies."""
    return Column(Group.FORCE, f"force between {body} and {other}")


def columns_of(step: StepResult, joints: Sequence[str] = ()) -> dict[Column, NDArray]:
    """(N,) values of each column that a step has: the reward, success, the reward's terms, ``evaluate``, the joints, watched
    forces.

    Args:
        joints: names of the joints of `StepResult.qpos`.
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
    forces = {force_column(*pair): newtons for pair, newtons in step.forces.items()}
    return {**found, **terms, **entries, **positions, **forces}


def columns_by_label(step: StepResult, joints: Sequence[str] = ()) -> dict[str, Column]:
    """The columns of `columns_of` by a unique label: a reward term and an entry of evaluate may have the same name."""
    found: dict[str, Column] = {}
    for column in columns_of(step, joints):
        found[column.label if column.label not in found else f"{column.group.value} {column.label}"] = column
    return found


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


def number_of(step: StepResult, column: Column, env: int, joints: Sequence[str] = ()) -> float:
    """The number of one env in one column of `columns_of`; NaN if the step has none."""
    group, name, part = column
    if group is Group.REWARD:
        return float(step.reward[env])
    if group is Group.JOINT:
        return (
            float("nan")
            if step.qpos is None or name not in joints
            else float(step.qpos[env, joints.index(name)])
        )
    if group is Group.FORCE:
        newtons = [values[env] for pair, values in step.forces.items() if force_column(*pair) == column]
        return float(newtons[0]) if newtons else float("nan")
    values = step.evaluate.get(TERM_PREFIX + name if group is Group.TERM else name)
    if values is not None and values.size:
        flat = values.reshape(len(step.reward), -1)
        return float(flat[env, part or 0]) if (part or 0) < flat.shape[1] else float("nan")
    other = step.others.get(name)
    there = other is not None and other.numbers is not None and other.numbers.size == 1
    return (
        float(other.numbers.reshape(-1)[0]) if there and other and other.numbers is not None else float("nan")
    )


# --- few points for many steps ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Spans:
    """L lines, with one number per step, cut into B spans of equal width. The minimum and maximum of each
    span are kept, so that a peak of one step stays visible."""

    width: int
    """Number of steps in a span; the last span may have fewer."""
    end: int
    """The last step of the lines. Span k begins at step ``k * width + first``."""
    low: NDArray[np.floating]
    high: NDArray[np.floating]
    """(L, B) least and greatest finite number in each span; NaN if there is none."""
    low_at: NDArray[np.int32]
    high_at: NDArray[np.int32]
    """(L, B) the first step with the least number, and the last step with the greatest number."""
    gap: NDArray[np.bool_]
    """(L, B) whether some number is NaN or infinite."""
    last: NDArray[np.floating]
    """(L,) numbers at the last step."""
    first: int = 1

    def points(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(K,) steps and (L, K) numbers to draw.

        The steps are those of the first line's extremes. So only this line's points are exact; the points of
        the other lines are shifted by less than a span. Numbers are NaN where a line has a gap.
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
    """Cut lines into at most `most` spans.

    Args:
        values: (L, T) the whole lines.
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

"""Rerun's chunks, one an entity: what is static, poses and numbers in time.

Rerun's own archetypes check and convert what they are given, which for a few hundred rows takes longer than making the chunk. So of
those they are asked once what their columns are called and of which Arrow type they are, and the columns of every episode are made
from that.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

STEP = "step"
SIM_TIME = "sim_time"
_MOST_TIMES = 64
SERIES_COLORS = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (213, 94, 0),
    (0, 114, 178),
    (150, 150, 150),
    (136, 100, 220),
)
"""Okabe and Ito's palette, which the colour-blind can tell apart, with grey and violet for its black and
yellow: the viewer comes dark and light, and each of those vanishes on one of the two."""


def telling(values: NDArray) -> NDArray[np.int64] | None:
    """Which rows of `values` (R, D) say something; None for all of them.

    A row between two equal ones says nothing: whoever looks there finds the one before, and a curve is the same line.
    A row of one number takes 20 bytes in the file besides that number, and most flags of a task change once in an episode. The
    first and the last row always stay, so that an entity is there for as long as it was recorded.
    """
    if len(values) < 3:
        return None
    bits = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), -1)  # NaN equals NaN
    again = (bits[1:] == bits[:-1]).all(axis=1)
    silent = again[:-1] & again[1:]
    if not silent.any():
        return None
    return np.concatenate([[0], 1 + np.flatnonzero(~silent), [len(values) - 1]])


def static_chunk(entity: str, *values: Any) -> Chunk:
    """`values` as what `entity` is all through.

    Raises:
        ValueError: rerun refuses one of them.
    """
    batches = [batch for value in values for batch in value.as_component_batches()]
    columns = [batch.partition([len(batch.as_arrow_array())]) for batch in batches]
    return Chunk.from_columns(entity, [], columns)


@lru_cache(maxsize=512)
def series_chunk(entity: str, names: tuple[str, ...], first_color: int = 0) -> Chunk:
    """Name and colour of each number of the batched scalars of `entity`."""
    # Left to itself rerun gives all series of an entity one colour, and entities of one folder much the same.
    colors = [SERIES_COLORS[(first_color + index) % len(SERIES_COLORS)] for index in range(len(names))]
    return static_chunk(entity, rr.SeriesLines(names=list(names), colors=colors))


@dataclass(frozen=True)
class _Column:
    """What rerun's ``ComponentColumn`` is, of an array that is Arrow's already."""

    descriptor: rr.ComponentDescriptor
    values: pa.Array

    def component_descriptor(self) -> rr.ComponentDescriptor:
        return self.descriptor

    def as_arrow_array(self) -> pa.Array:
        return self.values


@cache
def _pose_columns() -> tuple[tuple[rr.ComponentDescriptor, pa.DataType], ...]:
    one = rr.Transform3D.columns(translation=np.zeros((1, 3)), quaternion=np.zeros((1, 4)))
    return tuple((column.component_descriptor(), column.as_arrow_array().type) for column in one)


@cache
def _number_column() -> tuple[rr.ComponentDescriptor, pa.DataType]:
    (one,) = rr.Scalars.columns(scalars=np.zeros(1))
    return one.component_descriptor(), one.as_arrow_array().type


def _lists(numbers: NDArray, kind: pa.DataType, per_row: int) -> pa.Array:
    """`numbers`, all of them, as rows of `kind` with `per_row` elements each, which may be fixed lists themselves."""
    # Rows of a journal lie as they came, at any byte: Arrow takes them over as they lie, and rerun ends the process (seen).
    flat = pa.array(np.require(numbers.reshape(-1), requirements=["C", "A"]))
    if pa.types.is_fixed_size_list(kind.value_type):
        flat = pa.FixedSizeListArray.from_arrays(flat, type=kind.value_type)
    begins = np.arange(0, len(flat) + 1, per_row, dtype=np.int32)
    return pa.ListArray.from_arrays(pa.array(begins), flat, type=kind)


class TimedChunks:
    """Chunks on both timelines of an episode."""

    def __init__(self, control_dt: float) -> None:
        """`control_dt` in seconds."""
        self._control_dt = control_dt
        self._times: dict[
            bytes, list[rr.TimeColumn]
        ] = {}  # by their steps, which most entities of a piece share

    def of(self, entity: str, steps: NDArray[np.int64], columns: Iterable[Any]) -> Chunk:
        """`columns` with a row for each of `steps` (R,)."""
        return Chunk.from_columns(entity, self._times_of(steps), columns)

    def pose(
        self,
        entity: str,
        steps: NDArray[np.int64],
        translation: NDArray[np.float32],
        xyzw: NDArray[np.float32],
    ) -> Chunk:
        """`translation` (len(steps), 3) and `xyzw` (len(steps), 4); rows that `telling` leaves out are."""
        rows = telling(np.concatenate([translation, xyzw], axis=1))
        if rows is not None:
            steps, translation, xyzw = steps[rows], translation[rows], xyzw[rows]
        columns = [
            _Column(descriptor, _lists(values.astype(np.float32, copy=False), kind, 1))
            for (descriptor, kind), values in zip(_pose_columns(), (translation, xyzw))
        ]
        return self.of(entity, steps, columns)

    def scalars(self, entity: str, steps: NDArray[np.int64], values: NDArray) -> Chunk:
        """`values` (len(steps), ...), all of a step as one batch, at least one; rows that `telling` leaves out are."""
        flat = np.asarray(values, dtype=np.float64).reshape(len(steps), -1)
        rows = telling(flat)
        if rows is not None:
            steps, flat = steps[rows], flat[rows]
        descriptor, kind = _number_column()
        return self.of(entity, steps, [_Column(descriptor, _lists(flat, kind, flat.shape[1]))])

    def _times_of(self, steps: NDArray[np.int64]) -> list[rr.TimeColumn]:
        key = steps.tobytes()
        if key not in self._times:
            if len(self._times) >= _MOST_TIMES:
                self._times.clear()
            self._times[key] = [
                rr.TimeColumn(STEP, sequence=steps),
                # Whole nanoseconds by rounding: rerun itself cuts off, and 3 * 0.05 s would be 149999999 ns.
                rr.TimeColumn(
                    SIM_TIME, duration=np.rint(steps * self._control_dt * 1e9).astype("timedelta64[ns]")
                ),
            ]
        return self._times[key]


def still_pose(entity: str, translation: NDArray[np.float32], xyzw: NDArray[np.float32]) -> Chunk:
    """The one pose, (3,) and (4,), of what never moves."""
    return static_chunk(entity, rr.Transform3D(translation=translation, quaternion=rr.Quaternion(xyzw=xyzw)))

"""Makes rerun's chunks: static values, poses and numbers over time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
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
LOOK = "look"
"""Component of a visual, JSON: its name, its colour (RGBA), metallic and roughness."""
_MAX_CACHED_STEPS = 2000
"""Maximum number of steps whose times are cached: the times of hours of recording would take a hundred
megabytes for the life of the process."""
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
"""Okabe and Ito's palette for colour-blind people, with grey and violet instead of black and yellow, which are
invisible in the viewer's dark or light theme."""


def changed_rows(values: NDArray) -> list[NDArray[np.int64] | None]:
    """Rows of `values` (K, R, D) to write, for each of the K series; None for all rows.

    A row that equals both neighbours is left out: the previous row stays valid, and the curve is the same.
    This saves 20 bytes and the number itself for a row of one number; most flags change once per episode. The
    first and the last row always stay, so that the entity covers the recorded time.
    """
    count, rows = values.shape[:2]
    if rows < 3 or not values.size:
        return [None] * count
    bits = np.ascontiguousarray(values).view(np.uint8).reshape(count, rows, -1)  # NaN equals NaN
    again = (bits[:, 1:] == bits[:, :-1]).all(axis=2)
    silent = again[:, :-1] & again[:, 1:]
    return [
        np.concatenate([[0], 1 + np.flatnonzero(~of_one), [rows - 1]]) if some else None
        for of_one, some in zip(silent, silent.any(axis=1))
    ]


def static_chunk(entity: str, *values: Any) -> Chunk:
    """A chunk with static `values` of `entity`.

    Raises:
        ValueError: rerun refuses a value.
    """
    batches = [batch for value in values for batch in value.as_component_batches()]
    columns = [batch.partition([len(batch.as_arrow_array())]) for batch in batches]
    return Chunk.from_columns(entity, [], columns)


def property_chunk(name: str, values: Mapping[str, Any]) -> Chunk:
    """A property of the whole recording; None values are left out, and a list is several values."""
    columns: list[Any] = [
        _Column(rr.ComponentDescriptor(key), pa.array([value if isinstance(value, list) else [value]]))
        for key, value in values.items()
        if value is not None
    ]
    return Chunk.from_columns(rr.new_entity_path(["__properties", name]), [], columns)


@lru_cache(maxsize=512)
def series_chunk(entity: str, names: tuple[str, ...], first_color: int = 0) -> Chunk:
    """A chunk with the names and colours of the curves of `entity`, which has one curve per name.

    Args:
        first_color: index in `SERIES_COLORS` of the first curve's colour.
    """
    # By default rerun gives all series of an entity one colour, and the entities of a folder similar colours.
    colors = [SERIES_COLORS[(first_color + index) % len(SERIES_COLORS)] for index in range(len(names))]
    return static_chunk(entity, rr.SeriesLines(names=list(names), colors=colors))


@dataclass(frozen=True)
class _Column:
    """Replacement of rerun's ``ComponentColumn`` for an Arrow array.

    Rerun's archetypes validate and convert their arguments, which for a few hundred rows takes longer than making the
    chunk. So each archetype is called only once, to get the names and Arrow types of its columns.
    """

    descriptor: rr.ComponentDescriptor
    values: pa.Array

    def component_descriptor(self) -> rr.ComponentDescriptor:
        return self.descriptor

    def as_arrow_array(self) -> pa.Array:
        return self.values


def lists_column(name: str, numbers: NDArray, counts: NDArray[np.int64]) -> _Column:
    """A component of the workbench's own: row r has ``counts[r]`` of the `numbers` (sum of counts,)."""
    offsets = pa.array(np.cumsum([0, *counts], dtype=np.int32))
    return _Column(rr.ComponentDescriptor(name), pa.ListArray.from_arrays(offsets, pa.array(numbers)))


@cache
def _pose_columns() -> tuple[tuple[rr.ComponentDescriptor, pa.DataType], ...]:
    one = rr.Transform3D.columns(translation=np.zeros((1, 3)), quaternion=np.zeros((1, 4)))
    return tuple((column.component_descriptor(), column.as_arrow_array().type) for column in one)


@cache
def _number_column() -> tuple[rr.ComponentDescriptor, pa.DataType]:
    (one,) = rr.Scalars.columns(scalars=np.zeros(1))
    return one.component_descriptor(), one.as_arrow_array().type


@cache
def _text_columns() -> tuple[tuple[rr.ComponentDescriptor, pa.DataType], ...]:
    one = rr.TextLog.columns(text=[""], level=[""])
    return tuple((column.component_descriptor(), column.as_arrow_array().type) for column in one)


def _lists(numbers: NDArray, kind: pa.DataType, per_row: int) -> pa.Array:
    """`numbers` as rows of type `kind` with `per_row` elements each; an element may be a fixed-size list."""
    # Rows of a journal may be unaligned. Arrow would use them without a copy, and rerun would abort the
    # process (observed).
    flat = pa.array(np.require(numbers.reshape(-1), requirements=["C", "A"]))
    if pa.types.is_fixed_size_list(kind.value_type):
        flat = pa.FixedSizeListArray.from_arrays(flat, type=kind.value_type)
    return pa.ListArray.from_arrays(_begins(len(flat), per_row), flat, type=kind)


@lru_cache(maxsize=256)
def _begins(count: int, per_row: int) -> pa.Array:
    return pa.array(np.arange(0, count + 1, per_row, dtype=np.int32))


class TimedChunks:
    """Makes chunks on both timelines of an episode."""

    def __init__(self, control_dt: float) -> None:
        """`control_dt` in seconds."""
        self._control_dt = control_dt

    def of(self, entity: str, steps: NDArray[np.int64], columns: Iterable[Any]) -> Chunk:
        """A chunk of `columns` with a row for each of `steps` (R,)."""
        return Chunk.from_columns(entity, _times_of(steps, self._control_dt), columns)

    def poses(
        self, entities: Sequence[str], steps: NDArray[np.int64], poses: NDArray[np.float32]
    ) -> Iterator[Chunk]:
        """Chunks of `poses` (len(steps), len(entities), 7), translation and xyzw; only `changed_rows`."""
        if not entities:
            return
        by_entity = np.ascontiguousarray(poses.transpose(1, 0, 2), dtype=np.float32)
        everything = np.arange(len(steps))
        changed = [everything if rows is None else rows for rows in changed_rows(by_entity)]
        written = np.concatenate([values[rows] for values, rows in zip(by_entity, changed)])
        # One Arrow array for all entities, because making an array takes longer than copying a hundred poses.
        parts = written[:, :3], written[:, 3:]
        columns = [(about, _lists(part, kind, 1)) for (about, kind), part in zip(_pose_columns(), parts)]
        begin = 0
        for entity, rows in zip(entities, changed):
            own = [_Column(about, column.slice(begin, len(rows))) for about, column in columns]
            yield self.of(entity, steps[rows], own)
            begin += len(rows)

    def scalars(self, entity: str, steps: NDArray[np.int64], values: NDArray) -> Chunk:
        """A chunk of `values` (len(steps), ...): one batch per step, of at least one number; only
        `changed_rows`."""
        flat = np.asarray(values, dtype=np.float64).reshape(len(steps), -1)
        (rows,) = changed_rows(flat[None])
        if rows is not None:
            steps, flat = steps[rows], flat[rows]
        descriptor, kind = _number_column()
        return self.of(entity, steps, [_Column(descriptor, _lists(flat, kind, flat.shape[1]))])

    def texts(self, entity: str, lines: Sequence[tuple[int, str, str]]) -> Chunk:
        """A chunk with a log line for each (step, level, text)."""
        steps, levels, texts = zip(*lines)
        columns = [
            _Column(descriptor, pa.array([[text] for text in column], kind))
            for (descriptor, kind), column in zip(_text_columns(), (texts, levels))
        ]
        return self.of(entity, np.array(steps, dtype=np.int64), columns)


def _times_of(steps: NDArray[np.int64], control_dt: float) -> tuple[rr.TimeColumn, ...]:
    if len(steps) > _MAX_CACHED_STEPS:
        return _times(steps, control_dt)
    return _kept_times(np.asarray(steps, np.int64).tobytes(), control_dt)


@lru_cache(maxsize=64)
def _kept_times(steps: bytes, control_dt: float) -> tuple[rr.TimeColumn, ...]:
    """Cached times: shared by most entities, and by the next episode of the same length."""
    return _times(np.frombuffer(steps, np.int64), control_dt)


def _times(steps: NDArray[np.int64], control_dt: float) -> tuple[rr.TimeColumn, ...]:
    # Rounded, because rerun truncates: 3 * 0.05 s would be 149999999 ns.
    seconds = np.rint(steps * control_dt * 1e9).astype("timedelta64[ns]")
    return rr.TimeColumn(STEP, sequence=steps), rr.TimeColumn(SIM_TIME, duration=seconds)


def static_pose(entity: str, translation: NDArray[np.float32], xyzw: NDArray[np.float32]) -> Chunk:
    """A chunk with the pose, (3,) and (4,), of an entity that never moves."""
    return _static_pose(entity, tuple(translation.tolist()), tuple(xyzw.tolist()))


@lru_cache(maxsize=512)
def _static_pose(entity: str, translation: tuple[float, ...], xyzw: tuple[float, ...]) -> Chunk:
    return static_chunk(entity, rr.Transform3D(translation=translation, quaternion=rr.Quaternion(xyzw=xyzw)))

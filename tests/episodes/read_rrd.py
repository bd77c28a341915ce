"""Reads an ``.rrd`` as rerun sees it, by entity and component, so that tests can compare it with the input.

It does not use `rerun_table`, which is under test too, nor rerun's query engine, which needs an extra of 100 MB
(datafusion): the chunks of a file are plain Arrow tables, and one table per component is enough here. A file without
a footer (its writer was killed) is read as far as it goes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from workbench.episodes.rerun.chunks import STEP


@dataclass(frozen=True)
class Column:
    """One component of one entity."""

    steps: NDArray[np.int64] | None
    """(R,) value of the timeline ``step`` of each row, ascending; None for static data."""
    values: list[Any]
    """(R) rows. Each is an array (instances, ...), or a list where the component is text or bytes."""


def read_rrd(path: Path) -> dict[str, dict[str, Column]]:
    """Read the first recording in `path`, by entity and then by component.

    Components have rerun's names, for example ``Transform3D:translation``. Where an entity holds a
    component both static and in time, the rows in time are returned.

    Raises:
        ValueError: `path` holds no recording.
        OSError: `path` cannot be read.
    """
    rows: dict[tuple[str, str], list[tuple[int | None, Any]]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        steps: list[int | None] = [None] * batch.num_rows
        if not chunk.is_static:
            index = batch.schema.get_field_index(STEP)
            if index < 0:
                continue
            steps = batch.column(index).cast(pa.int64(), safe=False).to_pylist()
        for field, column in zip(batch.schema, batch.columns):
            if (field.metadata or {}).get(b"rerun:kind") != b"data":
                continue
            found = rows.setdefault((chunk.entity_path, field.name), [])
            found += [(step, value) for step, value in zip(steps, _rows(column)) if value is not None]
    recording: dict[str, dict[str, Column]] = {}
    for (entity, component), pairs in rows.items():
        timed = sorted(((step, value) for step, value in pairs if step is not None), key=lambda pair: pair[0])
        if timed:
            column = Column(
                np.array([step for step, _ in timed], dtype=np.int64), [value for _, value in timed]
            )
        else:
            column = Column(None, [value for _, value in pairs])
        recording.setdefault(entity, {})[component] = column
    return recording


def _rows(column: pa.Array) -> list[Any]:
    """One entry per row of a column of lists: the row's instances as an array, or None for no value."""
    offsets = column.offsets.to_numpy()
    values = _instances(column.values)
    return [
        values[begin:end] if valid else None
        for begin, end, valid in zip(offsets[:-1], offsets[1:], column.is_valid().to_pylist())
    ]


def _instances(values: pa.Array) -> Any:
    """Return an array (n, ...) where Arrow holds plain numbers, else a list of n Python values."""
    if pa.types.is_fixed_size_list(values.type):
        inner = _instances(values.values[values.offset * values.type.list_size :])
        if isinstance(inner, np.ndarray):
            return inner[: len(values) * values.type.list_size].reshape(len(values), -1, *inner.shape[1:])
    elif pa.types.is_list(values.type) and pa.types.is_uint8(values.type.value_type):
        offsets = values.offsets.to_numpy()
        flat = values.values.to_numpy()
        return [flat[begin:end].tobytes() for begin, end in zip(offsets[:-1], offsets[1:])]
    elif (
        pa.types.is_boolean(values.type)
        or pa.types.is_floating(values.type)
        or pa.types.is_integer(values.type)
    ):
        return values.to_numpy(zero_copy_only=False)
    return values.to_pylist()

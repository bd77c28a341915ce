"""The rows of many envs packed at once: what `columns.RowPacker` does for one, in as many calls for sixty-four.

Envs of a batch step together, and their rows are the same arrays with another index. Taken apart an env at a time that is fifty
small arrays for each env and step, 75 us; here each array of the batch is copied once, to its place in rows that stay from step to step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Layout:
    """What the bytes of a row are; the same object for the same key, so that it is known by identity."""

    key: tuple[tuple[str, np.dtype, tuple[int, ...]], ...]
    """Name, type and shape of each array of a row."""


class BatchPacker:
    """Packs the rows of a batch, one step after the other."""

    def __init__(self) -> None:
        self._layouts: dict[object, Layout] = {}
        self._last: Layout | None = None
        self._rows = np.zeros(0, np.uint8)
        self._parts: list[NDArray] = []
        """Where in `_rows` each column goes."""

    def pack(self, columns: Sequence[tuple[str, NDArray]]) -> tuple[Layout, list[bytes]]:
        """The layout and (N) rows of `columns`, each a name and an array (N, ...)."""
        key = tuple([(name, values.dtype, values.shape[1:]) for name, values in columns])
        layout, count = self._last, len(columns[0][1])
        if layout is None or layout.key != key or len(self._rows) != count:
            layout = self._last = self._layouts.setdefault(key, Layout(key))
            fields = [(f"f{i}", values.dtype, values.shape[1:]) for i, (_, values) in enumerate(columns)]
            self._rows = np.zeros(count, fields)
            self._parts = [self._rows[name] for name, *_ in fields]
        for part, (_, values) in zip(self._parts, columns):
            part[...] = values
        size, together = self._rows.itemsize, self._rows.tobytes()
        return layout, [together[i : i + size] for i in range(0, count * size, size)]

    def pack_steps(self, columns: Sequence[tuple[str, NDArray]]) -> tuple[Layout, NDArray]:
        """The layout and rows (N, K), structured, of K steps of `columns`, each a name and an array (K, N, ...)."""
        key = tuple([(name, values.dtype, values.shape[2:]) for name, values in columns])
        layout = self._layouts.setdefault(key, Layout(key))
        fields = [(f"f{i}", values.dtype, values.shape[2:]) for i, (_, values) in enumerate(columns)]
        steps, count = columns[0][1].shape[:2]
        rows = np.empty((count, steps), fields)
        for (name, *_), (_, values) in zip(fields, columns):
            rows[name] = values.swapaxes(0, 1)
        return layout, rows

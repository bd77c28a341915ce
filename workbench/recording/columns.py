"""Rows to bytes while an episode happens, and bytes to columns when it is over.

A control step of one env is thirty to fifty small arrays: poses, an action, entries of ``evaluate()``, env states,
observations. Writing each with its name and type would cost more than the step; but from one step to
the next names and types are the same. So a row is the bytes of its arrays one behind the other, and a *layout*, kept
once, says what they are. A layout is a numpy structured type, so a thousand rows become columns by one call.

``evaluate()`` of a task under way is not tidy: entries come, go and change their type while the author edits. Each change is
a new layout. A column that every row has in one shape keeps its type. Otherwise it becomes
floating point and holds NaN where a row lacks it; rows of differing shape are flattened and padded with NaN.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.recording.row import EpisodeRow

EVALUATE = "evaluate/"
BATCH = "batch/"
"""Numbers that ``evaluate()`` returned of the whole batch."""
STATE = "state/"
OBS = "obs/"
FIXED = ("poses", "action", "reward", "terminated", "truncated")
"""Names of the columns that every row has; `EVALUATE`, `BATCH`, `STATE` and `OBS` begin those of the others."""

_Key = tuple[tuple[str, np.dtype, tuple[int, ...]], ...]


@dataclass(frozen=True)
class Column:
    """What one column of a whole episode is, without its rows."""

    dtype: np.dtype
    shape: tuple[int, ...]
    """Of one row."""


class RowPacker:
    """Packs the rows of one episode, and says when they change their layout."""

    def __init__(self, bodies: int, actions: int) -> None:
        self._bodies = bodies
        self._no_action = np.zeros(actions, dtype=np.float32)
        self._layouts: dict[_Key, int] = {}

    def pack(self, row: EpisodeRow) -> tuple[int, bytes, str | None]:
        """Number of `row`'s layout, `row` in bytes, and the layout as text where it is new.

        Raises:
            ValueError: `row` does not fit the scene or the actions, or holds what is no number.
        """
        action = self._no_action if row.action is None else row.action
        arrays = [
            np.asarray(row.poses, dtype=np.float32),
            np.asarray(action, dtype=np.float32).reshape(-1),
            np.float32(row.reward),
            np.bool_(row.terminated),
            np.bool_(row.truncated),
        ]
        names = [*FIXED]
        batch = {name: entry.numbers for name, entry in row.others.items() if entry.numbers is not None}
        parts = ((EVALUATE, row.evaluate), (BATCH, batch), (STATE, row.env_states), (OBS, row.obs))
        for prefix, held in parts:
            for name, value in held.items():
                names.append(prefix + name)
                arrays.append(np.asarray(value))
        number, text = self.number_of(tuple([(name, a.dtype, a.shape) for name, a in zip(names, arrays)]))
        return number, b"".join([array.tobytes() for array in arrays]), text

    def number_of(self, key: _Key) -> tuple[int, str | None]:
        """The layout of rows that were packed elsewhere, as `pack` gives it and raises."""
        number = self._layouts.get(key)
        if number is not None:
            return number, None
        self._check(key)
        number = self._layouts[key] = len(self._layouts)
        return number, layout_text(key)

    def forget(self, number: int) -> None:
        """Layout `number`, the last new one, was not kept."""
        self._layouts = {key: held for key, held in self._layouts.items() if held != number}

    def _check(self, key: _Key) -> None:
        shapes = {name: shape for name, _, shape in key}
        if shapes["poses"] != (self._bodies, 7):
            raise ValueError(
                f"poses are {shapes['poses']}, but the scene has {self._bodies} bodies: ({self._bodies}, 7)."
            )
        if shapes["action"] != self._no_action.shape:
            raise ValueError(
                f"an action of {shapes['action'][0]} numbers, but {len(self._no_action)} action names."
            )
        for name, dtype, _ in key:
            if dtype.kind not in "biuf":
                where, _, entry = name.partition("/")
                what = f"evaluate()['{entry}']" if where == "evaluate" else f"{where} '{entry}'"
                raise ValueError(
                    f"{what} has dtype {dtype}; a recording keeps booleans and real numbers. "
                    "Return it as a tensor of numbers, or leave it out."
                )


def layout_text(key: _Key) -> str:
    return json.dumps([[name, dtype.str, shape] for name, dtype, shape in key])


def layout_type(text: str) -> np.dtype:
    """The structured type of rows of the layout `text`. Raises ValueError or TypeError where it is none."""
    return np.dtype([(name, dtype, tuple(shape)) for name, dtype, shape in json.loads(text)])


def merge(layouts: Mapping[np.dtype, int]) -> dict[str, Column]:
    """The columns of an episode that has so many rows of each of these layouts, in the order in which names first appear."""
    total = sum(layouts.values())
    seen: dict[str, list[tuple[np.dtype, tuple[int, ...]]]] = {}
    rows: Counter[str] = Counter()
    for layout, count in layouts.items():
        for name in layout.names or ():
            dtype = layout[name]
            seen.setdefault(name, []).append((dtype.base, dtype.shape))
            rows[name] += count
    return {name: _merged(kinds, rows[name] == total) for name, kinds in seen.items()}


def _merged(kinds: list[tuple[np.dtype, tuple[int, ...]]], complete: bool) -> Column:
    dtypes, shapes = zip(*kinds)
    if complete and len(set(shapes)) == 1:
        return Column(np.result_type(*dtypes), shapes[0])
    shape = shapes[0] if len(set(shapes)) == 1 else (max(int(np.prod(s)) for s in shapes),)
    return Column(np.result_type(np.float32, *dtypes), shape)


def assemble(runs: Iterable[NDArray], columns: Mapping[str, Column]) -> dict[str, NDArray]:
    """The rows of `runs`, each structured (n,), as arrays (sum of n, ...) of `columns`."""
    runs = list(runs)
    total = sum(len(run) for run in runs)
    held: dict[str, NDArray] = {}
    for name, column in columns.items():
        have = [name in (run.dtype.names or ()) for run in runs]
        if all(have) and len(runs) == 1 and runs[0].dtype[name] == _of(column):
            held[name] = np.ascontiguousarray(runs[0][name])
            continue
        fill = np.nan if column.dtype.kind == "f" else 0
        out = np.full((total, *column.shape), fill, dtype=column.dtype)
        begin = 0
        for run, has in zip(runs, have):
            if has:
                part = run[name]
                rows = out[begin : begin + len(run)]
                if part.shape[1:] == column.shape:
                    rows[...] = part
                else:
                    flat = part.reshape(len(run), -1)
                    rows[:, : flat.shape[1]] = flat
            begin += len(run)
        held[name] = out
    return held


def _of(column: Column) -> np.dtype:
    return np.dtype((column.dtype, column.shape))

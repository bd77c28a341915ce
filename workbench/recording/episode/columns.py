"""Rows to bytes while an episode happens, and bytes to columns when it is over.

A control step of one env is thirty to fifty small arrays: poses, an action, entries of ``evaluate()``, env states,
observations. Writing each with its name and type would cost more than the step; but from one step to
the next names and types are the same. So a row is the bytes of its arrays one behind the other, and a *layout*, kept
once, says what they are. A layout is a numpy structured type, so a thousand rows become columns by one call. Envs of a
batch step together, so their rows are packed together: each array of the batch is copied once, to its place in rows that
stay from step to step.

``evaluate()`` of a task under way is not tidy: entries come, go and change their type while the author edits. Each change is
a new layout. A column that every row has in one shape keeps its type. Otherwise it becomes
floating point and holds NaN where a row lacks it; rows of differing shape are flattened and padded with NaN.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import Struct, convert
from msgspec.structs import astuple
from numpy.typing import NDArray

from workbench.core.env.step_result import OtherEntry

EVALUATE = "evaluate/"
BATCH = "batch/"
"""Numbers that ``evaluate()`` returned of the whole batch."""
STATE = "state/"
OBS = "obs/"
FIXED = ("poses", "action", "reward", "terminated", "truncated")
"""Names of the columns that every row has; `EVALUATE`, `BATCH`, `STATE` and `OBS` begin those of the others."""


@dataclass(frozen=True, eq=False)
class Layout:
    """What the bytes of a row are; one object a packer and key, so that it is known by identity."""

    key: tuple[tuple[str, np.dtype, tuple[int, ...]], ...]
    """Name, type and shape of each array of a row."""

    @property
    def text(self) -> str:
        return json.dumps([[name, dtype.str, shape] for name, dtype, shape in self.key])

    def check(self, bodies: int, actions: int) -> None:
        """Raises ValueError where its rows do not fit a scene of so many bodies and actions, or hold what is no number."""
        shapes = {name: shape for name, _, shape in self.key}
        if shapes["poses"] != (bodies, 7):
            raise ValueError(
                f"poses are {shapes['poses']}, but the scene has {bodies} bodies: ({bodies}, 7)."
            )
        if shapes["action"] != (actions,):
            raise ValueError(f"an action of {shapes['action'][0]} numbers, but {actions} action names.")
        for name, dtype, _ in self.key:
            if dtype.kind not in "biuf":
                where, _, entry = name.partition("/")
                what = f"evaluate()['{entry}']" if where == "evaluate" else f"{where} '{entry}'"
                raise ValueError(
                    f"{what} has dtype {dtype}; a recording keeps booleans and real numbers. "
                    "Return it as a tensor of numbers, or leave it out."
                )


class BatchPacker:
    """Packs the rows of a batch, one step after the other."""

    def __init__(self) -> None:
        self._layouts: dict[object, Layout] = {}
        self._last: Layout | None = None
        self._rows = np.zeros(0, np.uint8)
        self._parts: list[NDArray] = []
        """Where in `_rows` each column goes."""

    def pack(self, columns: Sequence[tuple[str, NDArray]]) -> tuple[Layout, list[bytes]]:
        """The layout and (N) rows of `columns`, each a name and an array (N, ...): those of `FIXED`, then the others."""
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


def layout_type(text: str) -> np.dtype:
    """The structured type of rows of the layout `text`. Raises ValueError or TypeError where it is none."""
    return np.dtype([(name, dtype, tuple(shape)) for name, dtype, shape in json.loads(text)])


def assemble(runs: Sequence[NDArray]) -> dict[str, NDArray]:
    """The rows of `runs`, each structured (n,), as columns (sum of n, ...) in the order in which their names first appear."""
    names = dict.fromkeys(name for run in runs for name in run.dtype.names or ())
    return {
        name: _column([run[name] if name in (run.dtype.names or ()) else len(run) for run in runs])
        for name in names
    }


def _column(parts: Sequence[NDArray | int]) -> NDArray:
    """Of the runs of rows that have it, and how many rows there are of those that lack it."""
    there = [part for part in parts if isinstance(part, np.ndarray)]
    shapes = {part.shape[1:] for part in there}
    if len(there) == len(parts) and len(shapes) == 1:
        return np.concatenate(there)
    dtype = np.result_type(np.float32, *[part.dtype for part in there])
    shape = shapes.pop() if len(shapes) == 1 else (max(math.prod(shape) for shape in shapes),)
    out = np.full(
        (sum(part if isinstance(part, int) else len(part) for part in parts), *shape), np.nan, dtype
    )
    begin = 0
    for part in parts:
        if isinstance(part, int):
            begin += part
            continue
        rows = out[begin : begin + len(part)].reshape(len(part), -1)
        rows[:, : math.prod(part.shape[1:])] = part.reshape(len(part), -1)
        begin += len(part)
    return out


# --- entries that are no numbers -------------------------------------------------------------------
#
# A string or None seldom changes from one state to the next, so a journal gets a line where one does, and the recording's
# description holds those lines. A library reads the descriptions of thousands of recordings for its rows, so what an
# episode may say is bounded; an entry that says more is named as one that is not recorded further.

TEXT = "entry"
"""Kind of a line in a journal that tells a text."""
MOST_BYTES = 64 << 10
"""Of one episode's texts."""
MOST_LINES = MOST_BYTES
"""A line has a byte at least; a recording with more was not written here."""
CUT = "not recorded from here on: it changes too often"

Line = tuple[int, bytes]
"""The state from which on a text holds, and what a journal has of it. A plain pair, since a reader of rows must not
import what writes journals: Arrow would start a thread in the process that forks."""


class TextEntry(Struct, frozen=True, array_like=True):
    """What one env has of an entry of ``evaluate()`` that is no number; as in `OtherEntry`."""

    what: str
    text: str
    per_env: bool
    whole: bool


TextTrack = tuple[tuple[int, TextEntry | None], ...]
"""States, and what an entry was from each of them on; None where ``evaluate()`` did not return it, or as numbers."""


class TextWriter:
    """What a journal is told of the texts of one episode, state by state."""

    def __init__(self) -> None:
        self._last: dict[str, TextEntry] = {}
        self._left = MOST_BYTES
        self._cut: set[str] = set()

    @property
    def is_empty(self) -> bool:
        """Whether the state before had no texts."""
        return not self._last

    def changes(self, state: int, others: Mapping[str, OtherEntry]) -> list[Line]:
        """Lines for what is another than in the state before; `others` as in an `EpisodeRow`."""
        if not others and not self._last:
            return []
        now = {
            name: TextEntry(entry.what, "".join(entry.texts), entry.per_env, entry.whole)
            for name, entry in others.items()
            if entry.numbers is None
        }
        found: list[Line] = []
        for name, entry in now.items():
            if name in self._cut or self._last.get(name) == entry:
                continue
            line = _line(state, name, entry)
            if len(line[1]) > self._left:
                self._cut.add(name)
                line = _line(state, name, TextEntry(entry.what, CUT, entry.per_env, False))
            self._left -= len(line[1])
            found.append(line)
        found += [
            _line(state, name, None) for name in self._last if name not in now and name not in self._cut
        ]
        self._last = now
        return found


def _line(state: int, name: str, entry: TextEntry | None) -> Line:
    return state, json.dumps([name, None if entry is None else astuple(entry)]).encode()


def tracks_of(lines: Sequence[Line]) -> dict[str, TextTrack]:
    """The tracks of an episode whose journal has these lines."""
    found: dict[str, list[tuple[int, TextEntry | None]]] = {}
    for state, value in lines:
        name, entry = convert(json.loads(value), tuple[str, TextEntry | None])
        found.setdefault(name, []).append((state, entry))
    return {name: tuple(track) for name, track in found.items()}


def entry_at(track: TextTrack, state: int) -> TextEntry | None:
    """What the entry is in this state."""
    found = None
    for begin, entry in track:
        if begin > state:
            break
        found = entry
    return found

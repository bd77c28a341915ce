"""Packs the rows of a running episode into bytes, and converts them to columns when it ends."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import Struct, convert
from msgspec.structs import astuple
from numpy.typing import NDArray

from workbench.envs.step_result import OtherEntry

EVALUATE = "evaluate/"
BATCH = "batch/"
"""Prefix of numbers that ``evaluate()`` returned for the whole batch."""
STATE = "state/"
OBS = "obs/"
FIXED = ("poses", "action", "reward", "terminated", "truncated")
"""Names of the columns that every row has; the names of the others begin with `EVALUATE`, `BATCH`, `STATE` or `OBS`."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Names, types and shapes of the arrays in a row.

    A control step of one env is thirty to fifty small arrays, and writing each with its name and type would cost more
    than the step. Names and types stay the same from step to step, so a row is only the bytes of its arrays, and a
    layout, stored once, describes them. A layout is a numpy structured type, so one call converts a thousand
    rows to columns.

    A packer makes only one `Layout` per key, so layouts are compared by identity.
    """

    key: tuple[tuple[str, np.dtype, tuple[int, ...]], ...]
    """Name, type and shape of each array of a row."""

    @property
    def text(self) -> str:
        return json.dumps([[name, dtype.str, shape] for name, dtype, shape in self.key])

    def check(self, bodies: int, actions: int) -> None:
        """Raise ValueError if rows of this layout do not fit a scene with this many bodies and actions, or
        contain anything but numbers."""
        shapes = {name: shape for name, _, shape in self.key}
        if shapes["poses"] != (bodies, 7):
            raise ValueError(
                f"poses have the shape {shapes['poses']}, but the scene has {bodies} bodies: ({bodies}, 7)."
            )
        if shapes["action"] != (actions,):
            raise ValueError(
                f"an action has {shapes['action'][0]} numbers; the number of action names is {actions}."
            )
        for name, dtype, _ in self.key:
            if dtype.kind not in "biuf":
                where, _, entry = name.partition("/")
                what = f"evaluate()['{entry}']" if where == "evaluate" else f"{where} '{entry}'"
                raise ValueError(
                    f"{what} has dtype {dtype}; a recording keeps booleans and real numbers. "
                    "Return it as a tensor of numbers, or leave it out."
                )


class BatchPacker:
    """Packs the rows of a batch, step by step; each array of the batch is copied once, into a reused buffer."""

    def __init__(self) -> None:
        self._layouts: dict[object, Layout] = {}
        self._last: Layout | None = None
        self._rows = np.zeros(0, np.uint8)
        self._parts: list[NDArray] = []
        """View of each column in `_rows`."""

    def pack(self, columns: Sequence[tuple[str, NDArray]]) -> tuple[Layout, list[bytes]]:
        """Pack `columns`, each a name and an array (N, ...), those of `FIXED` first. Returns the layout and N
        rows."""
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
    """The structured type of rows of the layout `text`. Raises ValueError or TypeError if it is invalid."""
    return np.dtype([(name, dtype, tuple(shape)) for name, dtype, shape in json.loads(text)])


def assemble(runs: Sequence[NDArray]) -> dict[str, NDArray]:
    """Join `runs`, each a structured array (n,), to columns (sum of n, ...), in the order in which their
    names first appear.

    While the author edits, entries of ``evaluate()`` appear, disappear and change their type; each change
    begins a new layout. A column that every row has, always in the same shape, keeps its type. Any other
    column is floating point, NaN where a row lacks it; rows of differing shape are flattened and padded with
    NaN.
    """
    names = dict.fromkeys(name for run in runs for name in run.dtype.names or ())
    return {
        name: _column([run[name] if name in (run.dtype.names or ()) else len(run) for run in runs])
        for name in names
    }


def _column(parts: Sequence[NDArray | int]) -> NDArray:
    """One column from its parts. Each part is an array of rows, or the number of rows that lack the
    column."""
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


# --- entries of evaluate() that are not numbers ----------------------------------------------------
#
# A string or None rarely changes from state to state, so the journal gets a line only at changes. The size of
# these lines is bounded: they go into the recording's description, and a library reads thousands of
# descriptions.

TEXT = "entry"
"""Kind of a journal entry that holds a text."""
MAX_TEXT_BYTES = 64 << 10
"""Maximum size of one episode's texts."""
MAX_TEXT_LINES = MAX_TEXT_BYTES
"""Maximum number of lines: a line has at least a byte, so the workbench writes no recording with more."""
CUT_MESSAGE = "not recorded from here on: it changes too often"

TextLine = tuple[int, bytes]
"""(first state with this text, the text as the journal holds it). A plain pair instead of a `JournalEntry`:
the journal's module imports Arrow, which would start a thread in the process that forks readers."""


class TextEntry(Struct, frozen=True, array_like=True):
    """One env's part of an entry of ``evaluate()`` that is not a number; fields as in `OtherEntry`."""

    what: str
    text: str
    per_env: bool
    whole: bool


TextTrack = tuple[tuple[int, TextEntry | None], ...]
"""(first state, value) of each change. The value is None if ``evaluate()`` returned no such entry from that
state on, or returned numbers for it."""


class TextWriter:
    """Converts the texts of one episode to lines of the journal."""

    def __init__(self) -> None:
        self._last: dict[str, TextEntry] = {}
        self._left = MAX_TEXT_BYTES
        self._cut: set[str] = set()

    @property
    def is_empty(self) -> bool:
        """Whether the previous state had no texts."""
        return not self._last

    def changes(self, state: int, others: Mapping[str, OtherEntry]) -> list[TextLine]:
        """Lines for the entries that differ from the previous state."""
        if not others and not self._last:
            return []
        now = {
            name: TextEntry(entry.what, "".join(entry.texts), entry.per_env, entry.whole)
            for name, entry in others.items()
            if entry.numbers is None
        }
        found: list[TextLine] = []
        for name, entry in now.items():
            if name in self._cut or self._last.get(name) == entry:
                continue
            line = _line(state, name, entry)
            if len(line[1]) > self._left:
                self._cut.add(name)
                line = _line(state, name, TextEntry(entry.what, CUT_MESSAGE, entry.per_env, False))
            self._left -= len(line[1])
            found.append(line)
        found += [
            _line(state, name, None) for name in self._last if name not in now and name not in self._cut
        ]
        self._last = now
        return found


def _line(state: int, name: str, entry: TextEntry | None) -> TextLine:
    return state, json.dumps([name, None if entry is None else astuple(entry)]).encode()


def text_tracks(lines: Sequence[TextLine]) -> dict[str, TextTrack]:
    """Convert the lines of an episode's journal to text tracks."""
    found: dict[str, list[tuple[int, TextEntry | None]]] = {}
    for state, value in lines:
        name, entry = convert(json.loads(value), tuple[str, TextEntry | None])
        found.setdefault(name, []).append((state, entry))
    return {name: tuple(track) for name, track in found.items()}


def entry_at(track: TextTrack, state: int) -> TextEntry | None:
    """The entry's value in `state`."""
    found = None
    for begin, entry in track:
        if begin > state:
            break
        found = entry
    return found

"""What a task drew with `workbench.draw` during an episode: lines of the journal, and columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from workbench.envs.task_drawings import ITEM_SHAPES, MAX_ITEMS, Drawing, DrawingKind

DRAWING = "drawing"
"""Kind of a journal entry that holds a drawing."""
MAX_DRAWING_BYTES = 32 << 20
"""Maximum size of one episode's drawings. A drawing that no longer fits is replaced by a text that says so."""
MAX_DRAWINGS = 200
"""Maximum number of drawings of one episode, since each is an entity of the ``.rrd`` (5 kB)."""
_MAX_NAME_CHARACTERS = 200
_MESSAGE_BYTES = 1 << 16
"""Part of `MAX_DRAWING_BYTES` for the texts that replace drawings."""
_FURTHER = "further drawings"
"""Name of the text that replaces the drawings beyond `MAX_DRAWINGS`."""

DrawingKey = tuple[str, DrawingKind]
"""Name and kind: a drawing that changes its kind is two tracks, of which one is empty at each state."""
DrawingLine = tuple[int, bytes]
"""(first state with this drawing, the drawing as the journal holds it); see `columns.TextLine`."""


@dataclass(frozen=True, eq=False)
class DrawingTrack:
    """One drawing of an episode of one env: R rows, one for each change."""

    name: str
    kind: DrawingKind
    states: NDArray[np.int64]
    """(R,) first state of each row, ascending."""
    begins: NDArray[np.int64]
    """(R + 1,) row r is `data` from ``begins[r]`` to ``begins[r + 1]``; an empty row draws nothing."""
    data: NDArray[np.float32]
    """(I, ...) the items of all rows, each as in `Drawing.data`."""
    colors: NDArray[np.uint8]
    """(R, 3)"""
    sizes: NDArray[np.float32]
    """(R,) as in `Drawing.size`."""
    texts: tuple[str, ...]
    """(R,) for the kind ``text``, else empty."""

    @property
    def key(self) -> DrawingKey:
        return self.name, self.kind

    def at(self, state: int) -> Drawing | None:
        """The drawing in a state, as a batch of one env; None if it is not drawn."""
        row = int(np.searchsorted(self.states, state, side="right")) - 1
        if row < 0 or self.begins[row] == self.begins[row + 1]:
            return None
        red, green, blue = self.colors[row].tolist()
        data = self.data[self.begins[row] : self.begins[row + 1]]
        texts = self.texts[row : row + 1]
        return Drawing(self.kind, data[None], (red, green, blue), float(self.sizes[row]), texts)


def wrong_drawings(tracks: Sequence[DrawingTrack], states: int) -> str | None:
    """What is wrong with the tracks of an untrusted recording with this many states; None if nothing is."""
    if len({track.key for track in tracks}) != len(tracks) or len(tracks) > 2 * MAX_DRAWINGS:
        return f"{len(tracks)} drawings, or two of one name"
    if sum(track.data.nbytes + sum(map(len, track.texts)) for track in tracks) > MAX_DRAWING_BYTES:
        return f"drawings of more than {MAX_DRAWING_BYTES >> 20} MB"
    for track in tracks:
        if not _fits(track, states):
            return f"a drawing ({track.name[:80]}) whose rows do not fit"
    return None


def _fits(track: DrawingTrack, states: int) -> bool:
    rows = track.states.size
    if not (
        track.states.shape == track.sizes.shape == (rows,)
        and track.begins.shape == (rows + 1,)
        and track.colors.shape == (rows, 3)
        and len(track.texts) == (rows if track.kind == "text" else 0)
        and track.data.ndim > 1
        and track.data.shape[1:] == ITEM_SHAPES[track.kind]
        and track.states.dtype == track.begins.dtype == np.int64
        and track.data.dtype == track.sizes.dtype == np.float32
        and track.colors.dtype == np.uint8
    ):
        return False
    counts = np.diff(track.begins)
    return bool(
        track.begins[0] == 0
        and track.begins[-1] == len(track.data)
        and np.all((counts >= 0) & (counts <= MAX_ITEMS))
        and np.all((track.states >= 0) & (track.states < states))
        and np.all(np.diff(track.states) > 0)
        and np.isfinite(track.data).all()
    )


class _Line(msgspec.Struct, frozen=True, array_like=True):
    """A drawing in the journal; without data it is removed."""

    name: str
    kind: DrawingKind
    color: tuple[int, int, int] = (0, 0, 0)
    size: float = 0.0
    text: str = ""
    data: bytes = b""


class DrawingWriter:
    """Converts the drawings of one episode to lines of the journal."""

    def __init__(self) -> None:
        self._last: dict[DrawingKey, bytes] = {}
        """Line of each drawing of the previous state."""
        self._left = MAX_DRAWING_BYTES - _MESSAGE_BYTES
        self._known: set[DrawingKey] = set()
        self._replaced: set[DrawingKey] = set()
        """Drawings that are not recorded from some state on."""
        self._messages: dict[DrawingKey, bytes] = {}
        """Texts in their places."""

    def changes(self, state: int, drawn: Mapping[str, Drawing]) -> list[DrawingLine]:
        """Lines for what differs from the previous state.

        Args:
            drawn: drawings of one env, as returned by `Drawing.of_env`.
        """
        if not drawn and not self._last:
            return []
        now: dict[DrawingKey, bytes] = {}
        for name, drawing in drawn.items():
            data = drawing.data[0]
            name = _encodable(name)[:_MAX_NAME_CHARACTERS] or "unnamed"
            key = name, drawing.kind
            if not len(data) or key in self._replaced:
                continue
            text = _encodable(drawing.texts[0]) if drawing.texts else ""
            line = _packed(name, drawing.kind, drawing.color, drawing.size, text, data)
            if line != self._last.get(key):
                if (why := self._refusal(key, line)) is not None:
                    self._replace(key, why, data)
                    continue
                self._known.add(key)
                self._left -= len(line)
            now[key] = line
        now |= self._messages
        lines = [(state, line) for key, line in now.items() if self._last.get(key) != line]
        lines += [(state, msgspec.msgpack.encode(_Line(*key))) for key in self._last.keys() - now.keys()]
        self._last = now
        return lines

    def _refusal(self, key: DrawingKey, line: bytes) -> str | None:
        """Reason why the line is not recorded; None if there is room."""
        if len(line) > self._left:
            return f"more than {MAX_DRAWING_BYTES >> 20} MB of drawings"
        if key not in self._known and len(self._known) >= MAX_DRAWINGS:
            return f"more than {MAX_DRAWINGS} drawings"
        return None

    def _replace(self, key: DrawingKey, why: str, data: NDArray[np.float32]) -> None:
        """Draw a text at the first item of the drawing from now on."""
        name = _FURTHER
        if key in self._known:
            self._replaced.add(key)
            name = key[0]
        place = data.reshape(len(data), -1)[:1, :3]
        text = f"{name}: not recorded from here on ({why})"
        self._messages.setdefault((name, "text"), _packed(name, "text", (255, 0, 0), 0.0, text, place))


def _packed(
    name: str,
    kind: DrawingKind,
    color: tuple[int, int, int],
    size: float,
    text: str,
    data: NDArray[np.float32],
) -> bytes:
    return msgspec.msgpack.encode(_Line(name, kind, color, size, text, data.tobytes()))


def _encodable(text: str) -> str:
    """`text` without lone surrogates, which no file accepts."""
    return text.encode("utf-8", "replace").decode()


def drawing_tracks(lines: Sequence[DrawingLine]) -> tuple[DrawingTrack, ...]:
    """Convert the lines of an episode's journal to tracks. Raises msgspec.DecodeError or ValueError."""
    found: dict[DrawingKey, list[tuple[int, _Line]]] = {}
    for state, value in lines:
        line = msgspec.msgpack.decode(value, type=_Line)
        found.setdefault((line.name, line.kind), []).append((state, line))
    return tuple(_track(*key, rows) for key, rows in found.items())


def _track(name: str, kind: DrawingKind, rows: Sequence[tuple[int, _Line]]) -> DrawingTrack:
    shape = ITEM_SHAPES[kind]
    parts = [np.frombuffer(line.data, np.float32).reshape(-1, *shape) for _, line in rows]
    return DrawingTrack(
        name,
        kind,
        np.array([state for state, _ in rows], np.int64),
        np.cumsum([0, *map(len, parts)], dtype=np.int64),
        np.concatenate(parts),
        np.array([line.color for _, line in rows], np.uint8),
        np.array([line.size for _, line in rows], np.float32),
        tuple(line.text for _, line in rows) if kind == "text" else (),
    )

"""Entries of ``evaluate()`` that are no numbers, over an episode: their texts, each from the state at which it began.

A string or None seldom changes from one state to the next, so a journal gets a line where one does, and the recording's
description holds those lines. A library reads the descriptions of thousands of recordings for its rows, so what an episode
may say is bounded; an entry that says more is named as one that is not recorded further.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from workbench.core.step import OtherEntry

KIND = "entry"
"""Of a line in a journal."""
MOST_BYTES = 64 << 10
"""Of one episode's texts."""
MOST_LINES = MOST_BYTES
"""A line has a byte at least; a recording with more was not written here."""
CUT = "not recorded from here on: it changes too often"

Line = tuple[int, bytes]
"""The state from which on a text holds, and what a journal has of it. A plain pair, since a reader of rows must not
import what writes journals: Arrow would start a thread in the process that forks."""

TextTrack = tuple[tuple[int, OtherEntry | None], ...]
"""States, and what an entry was from each of them on; None where ``evaluate()`` did not return it, or as numbers."""


class TextWriter:
    """What a journal is told of the texts of one episode, state by state."""

    def __init__(self) -> None:
        self._last: dict[str, OtherEntry] = {}
        self._left = MOST_BYTES
        self._cut: set[str] = set()

    @property
    def is_silent(self) -> bool:
        """Whether the state before had no texts."""
        return not self._last

    def news(self, state: int, others: Mapping[str, OtherEntry]) -> list[Line]:
        """Lines for what is another than in the state before; `others` as in an `EpisodeRow`."""
        if not others and not self._last:
            return []
        now = {name: entry for name, entry in others.items() if entry.numbers is None}
        found: list[Line] = []
        for name, entry in now.items():
            if name in self._cut or self._last.get(name) == entry:
                continue
            line = _line(state, name, entry)
            if len(line[1]) > self._left:
                self._cut.add(name)
                line = _line(state, name, OtherEntry(entry.what, (CUT,), per_env=entry.per_env, whole=False))
            self._left -= len(line[1])
            found.append(line)
        found += [
            _line(state, name, None) for name in self._last if name not in now and name not in self._cut
        ]
        self._last = now
        return found


def _line(state: int, name: str, entry: OtherEntry | None) -> Line:
    return state, json.dumps([name, _said(entry)]).encode()


def tracks_of(lines: Sequence[Line]) -> dict[str, TextTrack]:
    """The tracks of an episode whose journal has these lines."""
    found: dict[str, list[tuple[int, OtherEntry | None]]] = {}
    for state, value in lines:
        name, said = json.loads(value)
        found.setdefault(name, []).append((state, _entry(said)))
    return {name: tuple(track) for name, track in found.items()}


def tracks_words(tracks: Mapping[str, TextTrack]) -> dict[str, Any]:
    """`tracks` as JSON."""
    return {name: [[state, _said(entry)] for state, entry in track] for name, track in tracks.items()}


def tracks_from(said: Mapping[str, Any]) -> dict[str, TextTrack]:
    """The inverse of `tracks_words`. Raises ValueError, TypeError or AttributeError where it is none, or far too much."""
    if sum(map(len, said.values())) > MOST_LINES:
        raise ValueError(f"it has more than {MOST_LINES} lines of entries that are no numbers")
    return {
        str(name): tuple((int(state), _entry(entry)) for state, entry in track)
        for name, track in said.items()
    }


def entry_at(track: TextTrack, state: int) -> OtherEntry | None:
    """What the entry is in this state."""
    found = None
    for begin, entry in track:
        if begin > state:
            break
        found = entry
    return found


def _said(entry: OtherEntry | None) -> list[Any] | None:
    return None if entry is None else [entry.what, "".join(entry.texts), entry.per_env, entry.whole]


def _entry(said: Sequence[Any] | None) -> OtherEntry | None:
    if said is None:
        return None
    what, text, per_env, whole = said
    return OtherEntry(str(what), (str(text),), per_env=bool(per_env), whole=bool(whole))

"""The parts of snapshots, kept once however many moments have them, and as long as one has.

A snapshot comes as a body and the keys of its parts (`core.snapshot_parts`), most of which are those of the moment
before. So moments point to a set of parts, sets count their moments, and parts count their sets.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass
class PartSet:
    """The parts of a snapshot, shared by all moments that have the same."""

    keys: tuple[int, ...]
    moments: int = 0
    complete: bool = True


class SharedParts:
    """See the module's text."""

    def __init__(self) -> None:
        self._parts: dict[int, bytes] = {}
        self._references: dict[int, int] = {}
        self._last = PartSet(())
        self.used = 0
        """Bytes."""

    def take(self, keys: tuple[int, ...] | None, new_parts: Mapping[int, bytes]) -> PartSet:
        """Those of the next moment; `keys` is None where they are those of the moment before."""
        self._parts.update(new_parts)
        if keys is None or keys == self._last.keys:
            parts = self._last
        else:
            # A snapshot whose parts went to another history cannot be put back: it is none.
            parts = self._last = PartSet(keys, complete=all(key in self._parts for key in keys))
        if not parts.complete:
            return parts
        if parts.moments == 0:
            for key in parts.keys:
                self._references[key] = self._references.get(key, 0) + 1
                if self._references[key] == 1:
                    self.used += len(self._parts[key])
        parts.moments += 1
        return parts

    def release(self, parts: PartSet) -> None:
        """A moment that had them is gone."""
        parts.moments -= 1
        if parts.moments == 0 and parts.complete:
            for key in parts.keys:
                self._references[key] -= 1
                if self._references[key] == 0:
                    self.used -= len(self._parts[key])
                    del self._references[key]
                    # The worker will not send it again while the newest moment has it; that one is kept.
                    del self._parts[key]

    def of(self, parts: PartSet) -> tuple[bytes, ...]:
        return tuple(self._parts[key] for key in parts.keys)

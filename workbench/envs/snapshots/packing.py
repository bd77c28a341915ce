"""Packs snapshots as bytes, without repeating what has not changed."""

from __future__ import annotations

import io
import operator
import pickle
import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from workbench.envs.snapshots.snapshot import Snapshot
    from workbench.envs.snapshots.task_state import Buffer


@dataclass(frozen=True)
class PackedSnapshot:
    """One snapshot; `unpack_snapshot` needs the body and the bytes of all its parts, in order."""

    body: bytes
    keys: tuple[int, ...] | None
    """Numbers of the snapshot's parts; None if they are those of the previous snapshot."""
    new_parts: dict[int, bytes]
    """Parts that were not sent yet, by number."""


@dataclass(frozen=True, slots=True)
class WholeSnapshot:
    """Unpickles as the `Snapshot` that was packed."""

    body: bytes
    parts: tuple[bytes, ...]

    def __reduce__(self) -> tuple[Any, tuple[bytes, tuple[bytes, ...]]]:
        return unpack_snapshot, (self.body, self.parts)


@dataclass
class _SentPart:
    """A part of the last snapshot: value (for identity), bytes (for equality) and number."""

    value: Any
    pickled: bytes
    key: int


@dataclass
class SnapshotPacker:
    """Packs the snapshots of one env, one after the other.

    Most of a snapshot stays the same from step to step (generators, goal poses). These *parts* are pickled
    when they change, get a number that no other part of this packer has, and are sent once. The *body* is the
    snapshot, pickled with a persistent id in place of each part. Parts are compared by identity first, then
    by bytes. The server keeps bodies and parts, and imports neither torch nor ManiSkill; a worker joins them
    and unpickles a plain `Snapshot`.

    PickCube-v1, random actions, two cores (``tests/benchmarks/history_cost.py``): for 16 envs the body of a
    step has 8.8 KB and the whole pickled snapshot 107 KB; for 64 envs 32 KB and 380 KB. Taking the
    snapshot takes 0.6 ms (64 envs: 0.9 ms), and packing it 0.3 ms (0.4 ms). A reset of one env adds 5 KB.
    """

    _kept: dict[Any, _SentPart] = field(default_factory=dict)
    """The parts of the last snapshot, by name."""
    _buffers: dict[str, Buffer] = field(default_factory=dict)
    """The buffers of the last snapshot, by path."""
    _next_key: int = field(default_factory=lambda: secrets.randbits(30) << 30)
    """Starts at random, since the server may still keep parts of an earlier worker."""
    _last_keys: tuple[int, ...] | None = None

    def pack(self, snapshot: Snapshot) -> PackedSnapshot:
        """Cut a snapshot into its body and its parts."""
        new: dict[int, bytes] = {}
        places: dict[int, int] = {}
        before, self._kept = self._kept, {}
        for name, value in self._parts_of(snapshot).items():
            places[id(value)] = len(self._kept)
            kept = before.get(name)
            # This comparison saves two calls for each generator of each env.
            stays = kept is not None and kept.value is value
            self._kept[name] = kept if stays else self._part(kept, value, new)  # type: ignore[assignment]
        self._buffers = snapshot.memory.task.buffers
        keys = tuple([kept.key for kept in self._kept.values()])
        same, self._last_keys = keys == self._last_keys, keys
        body = io.BytesIO()
        pickler = pickle.Pickler(body, pickle.HIGHEST_PROTOCOL)
        pickler.persistent_id = lambda thing, at=places.get: at(id(thing))  # type: ignore[method-assign]
        pickler.dump(snapshot)
        return PackedSnapshot(body.getvalue(), None if same else keys, new)

    def _parts_of(self, snapshot: Snapshot) -> dict[Any, Any]:
        """The values that rarely change, by name."""
        memory, task = snapshot.memory, snapshot.memory.task
        stays: dict[Any, Any] = {"contents": getattr(snapshot.simulation, "contents", ())}
        stays |= {"built": task.built, "omitted": task.omitted, **memory.shared_rng._asdict()}
        for purpose, states in memory.rng.items():
            stays |= {(purpose, i): state for i, state in zip(snapshot.env_idx, states, strict=True)}
        for path, buffer in task.buffers.items():
            last = self._buffers.get(path)
            if last is not None and last.is_as(buffer):
                stays["buffer", path] = buffer
        return {name: value for name, value in stays.items() if value is not None}

    def _part(self, kept: _SentPart | None, value: Any, new: dict[int, bytes]) -> _SentPart:
        """The part with this value: that of the previous snapshot, or a new one.

        Never the part of an older snapshot, since the server drops parts that no stored moment needs.
        """
        if kept is not None and _is_the_same(kept.value, value):
            return kept
        pickled = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
        if kept is not None and kept.pickled == pickled:
            return _SentPart(value, pickled, kept.key)
        self._next_key += 1
        new[self._next_key] = pickled
        return _SentPart(value, pickled, self._next_key)


def unpack_snapshot(body: bytes, parts: Sequence[bytes]) -> Snapshot:
    """The snapshot from which `SnapshotPacker.pack` made this body.

    Args:
        parts: the bytes of the snapshot's parts, in the order of `PackedSnapshot.keys`.
    """
    unpickler = pickle.Unpickler(io.BytesIO(body))
    whole = [pickle.loads(part) for part in parts]
    unpickler.persistent_load = whole.__getitem__  # type: ignore[method-assign]
    return unpickler.load()


def _is_the_same(a: Any, b: Any) -> bool:
    """Whether both are one object, or tuples of the same objects."""
    both = type(a) is tuple and type(b) is tuple and len(a) == len(b)
    return a is b or (both and all(map(operator.is_, a, b)))

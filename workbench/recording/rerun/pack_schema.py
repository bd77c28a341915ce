"""Arrow schemas as small messages: what fields have in common is there once."""

from __future__ import annotations

import struct
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field

import pyarrow as pa

_FRAME = struct.Struct("<II")
"""Mark of a message, and its length."""
_MARK = 0xFFFFFFFF
_OFFSET = struct.Struct("<I")
_BACK = struct.Struct("<i")
_SHORT = struct.Struct("<H")
_SHORTS = struct.Struct("<HH")

# Slots of the tables in Arrow's Schema.fbs and Message.fbs.
_VERSION, _HEADER_TYPE, _HEADER = 0, 1, 2
_FIELDS = 1
_NAME, _NULLABLE, _TYPE_TYPE, _TYPE, _CHILDREN, _METADATA = 0, 1, 2, 3, 5, 6


def packed_schema(message: bytes) -> bytes:
    """The schema in `message`, an Arrow IPC message, as a shorter one.

    An .rrd has the schema of its recording uncompressed in its index: a field with six texts for each component of each
    entity, most of them the same. Arrow's writers write each anew; a flatbuffer may hold each once, and any number of
    references to it (https://flatbuffers.dev/internals). `message` itself where it holds something unexpected.
    """
    try:
        made = _Packing(message[_FRAME.size :]).message()
    except (struct.error, IndexError):
        return message
    made += bytes(-len(made) % 8)
    packed = _FRAME.pack(_MARK, len(made)) + made
    try:
        wanted, found = (pa.ipc.read_schema(pa.py_buffer(each)) for each in (message, packed))
    except (pa.ArrowInvalid, OSError):
        return message
    return packed if found.equals(wanted, check_metadata=True) and len(packed) < len(message) else message


@dataclass(eq=False)
class _Node:
    """A string, a vector or a table, with offsets to others."""

    data: bytes
    shape: bytes = b""
    """A table's vtable."""
    targets: Sequence[tuple[int, _Node]] = ()
    """Places in `data` of offsets, and what they lead to."""
    wide: bool = False
    """Whether it needs an address that is a multiple of eight."""
    at: int = field(default=0, init=False)


class _Packing:
    def __init__(self, source: bytes) -> None:
        self._source = source
        self._known: dict[Hashable, _Node] = {}
        """In order: what a node refers to is before it."""

    def message(self) -> bytes:
        root = self._target(0)
        schema = self._target(self._slot(root, _HEADER))
        fields = self._vector([self._field(at) for at in self._items(self._slot(schema, _FIELDS))])
        version = self._source[self._slot(root, _VERSION) :][:2]
        kind = self._source[self._slot(root, _HEADER_TYPE) :][:1]
        # Smaller numbers come last, so that each lies at a multiple of its size.
        header = self._table(4, [(_FIELDS, fields)], [])
        return self._written(self._table(3, [(_HEADER, header)], [(_VERSION, version), (_HEADER_TYPE, kind)]))

    def _written(self, root: _Node) -> bytes:
        """Offsets only lead forwards: what refers to a node comes before it."""
        written = bytearray(_OFFSET.size)
        shapes: dict[bytes, int] = {}
        for node in reversed(self._known.values()):
            if node.shape and node.shape not in shapes:
                written += bytes(-len(written) % 2)
                shapes[node.shape] = len(written)
                written += node.shape
            written += bytes(-len(written) % (8 if node.wide else 4))
            node.at = len(written)
            written += node.data
        for node in self._known.values():
            if node.shape:
                _BACK.pack_into(written, node.at, node.at - shapes[node.shape])
            for place, target in node.targets:
                _OFFSET.pack_into(written, node.at + place, target.at - node.at - place)
        _OFFSET.pack_into(written, 0, root.at)
        return bytes(written)

    # --- reading ---

    def _target(self, place: int) -> int:
        return place + _OFFSET.unpack_from(self._source, place)[0]

    def _slot(self, table: int, number: int) -> int:
        """Where the table has that field; 0 where it has none."""
        shape = table - _BACK.unpack_from(self._source, table)[0]
        if 4 + 2 * number >= _SHORT.unpack_from(self._source, shape)[0]:
            return 0
        place = _SHORT.unpack_from(self._source, shape + 4 + 2 * number)[0]
        return table + place if place else 0

    def _items(self, place: int) -> list[int]:
        """Where the tables of a vector are; none where `place` is 0."""
        if not place:
            return []
        at = self._target(place)
        count = _OFFSET.unpack_from(self._source, at)[0]
        return [self._target(at + 4 + 4 * number) for number in range(count)]

    # --- shared nodes ---

    def _shared(self, key: Hashable, make: Callable[[], _Node]) -> _Node:
        found = self._known.get(key)
        if found is None:
            found = self._known[key] = make()
        return found

    def _field(self, at: int) -> _Node:
        name = self._string(self._slot(at, _NAME))
        kind = self._type(self._target(self._slot(at, _TYPE)))
        children = self._vector([self._field(child) for child in self._items(self._slot(at, _CHILDREN))])
        offsets = [(_NAME, name), (_TYPE, kind), (_CHILDREN, children)]
        if metadata := self._items(self._slot(at, _METADATA)):
            offsets.append((_METADATA, self._vector([self._pair(pair) for pair in metadata])))
        small = [(_TYPE_TYPE, self._source[self._slot(at, _TYPE_TYPE) :][:1])]
        if nullable := self._slot(at, _NULLABLE):
            small.append((_NULLABLE, self._source[nullable : nullable + 1]))
        return self._table(7, offsets, small)

    def _pair(self, at: int) -> _Node:
        texts = [(number, self._string(self._slot(at, number))) for number in (0, 1)]
        return self._table(2, texts, [])

    def _string(self, place: int) -> _Node:
        at = self._target(place)
        content = self._source[at : at + 4 + _OFFSET.unpack_from(self._source, at)[0] + 1]
        return self._shared(content, lambda: _Node(content))

    def _type(self, at: int) -> _Node:
        """A type is copied: those of rerun's schemas have no texts or tables in them."""
        shape_at = at - _BACK.unpack_from(self._source, at)[0]
        shape_size, size = _SHORTS.unpack_from(self._source, shape_at)
        shape, content = self._source[shape_at : shape_at + shape_size], self._source[at + 4 : at + size]
        return self._shared(("type", shape, content), lambda: _Node(bytes(4) + content, shape, wide=True))

    def _vector(self, items: Sequence[_Node]) -> _Node:
        def make() -> _Node:
            targets = [(4 + 4 * number, item) for number, item in enumerate(items)]
            return _Node(_OFFSET.pack(len(items)) + bytes(4 * len(items)), targets=targets)

        return self._shared(("vector", *(id(item) for item in items)), make)

    def _table(
        self, slots: int, offsets: Sequence[tuple[int, _Node]], numbers: Sequence[tuple[int, bytes]]
    ) -> _Node:
        """A table with `slots` fields: offsets, and behind them numbers of one or two bytes, the larger first."""

        def make() -> _Node:
            places = [0] * slots
            content = bytearray(4)
            targets = []
            for number, target in offsets:
                places[number] = len(content)
                targets.append((len(content), target))
                content += bytes(4)
            for number, value in numbers:
                places[number] = len(content)
                content += value
            shape = struct.pack(f"<HH{slots}H", 4 + 2 * slots, len(content), *places)
            return _Node(bytes(content), shape, targets)

        parts = ((number, id(target)) for number, target in offsets)
        return self._shared(("table", *parts, *numbers), make)

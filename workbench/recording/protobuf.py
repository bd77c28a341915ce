"""Messages of protobuf as lists of fields, of the two kinds that rerun's files have: whole numbers and bytes.

Google's library reads messages whose definition one has; rerun's are not among what its wheel brings along.
Format: https://protobuf.dev/programming-guides/encoding/
"""

from __future__ import annotations

from collections.abc import Sequence

_NUMBER, _BYTES = 0, 2
Field = tuple[int, int | memoryview | bytes]
"""Its number, and its value; what is a message itself is bytes."""


def read_fields(message: bytes | memoryview) -> list[Field]:
    """The fields of `message` in order; bytes are views of it. Raises ValueError."""
    fields: list[Field] = []
    rest = memoryview(message)
    while len(rest):
        key, rest = _varint(rest)
        if key & 7 == _NUMBER:
            value, rest = _varint(rest)
            fields.append((key >> 3, value))
        elif key & 7 == _BYTES:
            length, rest = _varint(rest)
            fields.append((key >> 3, rest[:length]))
            rest = rest[length:]
        else:
            raise ValueError("a field of a kind that rerun does not write")
    return fields


def write_fields(fields: Sequence[Field]) -> bytes:
    """The message with `fields`."""
    parts: list[bytes | memoryview] = []
    for number, value in fields:
        if isinstance(value, int):
            parts += [_as_varint(number << 3 | _NUMBER), _as_varint(value)]
        else:
            parts += [_as_varint(number << 3 | _BYTES), _as_varint(len(value)), value]
    return b"".join(parts)


def _varint(content: memoryview) -> tuple[int, memoryview]:
    value = shift = 0
    for place, byte in enumerate(content[:10]):
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, content[place + 1 :]
        shift += 7
    raise ValueError("a number without an end")


def _as_varint(value: int) -> bytes:
    content = bytearray()
    while value > 0x7F:
        content.append(value & 0x7F | 0x80)
        value >>= 7
    content.append(value)
    return bytes(content)

"""The index at the end of an ``.rrd``: read, changed and written.

An ``.rrd`` is a header of 12 bytes, messages with kind and length (16 bytes) before each, the last one the index, and a
footer of 32 bytes with offset and hash of the index (crate ``re_log_encoding``, ``rrd/frames.rs``;
``rerun/proto/rerun/v1alpha1/log_msg.proto``). The index is a list of manifests, one per store: a recording or a blueprint.
"""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import BinaryIO

import numpy as np
import pyarrow as pa
import xxhash

from workbench.recording.rerun.pack_schema import packed_schema
from workbench.recording.rerun.private_api import Field, read_fields, write_fields

HEADER_SIZE = 12
MESSAGE = struct.Struct("<QQ")
"""Kind and length of the message behind it."""
_INDEX_KIND = 0
_FOOTER = struct.Struct("<QQI12s")
"""Offset of the index (behind its kind and length), its length, its hash, and the mark."""
_FOOTER_MARK = b"RRF2FOOT" + (1).to_bytes(4, "little")
_HASH_SEED = 7850921
"""Rerun's ``StreamFooter::CRC_SEED``."""
_MANIFESTS = 1
"""Field of ``RrdFooter``."""
_STORE, _SCHEMA, _SCHEMA_HASH, _TABLE = 1, 2, 3, 4
"""Fields of ``RrdManifest``."""
_SCHEMA_MESSAGE = 1
_PAYLOAD, _COMPRESSION, _UNPACKED = 2, 3, 4
"""Fields of the table."""
_LZ4 = 2
ID, PLACE, SIZE = "chunk_id", "chunk_byte_offset", "chunk_byte_size"
"""Columns of the table: a chunk's id, where its message begins behind kind and length, and how long it is."""


@dataclass(frozen=True)
class Schema:
    """Of all components of all entities of a store."""

    content: bytes = field(compare=False)
    """Protobuf's field. Rerun writes the entries in any order."""
    hash: bytes
    """By rerun, of the entries in order: schemas that say the same are equal."""


@dataclass(frozen=True)
class Manifest:
    """A store's chunks."""

    store: bytes
    """Its ids."""
    schema: Schema
    table: pa.RecordBatch
    """A row for each chunk: entity, place, and what components it has when."""
    others: tuple[Field, ...]
    """Fields of the table's message but the table itself."""

    @staticmethod
    def read(message: bytes | memoryview) -> Manifest:
        """Raises ValueError, KeyError or OSError where it is none."""
        fields = {number: _bytes(value) for number, value in read_fields(message)}
        table = dict(read_fields(fields[_TABLE]))
        content = pa.py_buffer(_bytes(table.pop(_PAYLOAD)))
        size = table.pop(_UNPACKED, None)
        if table.pop(_COMPRESSION, None) == _LZ4:
            content = pa.decompress(content, decompressed_size=size, codec="lz4_raw")
        return Manifest(
            fields[_STORE],
            Schema(fields[_SCHEMA], fields[_SCHEMA_HASH]),
            pa.ipc.open_stream(content).read_next_batch(),
            tuple(table.items()),
        )

    def moved(self, distance: int) -> Manifest:
        """The same chunks so many bytes farther in the file."""
        return replace(self, table=moved(self.table, distance))

    def written(self) -> bytes:
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, self.table.schema) as stream:
            stream.write_batch(self.table)
        content = sink.getvalue()
        packed = pa.compress(content, codec="lz4_raw", asbytes=True)
        table = [*self.others, (_PAYLOAD, packed), (_COMPRESSION, _LZ4), (_UNPACKED, content.size)]
        return write_fields(
            [
                (_STORE, self.store),
                (_SCHEMA, self.schema.content),
                (_SCHEMA_HASH, self.schema.hash),
                (_TABLE, write_fields(table)),
            ]
        )


def moved(table: pa.RecordBatch, distance: int) -> pa.RecordBatch:
    """The rows with `distance` added to their places."""
    column = table.schema.get_field_index(PLACE)
    places = pa.array((table.column(column).to_numpy().astype(np.int64) + distance).astype(np.uint64))
    return table.set_column(column, table.schema.field(column), places)


def with_packed_schema(message: bytes | memoryview) -> bytes:
    """A manifest with its schema as short as it can be: as rerun writes it, it is a fifth of a short episode's file."""
    fields = read_fields(message)
    short = packed(Schema(*(_bytes(dict(fields)[number]) for number in (_SCHEMA, _SCHEMA_HASH))))
    return write_fields([(n, short.content if n == _SCHEMA else value) for n, value in fields])


@lru_cache(maxsize=256)
def packed(schema: Schema) -> Schema:
    """Kept, because it takes 20 ms, and the episodes of a scene have mostly the same."""
    fields = read_fields(schema.content)
    return Schema(
        write_fields([(n, packed_schema(_bytes(v)) if n == _SCHEMA_MESSAGE else v) for n, v in fields]),
        schema.hash,
    )


# --- in a file ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Index:
    begin: int
    """Offset of its message, kind and length included; chunks end here."""
    manifests: Sequence[memoryview]


def read_index(file: BinaryIO, name: str) -> Index:
    """The index of `file`, called `name`. Raises OSError if it is not a complete ``.rrd``."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - _FOOTER.size, 0))
    footer = file.read()
    begin, length, _, mark = _FOOTER.unpack(footer) if len(footer) == _FOOTER.size else (0, 0, 0, b"")
    if mark != _FOOTER_MARK or begin + length + _FOOTER.size != size:
        raise OSError(errno.EIO, f"{name} does not end as rerun 0.41 ends a file")
    file.seek(begin)
    try:
        fields = read_fields(file.read(length))
    except ValueError as error:
        raise OSError(errno.EIO, f"{name} has a broken index ({error})") from error
    return Index(begin - MESSAGE.size, [memoryview(_bytes(value)) for n, value in fields if n == _MANIFESTS])


def index_bytes(begin: int, manifests: Sequence[bytes]) -> bytes:
    """The end of a file whose chunks end at `begin`."""
    index = write_fields([(_MANIFESTS, manifest) for manifest in manifests])
    hashed = xxhash.xxh32_intdigest(index, seed=_HASH_SEED)
    footer = _FOOTER.pack(begin + MESSAGE.size, len(index), hashed, _FOOTER_MARK)
    return MESSAGE.pack(_INDEX_KIND, len(index)) + index + footer


def _bytes(value: int | memoryview | bytes) -> bytes:
    if isinstance(value, int):
        raise ValueError("a number where a message is expected")
    return bytes(value)

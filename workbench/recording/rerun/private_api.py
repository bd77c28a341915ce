"""Rerun 0.41's private names: a file's index, bytes of a chunk; and protobuf messages."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import pyarrow as pa
from rerun.chunk import LazyStore
from rerun.error_utils import RerunWarning

from workbench.machine.versions import PrivateName

READING = "reading and recording .rrd files"
PRIVATE_NAMES = (
    PrivateName("rerun.chunk:LazyStore", "_internal", READING),
    PrivateName("rerun_bindings:LazyStoreInternal", "_chunk_index", READING),
)
"""Those that this module uses."""

# Opening a truncated file raises an error; this warning would repeat it in the terminal.
warnings.filterwarnings("ignore", "RRD file has no footer", RerunWarning)


@dataclass(frozen=True)
class IndexedChunk:
    """A chunk in the index at the end of an ``.rrd``."""

    entity: str
    rows: int
    static: bool
    begin: int
    """Offset of its first byte in the file."""
    end: int
    """Offset behind its last byte."""
    id: bytes
    """Rerun's globally unique id: the same id in two files is the same content."""
    unpacked: int
    """Uncompressed size in bytes."""
    components: tuple[str, ...]
    """Components with rows in it."""
    steps: tuple[int, int] | None
    """First and last value of the timeline; None if it has none."""


def index_of(store: LazyStore, timeline: str | None = None) -> list[IndexedChunk]:
    """The chunks of an ``.rrd``, without decoding any.

    Args:
        timeline: the one for `IndexedChunk.steps`, and for `IndexedChunk.components` of chunks that are not static.
    """
    _, index = store._internal._chunk_index()
    names = (
        "entity_path",
        "num_rows",
        "is_static",
        "byte_offset",
        "byte_size",
        "id",
        "byte_size_uncompressed",
    )
    columns = [index.column(f"chunk_{name}").to_pylist() for name in names]
    components: list[list[str]] = [[] for _ in range(index.num_rows)]
    steps: list[tuple[int, int] | None] = [None] * index.num_rows
    if timeline is not None and f"{timeline}:start" in index.schema.names:
        ends = (index.column(f"{timeline}:{end}").cast(pa.int64()).to_pylist() for end in ("start", "end"))
        steps = [None if first is None else (first, last) for first, last in zip(*ends)]
        counted = f"{timeline}:", ":num_rows"
        for name in index.schema.names:
            if name.startswith(counted[0]) and name.endswith(counted[1]):
                component = name[len(counted[0]) : -len(counted[1])]
                for chunk, count in enumerate(index.column(name).to_pylist()):
                    if count:
                        components[chunk].append(component)
    return [
        IndexedChunk(entity, rows, static, offset, offset + size, id, unpacked, tuple(held), span)
        for (entity, rows, static, offset, size, id, unpacked), held, span in zip(
            zip(*columns), components, steps, strict=True
        )
    ]


_COMPRESSION, _UNPACKED, _ENCODING, _PAYLOAD = 2, 3, 4, 5
"""Fields of ``ArrowMsg`` in rerun's ``log_msg.proto``."""
_LZ4, _ARROW_IPC = 2, 1
_MOST_PACKED, _SMALL = 255, 4096
"""Largest compression ratio of LZ4, and a size that is always allowed."""


def decode_chunk(message: bytes) -> pa.RecordBatch:
    """The table in a chunk, from its bytes in the file.

    Rerun's reader returns all chunks of an entity or none, and a camera's are hundreds of megabytes. A chunk is a protobuf
    message with an Arrow stream in it (``rerun/proto/rerun/v1alpha1/log_msg.proto``).

    Raises:
        ValueError: it cannot be decoded.
    """
    try:
        fields = dict(read_fields(message))
        payload, unpacked = fields[_PAYLOAD], fields.get(_UNPACKED)
        if fields.get(_ENCODING) != _ARROW_IPC or isinstance(payload, int):
            raise ValueError("in another encoding")
        content = pa.py_buffer(payload)
        if fields.get(_COMPRESSION) == _LZ4 and isinstance(unpacked, int):
            if unpacked > _MOST_PACKED * len(payload) + _SMALL:
                raise ValueError(f"{len(payload)} bytes that claim to be {unpacked}")
            content = pa.decompress(content, decompressed_size=unpacked, codec="lz4_raw")
        return pa.ipc.open_stream(content).read_next_batch()
    except (KeyError, StopIteration, ValueError, OSError) as error:
        raise ValueError(f"not a chunk of rerun ({error})") from error


# --- protobuf --------------------------------------------------------------------------------------
#
# Only the two wire types in rerun's files: varint and bytes. Google's library needs message definitions, which rerun's
# wheel does not include. Format: https://protobuf.dev/programming-guides/encoding/

_NUMBER, _BYTES = 0, 2
Field = tuple[int, int | memoryview | bytes]
"""Number and value; a nested message is bytes."""


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
            raise ValueError("a wire type that rerun does not write")
    return fields


def _varint(content: memoryview) -> tuple[int, memoryview]:
    value = shift = 0
    for place, byte in enumerate(content[:10]):
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, content[place + 1 :]
        shift += 7
    raise ValueError("a number without an end")

"""Put a blueprint into an ``.rrd`` that is whole.

What writes chunks to a file (``LazyChunkStream.write_rrd``) writes those of a recording alone. Rerun's other way, a ``RecordingStream`` that
saves to a file, takes a blueprint, but it writes on threads of its own: a disk that is full makes it wait for ever, what it could not
write it does not say, and their start and end is a quarter of what a short episode's file costs (measured).

An ``.rrd`` is a header of 12 bytes, messages, each with its kind and length before it (16 bytes), the last of them the index, and 32 bytes
that say where the index is and how it hashes (crate ``re_log_encoding``, ``rrd/frames.rs``; ``rerun/proto/rerun/v1alpha1/log_msg.proto``). The index
is a list of manifests, one a store, and a blueprint is a store. So a blueprint's messages go before the index, where they move nothing that it
speaks of; their own manifest, which rerun made, is told how far they moved and added to the list.
"""

from __future__ import annotations

import errno
import os
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings
import xxhash
from rerun.chunk import RrdReader

from workbench.recording.rerun.private_api import Field, index_of, read_fields, write_fields

_HEADER = 12
_MESSAGE = struct.Struct("<QQ")
_INDEX_KIND = 0
_FOOTER = struct.Struct("<QQI12s")
"""Where the index begins (without its kind and length), how long it is, its hash, and whose footer this is."""
_FOOTER_MARK = b"RRF2FOOT" + (1).to_bytes(4, "little")
_HASH_SEED = 7850921
"""Rerun's ``StreamFooter::CRC_SEED``."""
_MANIFESTS = 1
"""Field of ``RrdFooter``."""
_TABLE = 4
"""Field of ``RrdManifest``: where the chunks are. Of what that is, the fields:"""
_PAYLOAD, _COMPRESSION, _UNPACKED = 2, 3, 4
_LZ4 = 2
_PLACE = "chunk_byte_offset"


@dataclass(frozen=True)
class BlueprintBytes:
    """A blueprint as rerun encodes it, with the message that says to use it, at once and by default."""

    messages: bytes
    manifest: Sequence[Field]
    """All but its table."""
    table: Sequence[Field]
    """All but its payload."""
    places: pa.RecordBatch
    """The payload, as if `messages` came right after the header."""

    def manifest_at(self, begin: int) -> bytes:
        """What the index says of `messages` that begin `begin` bytes after the beginning of a file."""
        column = self.places.schema.get_field_index(_PLACE)
        places = pa.array(self.places.column(column).to_numpy() + np.uint64(begin - _HEADER))
        moved = self.places.set_column(column, self.places.schema.field(column), places)
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, moved.schema) as stream:
            stream.write_batch(moved)
        content = sink.getvalue()
        packed = pa.compress(content, codec="lz4_raw", asbytes=True)
        table = [*self.table, (_PAYLOAD, packed), (_COMPRESSION, _LZ4), (_UNPACKED, content.size)]
        return write_fields([*self.manifest, (_TABLE, write_fields(table))])


_encoding = threading.Lock()
"""Rerun calls back from a thread of its own, for which it needs the interpreter's lock: two threads that are at this wait for each other
for ever (seen)."""


def encode_blueprint(application_id: str, blueprint: rrb.Blueprint) -> BlueprintBytes:
    with _encoding, _rerun_on():
        stream = _encoded(application_id, blueprint)
    begin, length, _ = _read_footer(stream[-_FOOTER.size :], len(stream), "a blueprint")
    (manifest,) = [field for field in read_fields(stream[begin : begin + length]) if field[0] == _MANIFESTS]
    fields = _message(manifest)
    (table,) = [field for field in fields if field[0] == _TABLE]
    entries = dict(_message(table))
    content = pa.py_buffer(entries[_PAYLOAD])
    if entries[_COMPRESSION] == _LZ4:
        content = pa.decompress(content, decompressed_size=entries[_UNPACKED], codec="lz4_raw")
    return BlueprintBytes(
        messages=stream[_HEADER : begin - _MESSAGE.size],
        manifest=[field for field in fields if field[0] != _TABLE],
        table=[pair for pair in entries.items() if pair[0] not in (_PAYLOAD, _COMPRESSION, _UNPACKED)],
        places=pa.ipc.open_stream(content).read_next_batch(),
    )


@contextmanager
def _rerun_on() -> Iterator[None]:
    """Whoever runs with ``RERUN=off`` means the logging in their own code: rerun would make no blueprint either."""
    entries = os.environ.get("RERUN")
    if entries is None:
        yield
        return
    os.environ["RERUN"] = "on"
    try:
        yield
    finally:
        os.environ["RERUN"] = entries


def _encoded(application_id: str, blueprint: rrb.Blueprint) -> bytes:
    layout = rr.RecordingStream._from_native(
        rerun_bindings.new_blueprint(
            application_id=application_id, make_default=False, make_thread_default=False, default_enabled=True
        )
    )
    layout.set_time("blueprint", sequence=0)
    blueprint._log_to_stream(layout)
    streams: list[bytes] = []
    rerun_bindings.set_callback_sink_blueprint(streams.append, True, True, layout.to_native())
    layout.flush()
    layout.disconnect()
    del layout
    rerun_bindings.flush_and_cleanup_orphaned_recordings()  # else its threads live as long as the process
    return streams[-1]  # the one before it has no message


def add_blueprint(path: Path, blueprint: BlueprintBytes) -> None:
    """Put `blueprint` into the file at `path`.

    Raises:
        OSError: it cannot be read or written, or does not end as an ``.rrd`` with an index does.
    """
    with path.open("r+b") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - _FOOTER.size, 0))
        begin, length, mark = _read_footer(file.read(), size, path.name)
        file.seek(begin)
        index = file.read(length)
        messages_at = begin - _MESSAGE.size
        index += write_fields([(_MANIFESTS, blueprint.manifest_at(messages_at))])
        index_at = begin + len(blueprint.messages)
        hashed = xxhash.xxh32_intdigest(index, seed=_HASH_SEED)
        file.seek(messages_at)
        file.write(blueprint.messages)
        file.write(_MESSAGE.pack(_INDEX_KIND, len(index)))
        file.write(index)
        file.write(_FOOTER.pack(index_at, len(index), hashed, mark))


def blueprint_stream(path: Path) -> bytes | None:
    """The blueprint that `add_blueprint` put into the file at `path`, as a stream of its own; None where there is none.

    For who reads a file from its beginning, and would show it in an arrangement of its own until the blueprint comes. Raises OSError,
    ValueError or RuntimeError where the file is no ``.rrd``.
    """
    last = max((chunk.end for chunk in index_of(RrdReader(path).store())), default=0)
    with path.open("rb") as file:
        header = file.read(_HEADER)
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - _FOOTER.size, 0))
        begin, _, _ = _read_footer(file.read(), size, path.name)
        file.seek(last)
        messages = file.read(max(begin - _MESSAGE.size - last, 0))
    return header + messages if last and messages else None


def _message(field: Field) -> list[Field]:
    value = field[1]
    assert not isinstance(value, int)
    return read_fields(value)


def _read_footer(footer: bytes, size: int, name: str) -> tuple[int, int, bytes]:
    """Where the index of a file of `size` bytes begins, its length, and the mark. Raises OSError where it is another's footer."""
    begin, length, _, mark = _FOOTER.unpack(footer) if len(footer) == _FOOTER.size else (0, 0, 0, b"")
    if mark != _FOOTER_MARK or begin + length + _FOOTER.size != size:
        raise OSError(errno.EIO, f"{name} does not end as rerun 0.41 ends a file")
    return begin, length, mark

"""Adds a blueprint to a complete ``.rrd``."""

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
"""Offset of the index (behind its kind and length), its length, its hash, and the mark."""
_FOOTER_MARK = b"RRF2FOOT" + (1).to_bytes(4, "little")
_HASH_SEED = 7850921
"""Rerun's ``StreamFooter::CRC_SEED``."""
_MANIFESTS = 1
"""Field of ``RrdFooter``."""
_TABLE = 4
"""Field of ``RrdManifest``: the table of chunks. Its fields:"""
_PAYLOAD, _COMPRESSION, _UNPACKED = 2, 3, 4
_LZ4 = 2
_PLACE = "chunk_byte_offset"


@dataclass(frozen=True)
class BlueprintBytes:
    """An encoded blueprint, with the message that activates it and makes it the default."""

    messages: bytes
    manifest: Sequence[Field]
    """All but its table."""
    table: Sequence[Field]
    """All but its payload."""
    places: pa.RecordBatch
    """The payload, with offsets for `messages` right behind the header."""

    def manifest_at(self, begin: int) -> bytes:
        """The manifest of `messages` at offset `begin` of a file."""
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
"""Rerun calls back on its own thread, which needs the interpreter's lock: two threads in this call deadlock (seen)."""


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
    """Override ``RERUN=off`` of the user, which is for logging in their code: with it rerun makes no blueprint."""
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
    rerun_bindings.flush_and_cleanup_orphaned_recordings()  # else its threads never end
    return streams[-1]  # the stream before has no messages


def add_blueprint(path: Path, blueprint: BlueprintBytes) -> None:
    """Add `blueprint` to the file at `path`.

    ``LazyChunkStream.write_rrd`` writes the chunks of a recording only. Rerun's ``RecordingStream`` takes a blueprint, but
    writes on threads of its own: it waits for ever on a full disk, does not report what it could not write, and starting
    and ending them takes a quarter of the time of a short episode's file (measured).

    An ``.rrd`` is a header of 12 bytes, messages with kind and length (16 bytes) before each, the last one the index, and
    a footer of 32 bytes with offset and hash of the index (crate ``re_log_encoding``, ``rrd/frames.rs``;
    ``rerun/proto/rerun/v1alpha1/log_msg.proto``). The index is a list of manifests, one per store, and a blueprint is a
    store. So the blueprint's messages go in front of the index, where they move no other message, and their manifest,
    with shifted offsets, is added to the list.

    Raises:
        OSError: it cannot be read or written, or is not a complete ``.rrd``.
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
    """The blueprint that `add_blueprint` added to the file at `path`, as a stream; None if there is none.

    Send it before the file: a viewer that reads the file from its beginning uses its own layout until the blueprint
    comes. Raises OSError, ValueError or RuntimeError if the file is not an ``.rrd``.
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
    """Offset and length of the index of a file of `size` bytes, and the mark. Raises OSError if the footer is invalid."""
    begin, length, _, mark = _FOOTER.unpack(footer) if len(footer) == _FOOTER.size else (0, 0, 0, b"")
    if mark != _FOOTER_MARK or begin + length + _FOOTER.size != size:
        raise OSError(errno.EIO, f"{name} does not end as rerun 0.41 ends a file")
    return begin, length, mark

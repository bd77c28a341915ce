"""Adds a blueprint to a complete ``.rrd``."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings
from rerun.chunk import RrdReader

from workbench.recording.rerun.private_api import index_of
from workbench.recording.rerun.rrd_index import (
    HEADER_SIZE,
    Manifest,
    index_bytes,
    packed,
    read_index,
    with_packed_schema,
)


@dataclass(frozen=True)
class BlueprintBytes:
    """An encoded blueprint, with the message that activates it and makes it the default."""

    messages: bytes
    manifest: Manifest
    """With places for `messages` right behind the header."""

    def manifest_at(self, begin: int) -> bytes:
        """The manifest of `messages` at offset `begin` of a file."""
        return self.manifest.moved(begin - HEADER_SIZE).written()


_encoding = threading.Lock()
"""Rerun calls back on its own thread, which needs the interpreter's lock: two threads in this call deadlock (seen)."""


def encode_blueprint(application_id: str, blueprint: rrb.Blueprint) -> BlueprintBytes:
    with _encoding, _rerun_on():
        stream = _encoded(application_id, blueprint)
    index = read_index(BytesIO(stream), "a blueprint")
    manifest = Manifest.read(index.manifests[0])
    manifest = replace(manifest, schema=packed(manifest.schema))
    return BlueprintBytes(stream[HEADER_SIZE : index.begin], manifest)


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
    layout.set_log_time_enabled(False)  # else the index has three more columns for each component
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
    """Add `blueprint` to the file at `path`, and pack the schema in its index.

    ``LazyChunkStream.write_rrd`` writes the chunks of a recording only. Rerun's ``RecordingStream`` takes a blueprint, but
    writes on threads of its own: it waits for ever on a full disk, does not report what it could not write, and starting
    and ending them takes a quarter of the time of a short episode's file (measured).

    A blueprint is a store. So its messages go in front of the index, where they move no other message, and its manifest,
    with shifted offsets, is added to the list.

    Raises:
        OSError: it cannot be read or written, or is not a complete ``.rrd``.
    """
    with path.open("r+b") as file:
        index = read_index(file, path.name)
        write_end(file, index.begin, [with_packed_schema(each) for each in index.manifests], blueprint)


def write_end(file: BinaryIO, end: int, manifests: Sequence[bytes], blueprint: BlueprintBytes) -> None:
    """Write `blueprint` and the index behind the chunks of `file`, which end at `end`. Raises OSError."""
    index = index_bytes(end + len(blueprint.messages), [*manifests, blueprint.manifest_at(end)])
    file.seek(end)
    file.write(blueprint.messages)
    file.write(index)
    file.truncate()


def blueprint_stream(path: Path) -> bytes | None:
    """The blueprint that `add_blueprint` added to the file at `path`, as a stream; None if there is none.

    Send it before the file: a viewer that reads the file from its beginning uses its own layout until the blueprint
    comes. Raises OSError, ValueError or RuntimeError if the file is not an ``.rrd``.
    """
    last = max((chunk.end for chunk in index_of(RrdReader(path).store())), default=0)
    with path.open("rb") as file:
        header = file.read(HEADER_SIZE)
        begin = read_index(file, path.name).begin
        file.seek(last)
        messages = file.read(max(begin - last, 0))
    return header + messages if last and messages else None

"""What rerun 0.41 must be asked for by names that are not quite public, because it leaks or hangs otherwise.

A `RecordingStream` has two threads. Rerun ends them when the last reference to the stream is gone, but
only when told to look. Its ``save(default_blueprint=...)`` makes a second stream for the blueprint,
which refers to itself through its own memory sink and so is never let go of: two threads and 0.4 MB an
episode for as long as the process lives (measured). And the thread that ``save`` writes with ends at
the first write that fails, after which a flush waits for its answer for ever: a full disk would not
fail, it would hang (seen, with the file size limited).

So rerun never gets to write a file. Encoding in memory would do for short episodes only: bytes that are drained in
between are a recording each, with an index each, and one behind the other are none (tried). What rerun writes goes into a pipe
instead, which a thread of ours empties whatever happens, and where the bytes land is the caller's affair.
"""

from __future__ import annotations

import fcntl
import os
import threading
import uuid
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings
from rerun.chunk import LazyStore, RrdReader
from rerun.error_utils import RerunWarning

# Whoever opens a file that was cut short is told so by an error; this says it once more, in rerun's words, on the terminal.
warnings.filterwarnings("ignore", "RRD file has no footer", RerunWarning)


@contextmanager
def recording_into(
    write: Callable[[bytes], object], application_id: str, blueprint: rrb.Blueprint
) -> Iterator[rr.RecordingStream]:
    """A new recording with its default blueprint, whose ``.rrd`` bytes go to `write` while it is filled.

    `write` is called on a thread of its own and must not raise. It has got everything when the block is left.
    """
    # Rerun derives a default id from the process, so two episodes of one process would be taken for one.
    recording = rr.RecordingStream(application_id, recording_id=uuid.uuid4().hex)
    layout = rr.RecordingStream._from_native(
        rerun_bindings.new_blueprint(
            application_id=application_id, make_default=False, make_thread_default=False, default_enabled=True
        )
    )
    arrangement = layout.memory_recording().storage
    out, into = _pipe()
    try:
        recording.save(f"/dev/fd/{into}")
    except BaseException:
        os.close(out)
        raise
    finally:
        os.close(into)
    pump = threading.Thread(target=_pump, args=(out, write), name="episode-rrd", daemon=True)
    pump.start()
    try:
        layout.set_time("blueprint", sequence=0)
        blueprint._log_to_stream(layout)
        # The blueprint's messages alone are not enough: this adds the one that says to use them. At once, too: as the
        # default alone it comes too late for the web viewer, which draws a frame of its own making before it has it.
        rerun_bindings.send_blueprint(arrangement, True, True, recording.to_native())
        yield recording
    finally:
        recording.disconnect()
        arrangement.drain_as_bytes()  # what is still in a sink when it is cut off gives a warning
        layout.disconnect()
        pump.join()


_PIPE_BYTES = 1 << 20
"""More than this an ordinary user may not ask for (Linux, pipe(7))."""


def _pipe() -> tuple[int, int]:
    out, into = os.pipe()
    if hasattr(fcntl, "F_SETPIPE_SZ"):
        try:
            # At the usual 64 kB two threads wake each other a hundred times for one scene's textures.
            fcntl.fcntl(into, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        except OSError:  # the user's share of pipe memory is used up: it works as it is
            pass
    return out, into


def _pump(out: int, write: Callable[[bytes], object]) -> None:
    try:
        while content := os.read(out, _PIPE_BYTES):
            write(content)
    finally:
        os.close(out)


def release_streams() -> None:
    """End the threads of every stream that nothing refers to any more. Streams in use are left alone."""
    rerun_bindings.flush_and_cleanup_orphaned_recordings()


@dataclass(frozen=True)
class IndexedChunk:
    """What the index at the end of an ``.rrd`` says of one chunk."""

    entity: str
    rows: int
    static: bool
    begin: int
    """Where in the file its bytes begin."""
    end: int
    """Where they end."""
    id: bytes
    """Rerun's own, unique for ever: the same chunk in two files is the same content."""
    unpacked: int
    """How many bytes it is when it is not compressed."""
    components: tuple[str, ...]
    """That it has rows of."""
    steps: tuple[int, int] | None
    """The first and last of a timeline; None where it has none of them."""


def read_index(path: Path) -> list[IndexedChunk]:
    """The chunks of the recording in `path`; none of them is decoded. Raises ValueError or OSError where there is no index."""
    return index_of(RrdReader(path).store())


def index_of(store: LazyStore, timeline: str | None = None) -> list[IndexedChunk]:
    """The chunks of an ``.rrd``; none of them is decoded.

    Args:
        timeline: of which `IndexedChunk.steps` and, of chunks that are not static, `IndexedChunk.components` are asked.
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
_NUMBER, _BYTES = 0, 2
"""How a field of protobuf is written."""


def decode_chunk(message: bytes) -> pa.RecordBatch:
    """The bytes in a file from `IndexedChunk.begin` to its end as the table that they are.

    Rerun's own reader gives all chunks of an entity or none, and a camera's are hundreds of megabytes. What lies there is
    a protobuf message with an Arrow stream in it (``rerun/proto/rerun/v1alpha1/log_msg.proto``).

    Raises:
        ValueError: they are no chunk.
    """
    fields: dict[int, int | memoryview] = {}
    rest = memoryview(message)
    try:
        while len(rest):
            key, rest = _varint(rest)
            if key & 7 == _NUMBER:
                fields[key >> 3], rest = _varint(rest)
            elif key & 7 == _BYTES:
                length, rest = _varint(rest)
                fields[key >> 3], rest = rest[:length], rest[length:]
            else:
                raise ValueError("a field of a kind that rerun does not write")
        payload, unpacked = fields[_PAYLOAD], fields.get(_UNPACKED)
        if fields.get(_ENCODING) != _ARROW_IPC or isinstance(payload, int):
            raise ValueError("in another encoding")
        content = pa.py_buffer(payload)
        if fields.get(_COMPRESSION) == _LZ4 and isinstance(unpacked, int):
            content = pa.decompress(content, decompressed_size=unpacked, codec="lz4_raw")
        return pa.ipc.open_stream(content).read_next_batch()
    except (KeyError, StopIteration, ValueError, OSError) as error:
        raise ValueError(f"its bytes are no chunk of rerun's ({error})") from error


def _varint(content: memoryview) -> tuple[int, memoryview]:
    value = shift = 0
    for place, byte in enumerate(content[:10]):
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, content[place + 1 :]
        shift += 7
    raise ValueError("a number without an end")


def store_id(path: Path) -> str:
    """What rerun's viewer calls the recording in `path` when it is told something about it (rerun's
    ``viewer_control.proto``). Raises ValueError or OSError where there is none.
    """
    recordings = RrdReader(path).recordings()
    if not recordings:
        raise ValueError(f"{path.name} holds no recording")
    application = recordings[0].application_id.replace("\\", "\\\\").replace(":", "\\:")
    return f"Recording:{application}:{recordings[0].recording_id}"

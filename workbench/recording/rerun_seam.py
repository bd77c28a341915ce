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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings
from rerun.chunk import RrdReader


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
    end: int
    """Where in the file its bytes end."""


def read_index(path: Path) -> list[IndexedChunk]:
    """The chunks of the recording in `path`; none of them is decoded. Raises ValueError or OSError where there is no index."""
    _, index = RrdReader(path).store()._internal._chunk_index()
    names = ("entity_path", "num_rows", "is_static", "byte_offset", "byte_size")
    columns = [index.column(f"chunk_{name}").to_pylist() for name in names]
    return [
        IndexedChunk(entity, rows, static, offset + size)
        for entity, rows, static, offset, size in zip(*columns)
    ]


def store_id(path: Path) -> str:
    """What rerun's viewer calls the recording in `path` when it is told something about it (rerun's
    ``viewer_control.proto``). Raises ValueError or OSError where there is none.
    """
    recordings = RrdReader(path).recordings()
    if not recordings:
        raise ValueError(f"{path.name} holds no recording")
    application = recordings[0].application_id.replace("\\", "\\\\").replace(":", "\\:")
    return f"Recording:{application}:{recordings[0].recording_id}"

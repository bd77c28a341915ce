"""Writes chunks and a blueprint to a file with rerun's ``RecordingStream``."""

from __future__ import annotations

import os
import select
import threading
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Protocol

import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import Chunk

from workbench.episodes.rerun.entities import CAMERAS

_COPIED_BYTES = 1 << 16
"""Number of bytes that are copied at once: the capacity of a pipe."""
_one_at_a_time = threading.Lock()
"""Serializes writers: rerun 0.41 deadlocks if one thread makes a stream while another thread runs
`_end_threads`. And if two threads change and restore an environment variable, one may restore the value that
the other has set."""


def encode_blueprint(application_id: str, blueprint: rrb.Blueprint) -> bytes:
    """`blueprint` as the content of an ``.rbl``."""
    content = BytesIO()
    with _one_at_a_time, _copied_to(content) as copy:
        with _rerun_enabled():
            blueprint.save(application_id, copy.path)
        _end_threads(application_id)
    return content.getvalue()


def write_recording(path: Path, application_id: str, blueprint: bytes, chunks: Iterable[Chunk]) -> None:
    """Write `blueprint` to `path`, as the active and the default blueprint, and then `chunks` as one
    recording.

    ``LazyChunkStream.write_rrd`` is faster, but writes only one store, and a blueprint is a second store.

    Raises:
        OSError: `path` cannot be written.
        Exception: raised by `chunks`.
    """
    with _one_at_a_time, path.open("wb", buffering=0) as file, _copied_to(file) as copy:
        with _rerun_enabled():
            # A new id, because rerun's default is one per process: two episodes of one process would become
            # one recording.
            stream = rr.RecordingStream(application_id, recording_id=uuid.uuid4().hex, send_properties=False)
        try:
            stream.save(copy.path)
            stream.log_file_from_contents("blueprint.rbl", blueprint)
            # Write the blueprint first. A viewer that reads the file from its beginning uses its own layout
            # until it has read the blueprint.
            stream.flush()
            for chunk in chunks:
                copy.check()
                stream.send_chunks(chunk)
                if not chunk.is_static and chunk.entity_path.startswith(f"{CAMERAS}/"):
                    # Pictures are megabytes: without this, rerun queues a hundred megabytes of a long episode.
                    stream.flush()
        finally:
            stream.disconnect()
            del stream
            _end_threads(application_id)


@contextmanager
def _rerun_enabled() -> Iterator[None]:
    """Override the user's ``RERUN=off``: it is meant for logging in the user's code, but with it rerun would
    silently write nothing here."""
    entries = os.environ.get("RERUN")
    if entries is None:
        yield
        return
    os.environ["RERUN"] = "on"
    try:
        yield
    finally:
        os.environ["RERUN"] = entries


def _end_threads(application_id: str) -> None:
    """End the two threads that each disconnected stream leaves running."""
    # Do nothing if there is a global recording: `rr.init` would turn it off, and the user's code may log to
    # it.
    if rr.get_global_data_recording() is None and rr.get_thread_local_data_recording() is None:
        rr.init(application_id, init_logging=False)


class _File(Protocol):
    def write(self, content: memoryview, /) -> int: ...


class _Copy(threading.Thread):
    """Thread that copies the content of a pipe to a file.

    Rerun writes to the pipe instead of the file: if a file cannot be written, for example because the disk is full, rerun
    0.41 prints the error instead of raising it, or hangs.
    """

    def __init__(self, file: _File) -> None:
        super().__init__(name="rerun-copy", daemon=True)
        self._file = file
        self._error: BaseException | None = None
        self._read_end, self._write_end = os.pipe()
        self._finished = os.eventfd(0)

    @property
    def path(self) -> str:
        return f"/proc/self/fd/{self._write_end}"

    def check(self) -> None:
        """Raise the error that writing to the file gave, if any."""
        if self._error is not None:
            raise self._error

    def run(self) -> None:
        poll = select.poll()
        for end in (self._read_end, self._finished):
            poll.register(end, select.POLLIN)
        buffer = memoryview(bytearray(_COPIED_BYTES))
        while True:
            ready = {end for end, _ in poll.poll()}
            # Do not wait for EOF: it does not arrive while a process that was forked meanwhile holds the pipe.
            if self._read_end not in ready:
                return
            rest = buffer[: os.readv(self._read_end, [buffer])]
            while self._error is None and rest:
                try:
                    rest = rest[self._file.write(rest) :]
                except BaseException as error:
                    self._error = error  # keep reading, or rerun may hang

    def finish(self) -> None:
        """Wait until everything that rerun has written is copied."""
        os.eventfd_write(self._finished, 1)
        self.join()
        for end in (self._read_end, self._write_end, self._finished):
            os.close(end)


@contextmanager
def _copied_to(file: _File) -> Iterator[_Copy]:
    """Context manager with a `_Copy` to `file`. Raises OSError if `file` cannot be written."""
    copy = _Copy(file)
    copy.start()
    try:
        yield copy
    finally:
        copy.finish()
    copy.check()

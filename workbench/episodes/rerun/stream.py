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

from workbench.episodes.rerun.layout import CAMERAS

_COPIED_BYTES = 1 << 16
"""Bytes that are copied at once: what a pipe holds."""
_one_at_a_time = threading.Lock()
"""Rerun 0.41 waits for ever where one thread makes a stream while another one ends the threads of streams. And two that
change and restore a variable of the environment may restore the other's change."""


def encode_blueprint(application_id: str, blueprint: rrb.Blueprint) -> bytes:
    """`blueprint` as the content of an ``.rbl``."""
    content = BytesIO()
    with _one_at_a_time, _copied_to(content) as copy:
        with _rerun_enabled():
            blueprint.save(application_id, copy.path)
        _end_threads(application_id)
    return content.getvalue()


def write_recording(path: Path, application_id: str, blueprint: bytes, chunks: Iterable[Chunk]) -> None:
    """Write `chunks` as one recording to `path`, after `blueprint`, which becomes the active and the default one.

    ``LazyChunkStream.write_rrd`` is faster, but writes one store only, and a blueprint is a second one.

    Raises:
        OSError: it cannot be written.
        Exception: an error of `chunks`.
    """
    with _one_at_a_time, path.open("wb", buffering=0) as file, _copied_to(file) as copy:
        with _rerun_enabled():
            # Rerun's default id is that of the process: two episodes of one process would become one.
            stream = rr.RecordingStream(application_id, recording_id=uuid.uuid4().hex, send_properties=False)
        try:
            stream.save(copy.path)
            stream.log_file_from_contents("blueprint.rbl", blueprint)
            # Waits for the blueprint. A viewer that reads the file from its beginning uses its own layout until it comes.
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
    """Override ``RERUN=off`` of the user, which is for logging in their code: with it rerun writes nothing, silently."""
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
    """End the threads of disconnected streams. Else each leaves two, for as long as the process lives."""
    # It also turns off the global recording, to which the user's code may log: their data count more than our threads.
    if rr.get_global_data_recording() is None and rr.get_thread_local_data_recording() is None:
        rr.init(application_id, init_logging=False)


class _File(Protocol):
    def write(self, content: memoryview, /) -> int: ...


class _Copy(threading.Thread):
    """A pipe, and a thread that copies what comes out of it to a file.

    Rerun gets the pipe instead of the file: where a file cannot be written, for example because the disk is full, rerun
    0.41 prints the error and does not raise it, or waits for ever.
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
        """Raise the error of the file, if there was one."""
        if self._error is not None:
            raise self._error

    def run(self) -> None:
        poll = select.poll()
        for end in (self._read_end, self._finished):
            poll.register(end, select.POLLIN)
        buffer = memoryview(bytearray(_COPIED_BYTES))
        while True:
            ready = {end for end, _ in poll.poll()}
            # Not until the end of the file: it does not come while a process that was forked meanwhile has the pipe.
            if self._read_end not in ready:
                return
            rest = buffer[: os.readv(self._read_end, [buffer])]
            while self._error is None and rest:
                try:
                    rest = rest[self._file.write(rest) :]
                except BaseException as error:
                    self._error = error  # and go on reading: rerun may wait for ever

    def finish(self) -> None:
        """Return when everything that rerun has written is copied."""
        os.eventfd_write(self._finished, 1)
        self.join()
        for end in (self._read_end, self._write_end, self._finished):
            os.close(end)


@contextmanager
def _copied_to(file: _File) -> Iterator[_Copy]:
    """Raises OSError if `file` cannot be written."""
    copy = _Copy(file)
    copy.start()
    try:
        yield copy
    finally:
        copy.finish()
    copy.check()

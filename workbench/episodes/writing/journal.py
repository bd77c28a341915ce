"""The crash-safe log of a running episode."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import stat
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import fields
from functools import lru_cache
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zipfile import BadZipFile

import numpy as np
import pyarrow as pa

from workbench.envs.scene.shapes import Material, Mesh, SceneGeometry, Visual
from workbench.machine.files import open_regular_file

FOLDER = ".writing"
SCENE_SUFFIX = ".scene"
SYNC_SECONDS = 0.4
"""Interval of writing and syncing."""
_BATCH_BYTES = 2 << 20
"""Queued bytes from which `append` writes by itself, so that memory stays bounded if the disk is slower than the episode."""
_MAX_CACHED_BATCHES = 4
"""Maximum number of batches that a reader caches, because it reads each batch again for every camera."""
_SCHEMA = pa.schema([("kind", pa.string()), ("number", pa.int32()), ("value", pa.binary())])
_BEGIN = _SCHEMA.serialize().size
"""Offset of the first batch."""
_MARK = b"\xff\xff\xff\xff"
"""Marker at the beginning of each Arrow message."""


class JournalEntry(NamedTuple):
    kind: str
    number: int
    value: bytes


JournalItem = JournalEntry | Future[list[JournalEntry]]


class Journal:
    """The journal of a running episode, ``.writing/<id>.arrow`` in the recordings' folder.

    The files of an episode can only be written when it has ended (rerun's index comes last, HDF5 cannot be truncated, both
    need whole columns), and the task's code may hang, exhaust the memory or crash before that. So every row goes into a
    journal, from which the writer or the next process makes the files (`finish_or_recover.recover`).

    The journal is an Arrow stream of one table with the columns ``kind``, ``number`` and ``value``; the
    stream may end anywhere. A state's pictures come before its row, so a state is complete or missing. The
    kinds of entries, each with the meaning of its number and of its value:

    - ``header``: JSON; the scene's meshes are in a file next to it (`write_scene`);
    - ``layout`` `number`: the layout's text (`columns`); ``row`` `number`: one or several consecutive rows of that layout;
    - ``acted`` `action`: source of the actions from this number on, if it differs from the header's;
    - ``placed`` `state`: JSON of a camera that was placed by hand, from this state on (`MovedCamera`);
    - ``entry`` `state`: JSON of an entry of ``evaluate()`` that is not a number and changes here (`columns.TextWriter`);
    - ``drawing`` `state`: msgpack of a drawing that changes here (`drawings.DrawingWriter`);
    - ``camera/<i>`` `state`: (7,) float32 pose; ``picture/<i>/<modality>`` `state`: the encoded picture.

    One thread writes all journals of the process every `SYNC_SECONDS`, another one syncs them. The file is locked (``flock``)
    while it is open; the system releases the lock of a dead process, which distinguishes dead writers from live ones.
    """

    def __init__(self, path: Path) -> None:
        """Create the journal `path`, which must not exist, and its folder. Raises OSError."""
        self.path = path
        self._descriptor = _create(path)
        self._closer = weakref.finalize(self, os.close, self._descriptor)
        self._size = 0
        self._waiting: list[JournalItem] = []
        self._waiting_bytes = 0
        self._lock = threading.Lock()  # guards `_waiting`; not held during disk access
        self._writing = threading.Lock()
        self._syncing = threading.Lock()
        self._error: OSError | None = None
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with self._writing:
                self._put(_SCHEMA.serialize())
        except OSError:
            with contextlib.suppress(OSError):  # the first error is raised
                self.remove()
            raise
        journal_threads.watch(self)

    @property
    def descriptor(self) -> int:
        """File descriptor of the open journal; it holds the lock."""
        return self._descriptor

    @property
    def size(self) -> int:
        """Bytes written and queued."""
        return self._size + self._waiting_bytes

    def append(self, *items: JournalItem) -> None:
        """Queue the entries of a state, its row last.

        Entries that are still being encoded keep their place in the queue. The writing thread waits for them;
        the caller does not.

        Raises:
            OSError: an earlier entry could not be written or encoded; this state is not queued.
        """
        if self._error is not None:
            raise self._error
        added = sum([_size(item) for item in items if isinstance(item, JournalEntry)])
        with self._lock:
            self._waiting += items
            self._waiting_bytes += added
            full = self._waiting_bytes > _BATCH_BYTES
        for item in items:
            if not isinstance(item, JournalEntry):
                item.add_done_callback(self._count_bytes)
        if full:
            self.write()  # an error is raised by the next `append`, because this state is queued already

    def write(self) -> None:
        """Write what is queued, so that it survives the death of the process."""
        with self._writing:
            if self._error is not None or not self._closer.alive:
                return
            with self._lock:
                items, self._waiting = self._waiting, []
            entries, done, error = _resolve(items)
            if entries:
                columns = zip(*_rows_joined(entries))
                batch = pa.record_batch(
                    [pa.array(column, of.type) for of, column in zip(_SCHEMA, columns)], schema=_SCHEMA
                )
                try:
                    self._put(batch.serialize())
                except OSError as failed:
                    done, entries, error = 0, [], failed
            with self._lock:
                self._waiting = items[done:] + self._waiting
                self._waiting_bytes -= sum(map(_size, entries))
            self._error = error

    def _count_bytes(self, made: Future[list[JournalEntry]]) -> None:
        if not made.cancelled() and made.exception() is None:
            with self._lock:
                self._waiting_bytes += sum(map(_size, made.result()))

    def sync(self) -> None:
        """Write what is queued and sync it, so that it survives a power cut. If this fails, the next `append`
        raises.

        A sync may take long; other threads can write rows meanwhile.
        """
        self.write()
        with self._syncing:
            if self._error is not None or not self._closer.alive:
                return
            try:
                os.fsync(self._descriptor)
                _require_name(self._descriptor)
            except OSError as error:
                self._error = error

    def finish(self) -> None:
        """Write everything and stop the periodic writing; the file stays locked until `close`.

        Does not sync, because the files replace the journal soon. Retries entries that could not be written; raises OSError
        if they fail again.
        """
        journal_threads.remove(self)
        self._error = None
        self.write()
        if self._error is not None:
            raise self._error
        if self._closer.alive:
            _require_name(self._descriptor)

    def close(self) -> None:
        """Close and unlock the file."""
        journal_threads.remove(self)
        with self._syncing, self._writing:
            self._closer()

    def remove(self) -> None:
        """Close and delete the file."""
        try:
            self.path.unlink(missing_ok=True)
        finally:
            self.close()

    def _put(self, content: pa.Buffer) -> None:
        # After a partial write, the next call overwrites the incomplete batch: `_size` is unchanged. A reader
        # stops at an incomplete batch.
        view, end = memoryview(content), self._size
        while view:
            written = os.pwrite(self._descriptor, view, end)
            view, end = view[written:], end + written
        self._size = end


def _resolve(items: Sequence[JournalItem]) -> tuple[list[JournalEntry], int, OSError | None]:
    """(entries, number of items that gave them, error). With an error, the entries are
    those of the complete states before it."""
    entries: list[JournalEntry] = []
    whole, done = 0, 0
    for number, item in enumerate(items, 1):
        if not isinstance(item, JournalEntry):
            try:
                entries += item.result()
            except Exception as error:
                why = OSError(errno.EIO, f"a picture could not be encoded ({error})")
                return entries[:whole], done, why
            continue
        entries.append(item)
        if item.kind == "row":
            whole, done = len(entries), number
    return entries, len(items), None


def _rows_joined(entries: Iterable[JournalEntry]) -> Iterator[JournalEntry]:
    """Join consecutive rows of a layout to one entry: processing a hundred separate entries takes as long as
    making the files from them."""
    for (kind, number), run in groupby(entries, key=itemgetter(0, 1)):
        if kind == "row":
            yield JournalEntry(kind, number, b"".join([entry.value for entry in run]))
        else:
            yield from run


def _require_name(descriptor: int) -> None:
    """Raise OSError if the file was removed from its folder."""
    if os.fstat(descriptor).st_nlink == 0:
        gone = "the folder, or the file in it, was removed during the recording"
        raise FileNotFoundError(errno.ENOENT, gone)


def _size(entry: JournalEntry) -> int:
    return len(entry.value) + len(entry.kind) + 8


def _create(path: Path) -> int:
    for _ in range(10):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        except FileNotFoundError:  # another writer has just removed the empty folder
            continue
    raise FileNotFoundError(errno.ENOENT, "another process keeps removing the folder")


class _JournalThreads:
    """Threads that periodically write and sync all journals of this process, while there are any.

    There are two threads, because a sync may hang with the disk. Rows are written meanwhile, so that they
    survive if the process is killed.
    """

    def __init__(self) -> None:
        self._journals: set[Journal] = set()
        self._changed = threading.Condition()
        self._threads: dict[str, threading.Thread] = {}
        self.flush_first: list[weakref.WeakMethod[Callable[[], None]]] = []

    def watch(self, journal: Journal) -> None:
        with self._changed:
            self._journals.add(journal)
            for what, work in (("write", self._write), ("sync", self._sync)):
                thread = self._threads.get(what)
                if thread is None or not thread.is_alive():  # a forked child lacks the threads
                    thread = threading.Thread(target=work, name="episode-journals", daemon=True)
                    self._threads[what] = thread
                    thread.start()

    def remove(self, journal: Journal) -> None:
        with self._changed:
            self._journals.discard(journal)
            self._changed.notify_all()

    def flush(self) -> None:
        self.flush_first = [held for held in self.flush_first if held() is not None]
        for held in self.flush_first:
            if flush := held():
                flush()

    def _write(self) -> None:
        while journals := self._wait("write"):
            self.flush()
            for journal in journals:
                journal.write()

    def _sync(self) -> None:
        while journals := self._wait("sync"):
            for journal in journals:
                journal.sync()

    def _wait(self, what: str) -> list[Journal]:
        """Wait for the interval; returns the journals, or none if the thread should end."""
        with self._changed:
            wake = time.monotonic() + SYNC_SECONDS
            while self._journals and (left := wake - time.monotonic()) > 0:
                self._changed.wait(left)
            if not self._journals:
                self._threads.pop(what, None)
            return list(self._journals)


journal_threads = _JournalThreads()


def before_writing(flush: Callable[[], None]) -> None:
    """Call the bound method `flush` before each write of the journals, until its object is deleted.

    A caller that batches rows uses this to append them. `flush` runs on the journals' thread and must not
    raise.
    """
    journal_threads.flush_first.append(weakref.WeakMethod(flush))


class _BoundedFile:
    """A file for Arrow. Reads end at the end of the file: Arrow would allocate whatever size a damaged length
    claims."""

    mode = "rb"

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.size = file.seek(0, os.SEEK_END)
        self.seek, self.tell, self.close = file.seek, file.tell, file.close

    @property
    def closed(self) -> bool:
        return self._file.closed

    def read(self, size: int) -> bytes:
        return self._file.read(min(size, max(self.size - self._file.tell(), 0)))


class JournalReader:
    """Reads a journal up to its last complete batch."""

    def __init__(self, path: Path) -> None:
        """Raises OSError."""
        self.path = path
        self._file = _BoundedFile(open_regular_file(path))
        self._batch = lru_cache(maxsize=_MAX_CACHED_BATCHES)(self._read)
        self._end = _BEGIN
        """Offset of the end of the last complete batch that was read."""

    def __iter__(self) -> Iterator[tuple[int, list[JournalEntry]]]:
        """Offset and entries of each batch. Raises OSError."""
        begin = self._end = _BEGIN
        try:
            while True:
                batch, end = self._batch(begin)
                self._end = end
                yield (
                    begin,
                    [JournalEntry(*row) for row in zip(*(column.to_pylist() for column in batch.columns))],
                )
                begin = end
        except (EOFError, pa.ArrowInvalid):
            return
        except OSError as error:
            if error.errno is not None:  # Arrow's own OSErrors have no errno
                raise

    def lost_bytes(self) -> int:
        """Number of bytes from the batch at which the last iteration stopped, which is incomplete, to the end
        of the file. 0 if no complete batch follows: the journal is not damaged, only cut short while that
        batch was being written. Raises OSError."""
        size, at = self._file.size, self._end
        while (at := self._find_batch(at + 1, size)) < size:
            try:
                self._read(at)
            except (EOFError, OSError, pa.ArrowInvalid):
                continue
            return size - self._end
        return 0

    def _find_batch(self, begin: int, size: int) -> int:
        """Offset of the next marker of a batch; `size` if there is none."""
        held = b""
        while begin < size:
            self._file.seek(begin)
            held = self._file.read(_BATCH_BYTES)
            if (at := held.find(_MARK)) >= 0:
                return begin + at
            # The marker may cross the end of the block.
            begin += max(len(held) - len(_MARK) + 1, 1)
        return size

    def value(self, place: tuple[int, int]) -> bytes:
        """Value of an entry; `place` is (offset of its batch, index in the batch)."""
        return self._batch(place[0])[0].column(2)[place[1]].as_py()

    def _read(self, begin: int) -> tuple[pa.RecordBatch, int]:
        """The batch at offset `begin`, and its end. Raises OSError, EOFError or ArrowInvalid if it is incomplete."""
        self._file.seek(begin)
        batch = pa.ipc.read_record_batch(pa.ipc.read_message(self._file), _SCHEMA)
        batch.validate(full=True)  # invalid offsets would crash this process
        return batch, self._file.tell()

    def close(self) -> None:
        self._batch.cache_clear()
        self._file.close()


def remove_empty_folder(folder: Path) -> None:
    """Remove the folder of the journals if it is empty."""
    try:
        os.rmdir(folder / FOLDER)
    except OSError:  # not empty, or missing
        pass


def claim(path: Path) -> int | None:
    """Lock the journal of a dead writer; None if another process holds the lock, or the file is deleted.

    The lock lasts until the returned descriptor is closed.
    """
    try:
        if not stat.S_ISREG(os.lstat(path).st_mode):
            return None  # not a journal
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(descriptor).st_nlink > 0:  # else the lock's last holder has just deleted it
            return descriptor
    except BlockingIOError:
        pass
    except OSError:
        os.close(descriptor)
        raise
    os.close(descriptor)
    return None


# --- the scene's meshes ------------------------------------------------------------------------

_MESH = tuple(field.name for field in fields(Mesh))
_lock = threading.Lock()
_last: tuple[weakref.ref[SceneGeometry], Path] | None = None


def write_scene(geometry: SceneGeometry, path: Path) -> None:
    """Write `geometry` to `path`, which must not exist. Raises OSError.

    Meshes must be on the disk from the first row on. They take megabytes (the texture of ManiSkill's table alone 4 MB), and
    sixty-four envs may begin an episode at once, so episodes of one scene share one file by hard links. The format is a
    numpy archive of plain arrays and a line of JSON: reading it executes no code.
    """
    global _last
    with _lock:
        if _last is not None and _last[0]() is geometry and _last[1].parent == path.parent:
            try:
                os.link(_last[1], path)
                # Keep the newest name, which is deleted last: the next batch of episodes begins while the
                # files of this batch are made.
                _last = (_last[0], path)
                return
            except OSError:  # that episode's file is deleted, or the filesystem does not support links
                pass
        _write(geometry, path)
        _last = (weakref.ref(geometry), path)


def read_visuals(path: Path) -> tuple[Visual, ...]:
    """The visuals in a file of `write_scene`; none if it is missing or broken."""
    try:
        with open_regular_file(path) as file, np.load(file, allow_pickle=False) as archive:
            return tuple(_visuals(archive))
    except (OSError, BadZipFile, KeyError, ValueError, TypeError, EOFError):
        return ()


def _write(geometry: SceneGeometry, path: Path) -> None:
    arrays: dict[str, Any] = {}
    visuals = []
    for index, visual in enumerate(geometry.visuals):
        held = {name: getattr(visual.mesh, name) for name in _MESH}
        held |= {"texture": visual.material.texture, "envs": visual.envs, "bodies": visual.bodies}
        arrays |= {f"{index}/{name}": array for name, array in held.items() if array is not None}
        material = visual.material
        visuals.append([visual.name, material.base_color, material.metallic, material.roughness])
    arrays["scene"] = np.frombuffer(json.dumps({"visuals": visuals}).encode(), dtype=np.uint8)
    try:
        with path.open("xb") as file:
            np.savez(file, **arrays)
    except OSError:
        path.unlink(missing_ok=True)
        raise


def _visuals(archive: Any) -> Iterator[Visual]:
    scene = json.loads(bytes(archive["scene"]))
    for index, (name, base_color, metallic, roughness) in enumerate(scene["visuals"]):
        held: dict[str, Any] = {
            key: archive[f"{index}/{key}"] if f"{index}/{key}" in archive else None
            for key in (*_MESH, "texture", "envs", "bodies")
        }
        r, g, b, a = base_color
        material = Material((r, g, b, a), metallic, roughness, held["texture"])
        mesh = Mesh(**{key: held[key] for key in _MESH})
        yield Visual(name, mesh, material, held["envs"], held["bodies"])

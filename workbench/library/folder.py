"""The library: a table of every recording below one folder, kept up to date with the folder."""

from __future__ import annotations

import hashlib
import logging
import os
import threading
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from workbench.episodes.document import write_into_description, write_notes
from workbench.episodes.reader.reading import read_rows
from workbench.episodes.reader.scan import DATASET_KEY, NOTES, RecordingFiles, Scan, key_of, scan_folder
from workbench.episodes.row import Facts, LibraryEntry, LibraryRow, clean_note, clean_tags, clean_text
from workbench.episodes.sweep_results import RESULTS
from workbench.library.index import IndexedFiles, LibraryIndex
from workbench.library.job_status import JobStatus, read_jobs
from workbench.library.trash import (
    Trash,
    TrashError,
    empty_trash,
    move_to_trash,
    read_trash,
    restore_from_trash,
)
from workbench.machine.processes.watched_thread import watched_thread

log = logging.getLogger(__name__)

_MAX_FOLDERS = 64
"""Maximum number of subfolders that are searched for jobs."""

SCAN_SECONDS = 1.0
"""Interval at which the modification times of all folders are checked."""
MAX_PAUSE_SECONDS = 5.0
FULL_SCAN_SECONDS = 30.0
"""Interval at which every file is checked: writing a file in place does not change its folder's modification
time."""
PUBLISH_SECONDS = 0.3
"""Interval at which the table is updated while files are being read."""


class LibraryError(OSError):
    """An operation on recordings failed; the message is shown on the page."""


@dataclass(frozen=True)
class LibraryView:
    """The table at one moment."""

    serial: int = 0
    """Increases with each change."""
    rows: tuple[LibraryRow, ...] = ()
    """Rows, sorted by name."""
    reading: tuple[int, int] | None = None
    """(files read so far, files to read in all) while changed files are read; (0, 0) before they are counted;
    None when all are read."""
    problem: str | None = None
    """Why the folder cannot be listed, as a sentence; None if it can."""
    trash: Trash = Trash()
    jobs: tuple[JobStatus, ...] = ()
    """Jobs that record into the folder, or did so recently."""
    sweep: tuple[int, int] | None = None
    """Bytes and mtime in ns of the file with a sweep's results; None if the folder has none."""


class Library:
    """The recordings in a folder and the folders below it.

    The files are the source of truth: users and other processes move, copy and delete them. Rows are first loaded from an
    index; then names, sizes and times are compared, and files that differ are read on a thread (`watch`), newest first.
    Tags, notes and deletion change the files.

    A page sends only ids; their paths come from the rows, so a page cannot name a path.

    Args:
        folder: need not exist yet. Only tags, notes and the trash are written into it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder).absolute()
        self._looking = threading.Lock()
        """Lock held while the folder is scanned."""
        self._changing = threading.RLock()
        """Lock held while `_kept` is changed, but not while files are read."""
        self._changed = threading.Lock()
        self._view = LibraryView(reading=(0, 0), sweep=self._sweep())
        self.on_change: set[Callable[[], None]] = set()
        """Callbacks for a change of the view, called on the thread that changed it."""
        self._by_id: dict[str, LibraryRow] = {}
        self._scan = Scan(fresh=True)
        self._full_scan_at = -1e9
        self._index: LibraryIndex | None = LibraryIndex(self.folder) if self.folder.is_dir() else None
        self._kept: dict[str, IndexedFiles] = {} if self._index is None else self._index.load()
        self._stopping = threading.Event()
        self._scan_requested = threading.Event()
        self._thread: threading.Thread | None = None

    # --- the table ---------------------------------------------------------------------------------

    def view(self) -> LibraryView:
        return self._view

    def row(self, id: str) -> LibraryRow | None:
        """The row with this id; None if there is none."""
        return self._by_id.get(id)

    def thumbnails(self, ids: Sequence[str]) -> dict[str, bytes]:
        """JPEGs by id; recordings without one are left out. An export without pictures gets the JPEG of the
        recording that it was exported from."""
        by_id, index = self._by_id, self._index
        wanted = {id: [by_id[id], by_id.get(by_id[id].copy_of)] for id in ids if id in by_id}
        places = [row.place for rows in wanted.values() for row in rows if row is not None]
        jpegs = {} if index is None else index.thumbnails(places)
        found = {
            id: next((jpegs[row.place] for row in rows if row is not None and row.place in jpegs), None)
            for id, rows in wanted.items()
        }
        return {id: jpeg for id, jpeg in found.items() if jpeg is not None}

    # --- following the folder ------------------------------------------------------------------------

    def watch(self) -> None:
        """Keep the table up to date on a thread, until `close`."""
        if self._thread is not None:
            raise RuntimeError("The library is watched already.")
        self._thread = watched_thread("library", self._watch)
        self._thread.start()

    def request_scan(self) -> None:
        """Make the watching thread check every file now."""
        self._scan_requested.set()

    def close(self) -> None:
        """Stop watching; returns when the thread has ended."""
        self._stopping.set()
        self._scan_requested.set()
        if self._thread is not None:
            self._thread.join(timeout=10.0)
        with self._changing:
            if self._index is not None:
                self._index.close()
                self._index = None

    def _places(self) -> list[Path]:
        """Folders of the recordings, the most recently written first; at most `_MAX_FOLDERS`."""
        newest = sorted(self.view().rows, key=lambda row: -(row.written or 0.0))
        return list(dict.fromkeys(row.paths[0].parent for row in newest if row.paths))[:_MAX_FOLDERS]

    def _watch(self) -> None:
        while not self._stopping.is_set():
            began = time.monotonic()
            try:
                self.refresh(thorough=self._scan_requested.is_set())
                self._publish(jobs=read_jobs(self.folder, time.time(), self._places()))
            except Exception:
                # The thread must not end, or the table would never change again.
                log.exception("The library in %s could not be read; trying again.", self.folder)
                self._publish(problem="The library could not be read. The reason is in the terminal.")
            self._scan_requested.clear()
            # Pause for nine times as long as the scan took, within limits: without a pause, a huge folder
            # that is written to all the time would keep the thread busy.
            self._scan_requested.wait(
                min(max(SCAN_SECONDS, 9 * (time.monotonic() - began)), MAX_PAUSE_SECONDS)
            )

    def refresh(self, thorough: bool = True) -> None:
        """Read the files that changed since the last call.

        Args:
            thorough: check every file, even if no folder's time has changed.
        """
        with self._looking:
            late = time.monotonic() - self._full_scan_at > FULL_SCAN_SECONDS
            if not (thorough or late) and self._scan.is_unchanged():
                return
            with self._changing:
                if self._index is None and self.folder.is_dir() and not self._stopping.is_set():
                    self._index = LibraryIndex(self.folder)
                if self._view.serial == 0 and self._kept:
                    # Show the rows of the index until the files are checked.
                    self._show(reading=(0, 0))
            self._full_scan_at = time.monotonic()
            scan = scan_folder(self.folder)
            self._scan = replace(scan, found={})  # `_kept` has these files
            self._read_changed(scan)

    def _read_changed(self, scan: Scan, only: Collection[str] | None = None) -> None:
        """Read changed files. With `only`, read just the files of these keys, to show the result of an
        operation at once."""
        with self._changing:
            before = self._view.reading
            changed = [
                found
                for key, found in scan.found.items()
                if (only is None or key in only) and (key not in self._kept or self._kept[key].found != found)
            ]
            gone = {key for key in self._kept if key not in scan.found and (only is None or key in only)}
            for key in gone:
                del self._kept[key]
            # After an incomplete scan a missing file may still exist: the index keeps its rows.
            forgotten = [] if scan.problem else sorted(gone)
        changed.sort(key=lambda found: found.newest, reverse=True)
        unsaved: list[tuple[RecordingFiles, list[LibraryEntry]]] = []
        published = time.monotonic()
        for done, (found, entries) in enumerate(read_rows(self.folder, changed)):
            if self._stopping.is_set():
                break
            with self._changing:
                if not os.path.lexists(found.paths(self.folder)[0]):
                    continue  # the file was deleted meanwhile
                self._kept[found.key] = IndexedFiles(found, tuple(facts for facts, _ in entries))
                unsaved.append((found, entries))
                if time.monotonic() - published > PUBLISH_SECONDS:
                    self._save(unsaved, forgotten)
                    unsaved, forgotten = [], []
                    self._show(reading=(done + 1, len(changed)), problem=scan.problem)
                    published = time.monotonic()
        with self._changing:
            self._save(unsaved, forgotten)
            self._show(reading=None if only is None else before, problem=scan.problem)

    def _save(self, read: list[tuple[RecordingFiles, list[LibraryEntry]]], gone: list[str]) -> None:
        if self._index is not None and (read or gone):
            self._index.store(read, gone)

    def _show(self, reading: tuple[int, int] | None, problem: str | None = None) -> None:
        rows: dict[str, LibraryRow] = {}
        for _, kept in sorted(self._kept.items()):
            for number, facts in enumerate(kept.rows):
                row = self._row(kept.found, number, facts, rows)
                rows[row.id] = row
        self._publish(rows=tuple(rows.values()), reading=reading, problem=problem)

    def _row(self, found: RecordingFiles, number: int, facts: Facts, taken: Collection[str]) -> LibraryRow:
        id = facts.uid if facts.uid.isalnum() and facts.uid.isascii() else ""
        if not id or id in taken:
            # The recording has no id, or is a copy of another row's recording.
            where = f"{found.key}#{facts.trajectory or ''}"
            id = f"at-{hashlib.blake2b(where.encode(errors='surrogateescape'), digest_size=10).hexdigest()}"
        name = found.key.removesuffix("/meta/info") if facts.kind == "lerobot" else found.key
        name += "" if facts.trajectory is None else f"#{facts.trajectory}"
        # A file name may contain invalid UTF-8, which cannot be sent to a page.
        name, place = clean_text(name, 400), (found.key, number)
        paths, size = found.paths(self.folder), sum(found.sizes.values())
        return LibraryRow(**vars(facts), id=id, name=name, place=place, paths=paths, size=size)

    def _publish(self, **changes: object) -> None:
        with self._changed:
            kept = replace(self._view, trash=read_trash(self.folder), sweep=self._sweep())
            view = replace(kept, **changes)  # type: ignore[arg-type]
            if view.rows is not self._view.rows:
                self._by_id = {row.id: row for row in view.rows}
            if replace(view, serial=0) == replace(self._view, serial=0) and self._view.serial > 0:
                return
            self._view = replace(view, serial=self._view.serial + 1)
        for changed in tuple(self.on_change):
            changed()

    def _sweep(self) -> tuple[int, int] | None:
        try:
            stat = os.stat(self.folder / RESULTS)
        except OSError:
            return None
        return stat.st_size, stat.st_mtime_ns

    # --- operations on recordings ----------------------------------------------------------------------

    def set_tags(self, ids: Iterable[str], add: Iterable[str] = (), remove: Iterable[str] = ()) -> None:
        """Add tags to recordings and remove tags.

        Raises:
            LibraryError: a file cannot be written; the recordings before it in `ids` have been changed.
        """
        add, without = clean_tags(tuple(add)), set(clean_tags(tuple(remove)))
        self._annotate(
            ids, lambda facts: (clean_tags((*(t for t in facts.tags if t not in without), *add)), facts.note)
        )

    def set_note(self, ids: Iterable[str], note: str) -> None:
        """Set the note of recordings; an empty text removes the note. Raises like `set_tags`."""
        note = clean_note(note)
        self._annotate(ids, lambda facts: (facts.tags, note))

    def _annotate(self, ids: Iterable[str], change: Callable[[Facts], tuple[tuple[str, ...], str]]) -> None:
        with self._changing:
            touched: set[str] = set()
            try:
                for id in ids:
                    row, found = self._row_and_files(id)
                    tags, note = change(row)
                    if (tags, note) == (row.tags, row.note):
                        continue
                    touched.add(found.key)
                    try:
                        if row.kind == "workbench":
                            write_into_description(found.path(self.folder, ".json"), tags, note)
                        else:
                            write_notes(found.path(self.folder, NOTES), row.trajectory, tags, note)
                    except (OSError, ValueError) as error:
                        why = getattr(error, "strerror", None) or error
                        raise LibraryError(
                            f"Tags and note of {row.name} could not be saved ({why}). "
                            "They are written into the recording's folder, which must be writable."
                        ) from error
            finally:
                self._read_changed(scan_folder(self.folder), touched)

    def delete(self, ids: Iterable[str]) -> str:
        """Move all files of these recordings to the trash; returns the name of the deletion for `undo_delete`.

        Raises:
            LibraryError: either nothing was moved, because a file contains other recordings too, belongs to a
                LeRobot dataset, or no longer exists; or a file could not be moved, but the recordings before
                it were moved.
        """
        with self._changing:
            keys = self._keys_to_delete(ids)
            paths = [self._kept[key].found.paths(self.folder) for key in sorted(keys)]
            try:
                batch = move_to_trash(self.folder, paths)
            except TrashError as error:
                raise LibraryError(f"Not everything was deleted. {error}") from error
            finally:
                self._read_changed(scan_folder(self.folder), keys)
            if batch is None:
                raise LibraryError("These files no longer exist.")
            return batch

    def check_delete(self, ids: Iterable[str]) -> None:
        """Raise LibraryError if `delete` would refuse these recordings. Does not block."""
        self._keys_to_delete(ids)

    def _keys_to_delete(self, ids: Iterable[str]) -> set[str]:
        selected = set(ids)
        keys = {self._row_and_files(id)[1].key for id in selected}
        for key in keys:
            if key.split("/")[-2:] == DATASET_KEY and "/" in key:
                raise LibraryError(
                    f"{clean_text(key.removesuffix('/meta/info'), 400)} is a LeRobot dataset, a folder of many "
                    "files, which the library does not delete: delete the folder yourself."
                )
            of_file = {row.id for row in self._view.rows if row.place[0] == key}
            if not selected >= of_file:
                raise LibraryError(
                    f"{clean_text(key, 400)}.h5 holds {len(of_file)} recordings and is deleted only as a whole: "
                    "select all of them."
                )
        return keys

    def undo_delete(self) -> None:
        """Restore the files of the last deletion.

        Raises:
            LibraryError: there is no deletion, or a file could not be restored.
        """
        with self._changing:
            batches = read_trash(self.folder).batches
            if not batches:
                raise LibraryError("The trash is empty.")
            try:
                back = restore_from_trash(self.folder, batches[-1])
            except TrashError as error:
                raise LibraryError(f"Not everything could be restored. {error}") from error
            self._read_changed(scan_folder(self.folder), {key_of(path) for path in back})

    def empty_trash(self) -> None:
        """Delete the content of the trash permanently. Raises LibraryError."""
        with self._changing:
            try:
                empty_trash(self.folder)
            except TrashError as error:
                raise LibraryError(str(error)) from error
            finally:
                self._publish()

    def _row_and_files(self, id: str) -> tuple[LibraryRow, RecordingFiles]:
        row = self.row(id)
        kept = None if row is None else self._kept.get(row.place[0])
        if row is None or kept is None:
            raise LibraryError("That recording is not in the library any more.")
        return row, kept.found

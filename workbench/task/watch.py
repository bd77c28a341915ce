"""Calls back when an author's file has new content, once per burst of saves."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import cycle, islice
from pathlib import Path

from workbench.machine.files import MAX_SOURCE_BYTES, read_regular_file, real_path
from workbench.machine.processes.watched_thread import report_failure, watched_thread
from workbench.task.modules import decode

POLL_SECONDS = 0.04
"""Interval between polls."""
QUIET_SECONDS = 0.03
"""Debounce: a burst of saves is over after this time without a change."""
BURST_SECONDS = 0.2
"""Maximum wait for the end of a burst."""
READ_SECONDS = 0.25
"""Interval of reading the files even if their ``stat`` is unchanged: a network mount may update ``stat``
late, and two saves within one tick of a file system's clock have the same ``stat``."""
GONE_SECONDS = 0.3
"""A file that is missing or empty for a shorter time counts as an unfinished save, not as new content."""
STOP_SECONDS = 1.0
"""Maximum wait for the end of the thread: a read on a disk that hangs cannot be cancelled."""
POLL_SHARE, READ_SHARE = 0.003, 0.001
"""Maximum fractions of one core for ``stat`` and for reading; with hundreds of files both are done less often."""
NEWEST, TURN = 8, 32
"""Each poll checks the `NEWEST` files that were saved last, and `TURN` of the other files, in turn."""

Content = str | bytes | None
"""A file's text; its bytes if they are not text; None if it is missing or unreadable (device, pipe, too
large)."""
Statuses = dict[Path, tuple[int, ...]]
"""The fields of ``stat`` that change with a file's content, modification time first, by file; empty for a
file that does not exist."""


class SourceWatcher:
    """Thread that calls `on_change` with the followed files that have new content.

    One save is several events of the file system: an editor truncates and writes the file, or renames a
    temporary file over it, or deletes and creates it; a formatter may do the same 20 ms later. So the paths
    are polled 25 times a second by ``stat``, which takes microseconds. If there are hundreds of files, those
    saved last are polled every time, and the others in turn. After a rename, creation or deletion in one of
    their folders (most editors save in this way), all files are polled. Once ``stat`` is stable the texts are
    compared: a ``touch``, a ``git checkout`` of the same content or a line-end conversion is not a change.

    `on_change` may call `follow` and `stop`. An exception of `on_change` is reported, and watching continues.
    """

    def __init__(self, on_change: Callable[[set[Path]], None]) -> None:
        self._on_change = on_change
        self._lock = threading.Lock()
        self._known: dict[Path, Content] = {}
        self._seen: Statuses | None = {}
        """``stat`` of the files when they were last read, most recently saved first; None: read them at the next poll."""
        self._folders: Statuses = {}
        self._others: Iterator[Path] = iter(())
        self._stopped = threading.Event()
        self._thread = watched_thread("source-watcher", self._run)
        self._thread.start()

    def follow(self, paths: Iterable[Path], texts: Mapping[str, str] | None = None) -> None:
        """Follow `paths` from now on, and no others.

        Args:
            paths: files, which need not exist.
            texts: known texts of these files by path, so that a save between a load and this call is noticed.
                A file is read now if it has no text here and was not followed before.
        """
        texts = texts or {}
        followed = [_real(Path(path).expanduser()) for path in paths]
        with self._lock:
            self._known = {
                path: texts[str(path)]
                if str(path) in texts
                else self._known[path]
                if path in self._known
                else _read(path)
                for path in followed
            }
            self._seen = None  # something may have been saved since `texts` was read

    def stop(self) -> None:
        """Stop, and wait for the thread at most `STOP_SECONDS`; does not wait if called from `on_change`."""
        self._stopped.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=STOP_SECONDS)

    def _run(self) -> None:
        pause = read_again = 0.0
        while not self._stopped.is_set():
            # Waking is most of the cost of an idle watcher; sleep() is a third cheaper than waiting for the event.
            time.sleep(pause)
            began = time.thread_time()
            new = self._has_new_status()
            pause = max(POLL_SECONDS, (time.thread_time() - began) / POLL_SHARE)
            if new:
                self._settle()
            elif time.monotonic() < read_again:
                continue
            began = time.thread_time()
            changed = self._changes()
            read_again = time.monotonic() + max(READ_SECONDS, (time.thread_time() - began) / READ_SHARE)
            if changed and not self._stopped.is_set():
                try:
                    self._on_change(changed)
                except Exception as error:
                    report_failure("The handler of a saved file failed; the file is still watched", error)

    def _has_new_status(self) -> bool:
        """Whether the ``stat`` of a file that is polled this time has changed."""
        seen, folders = self._seen, {folder: _status(folder) for folder in self._folders}
        if seen is None:
            return True
        paths = list(seen)
        if folders == self._folders:
            paths = paths[:NEWEST] + list(islice(self._others, min(TURN, len(paths[NEWEST:]))))
        self._folders = folders
        return any(_status(path) != seen[path] for path in paths)

    def _settle(self) -> None:
        """Wait for the end of a burst of saves."""
        before, deadline = None, time.monotonic() + BURST_SECONDS
        now = self._statuses()
        while now != before and time.monotonic() < deadline:
            self._stopped.wait(QUIET_SECONDS)
            before, now = now, self._statuses()
        newest = sorted(now, key=now.__getitem__, reverse=True)
        with self._lock:  # `follow` may have been called meanwhile
            self._seen = {path: now[path] for path in newest} if now.keys() == self._known.keys() else None
        self._folders = {folder: self._folders.get(folder, ()) for folder in {path.parent for path in now}}
        self._others = cycle(newest[NEWEST:])

    def _statuses(self) -> Statuses:
        with self._lock:
            paths = list(self._known)
        return {path: _status(path) for path in paths}

    def _changes(self) -> set[Path]:
        """Files whose content has changed since the last call; stores the new content."""
        deadline = time.monotonic() + GONE_SECONDS
        while not self._stopped.is_set():
            with self._lock:
                now = {path: _read(path) for path in self._known}
                changed = {path for path, content in now.items() if content != self._known[path]}
                if all(now[path] for path in changed) or time.monotonic() > deadline:
                    self._known.update(now)
                    return changed
            self._stopped.wait(QUIET_SECONDS)
        return set()


def _real(path: Path) -> Path:
    """The file that a link leads to. If a link leads to anything else (by mistake to a device), the link
    itself is watched until it leads to a file."""
    real = real_path(path)
    return real if os.path.isfile(real) else real_path(path.parent) / path.name


def _status(path: Path) -> tuple[int, ...]:
    try:
        found = os.stat(path)
    except OSError:
        return ()
    return found.st_mtime_ns, found.st_ctime_ns, found.st_size, found.st_ino, found.st_dev


def _read(path: Path) -> Content:
    try:
        raw = read_regular_file(path, MAX_SOURCE_BYTES)
    except OSError:
        return None
    try:
        return decode(str(path), raw)
    except SyntaxError:
        return raw

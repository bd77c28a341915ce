"""Tells when an author's file has new content, once for each burst of saves.

What a person calls one save is many things to the file system: truncate and write; write a
temporary file and rename it over; delete and create; and formatters that do it all again 20 ms
later. So the paths are looked at, 25 times a second: one ``stat`` each, which takes microseconds and follows
whatever is there by now. Of hundreds of files that would be too much: those that were saved last are looked at every
time, and all where something was renamed, made or deleted in their folder, as most editors save; the others take
turns. When that has been the same for a moment the files are read and compared with what
was last known: only new text is a change, so a ``touch``, a ``git checkout`` of the same content or a
line-end conversion does not rebuild a scene.

What is known at first can be given: between a load's reading of a file and `follow` an author can
save, and that save must not be lost. A file that is gone or empty may be half of a save, so this
is believed only when it lasts. Four times a second the files are read whatever ``stat`` says of them: a
network mount may be late with it, and two saves within one tick of a file system's clock look the same.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import cycle, islice
from pathlib import Path

from workbench.authoring.loading.modules import decode
from workbench.machine.files import MOST_SOURCE_BYTES, read_regular_file
from workbench.machine.processes.watched_thread import report_failure, watched_thread

LOOK_S = 0.04
"""Time between two looks."""
QUIET_S = 0.03
"""A burst is over when nothing has happened for this long."""
BURST_S = 0.2
"""A burst that does not end is read after this long."""
READ_S = 0.25
"""How often the files are read, also where they look the same."""
GONE_S = 0.3
"""How long a file must be missing or empty before that counts as its new content."""
LOOK_SHARE, READ_SHARE = 0.003, 0.001
"""Of a core, what looking may take, and what reading may: of hundreds of files that is done less often."""
NEWEST, TURN = 8, 32
"""How many files are looked at every time, since they were saved last, and how many of the others."""

Content = str | bytes | None
"""Text; bytes that are not text; or None for no file, or one that cannot be read: a device, a pipe, one that is too large."""
Looks = dict[Path, tuple[int, ...]]
"""What ``stat`` says of each file that changes with it, when it was saved first; empty for no file."""


class SourceWatcher:
    """Calls `on_change` with the followed files whose content is new, on a thread of its own.

    `on_change` may call `follow` and `stop`. What it raises is said, and watching goes on.
    """

    def __init__(self, on_change: Callable[[set[Path]], None]) -> None:
        self._on_change = on_change
        self._lock = threading.Lock()
        self._known: dict[Path, Content] = {}
        self._seen: Looks | None = {}
        """How the files looked when they were last read, the one that was saved last first; None for not at all."""
        self._folders: Looks = {}
        self._others: Iterator[Path] = iter(())
        self._stopped = threading.Event()
        self._thread = watched_thread("source-watcher", self._run)
        self._thread.start()

    def follow(self, paths: Iterable[Path], texts: Mapping[str, str] | None = None) -> None:
        """Follow `paths` from now on, and nothing else.

        `texts` is what was last read of them, by path; a path that is not in it, and is not followed
        yet, counts as read now. Files need not exist.
        """
        texts = texts or {}
        followed = [Path(path).expanduser().resolve() for path in paths]
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
        """Return when the thread has ended (at once, when called from `on_change`)."""
        self._stopped.set()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        pause = read_again = 0.0
        while not self._stopped.is_set():
            # Waking is most of what an idle watcher costs, and this way a third cheaper than waiting for the event.
            time.sleep(pause)
            began = time.thread_time()
            new = self._looks_new()
            pause = max(LOOK_S, (time.thread_time() - began) / LOOK_SHARE)
            if new:
                self._settle()
            elif time.monotonic() < read_again:
                continue
            began = time.thread_time()
            changed = self._changes()
            read_again = time.monotonic() + max(READ_S, (time.thread_time() - began) / READ_SHARE)
            if changed and not self._stopped.is_set():
                try:
                    self._on_change(changed)
                except Exception as error:
                    report_failure("What follows a saved file failed, and the file is watched further", error)

    def _looks_new(self) -> bool:
        """Whether a file that is looked at this time is not as it was."""
        seen, folders = self._seen, {folder: _status(folder) for folder in self._folders}
        if seen is None:
            return True
        paths = list(seen)
        if folders == self._folders:
            paths = paths[:NEWEST] + list(islice(self._others, min(TURN, len(paths[NEWEST:]))))
        self._folders = folders
        return any(_status(path) != seen[path] for path in paths)

    def _settle(self) -> None:
        """Wait for the end of a burst."""
        before, deadline = None, time.monotonic() + BURST_S
        now = self._look()
        while now != before and time.monotonic() < deadline:
            self._stopped.wait(QUIET_S)
            before, now = now, self._look()
        newest = sorted(now, key=now.__getitem__, reverse=True)
        with self._lock:  # others may be followed since they were looked at
            self._seen = {path: now[path] for path in newest} if now.keys() == self._known.keys() else None
        self._folders = {folder: self._folders.get(folder, ()) for folder in {path.parent for path in now}}
        self._others = cycle(newest[NEWEST:])

    def _look(self) -> Looks:
        with self._lock:
            paths = list(self._known)
        return {path: _status(path) for path in paths}

    def _changes(self) -> set[Path]:
        """Files whose content is not what was known, which it is from now on."""
        deadline = time.monotonic() + GONE_S
        while not self._stopped.is_set():
            with self._lock:
                now = {path: _read(path) for path in self._known}
                changed = {path for path, content in now.items() if content != self._known[path]}
                if all(now[path] for path in changed) or time.monotonic() > deadline:
                    self._known.update(now)
                    return changed
            self._stopped.wait(QUIET_S)
        return set()


def _status(path: Path) -> tuple[int, ...]:
    try:
        found = os.stat(path)
    except OSError:
        return ()
    return found.st_mtime_ns, found.st_ctime_ns, found.st_size, found.st_ino, found.st_dev


def _read(path: Path) -> Content:
    try:
        raw = read_regular_file(path, MOST_SOURCE_BYTES)
    except OSError:
        return None
    try:
        return decode(str(path), raw)
    except SyntaxError:
        return raw

"""Tells when an author's file has new content, once for each burst of saves.

What a person calls one save is many things to the file system: truncate and write; write a
temporary file and rename it over; delete and create; and formatters that do it all again 20 ms
later. Watching the *files* loses them at the first rename, because the watch goes with the inode.
So the folders are watched, events are gathered until it has been quiet for a moment, and then the
files are read and compared with what was last known: only new text is a change, so a ``touch``, a
``git checkout`` of the same content or a line-end conversion does not rebuild a scene.

What is known at first can be given: between a load's reading of a file and `follow` an author can
save, and that save must not be lost. A file that is gone or empty may be half of a save, so this
is believed only when it lasts. Four times a second the files are compared without any event too:
for file systems that send none (network mounts), for a folder that was deleted and made again, and
for systems out of inotify watches, where watchfiles polls and sees no second save in one second.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import watchfiles
from watchfiles import _rust_notify

from workbench.authoring.modules import MOST_SOURCE_BYTES, decode
from workbench.machine.regular_file import read_regular_file
from workbench.machine.watched_thread import say_failure, watched_thread

logger = logging.getLogger(__name__)

QUIET_MS = 30
"""A burst is over when nothing has happened for this long."""
BURST_MS = 200
"""A burst that does not end is looked at after this long."""
RECHECK_MS = 250
"""How often the files are compared without any event."""
GONE_S = 0.3
"""How long a file must be missing or empty before that counts as its new content."""
POLL_MS = 50
"""Time between two looks, where the system sends no events at all."""

Content = str | bytes | None
"""Text; bytes that are not text; or None for no file, or one that cannot be read: a device, a pipe, one that is too large."""


class SourceWatcher:
    """Calls `on_change` with the followed files whose content is new, on a thread of its own.

    `on_change` may call `follow` and `stop`. What it raises is said, and watching goes on.
    """

    def __init__(self, on_change: Callable[[set[Path]], None], force_polling: bool | None = None) -> None:
        self._on_change = on_change
        self._force_polling = force_polling
        self._lock = threading.Lock()
        self._known: dict[Path, Content] = {}
        self._folders_changed = threading.Event()
        self._stopped = False
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
            folders = {path.parent for path in self._known}
            self._known = {
                path: texts[str(path)]
                if str(path) in texts
                else self._known[path]
                if path in self._known
                else _read(path)
                for path in followed
            }
            if folders != {path.parent for path in self._known}:
                self._folders_changed.set()
        if texts:
            # Something may have been saved since `texts` was read, before there was a watch.
            self._folders_changed.set()

    def stop(self) -> None:
        """Return when the thread has ended (at once, when called from `on_change`)."""
        self._stopped = True
        self._folders_changed.set()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while not self._stopped:
            self._folders_changed.clear()
            with self._lock:
                folders = {path.parent for path in self._known}
            present = {folder: _identity(folder) for folder in folders if _identity(folder) is not None}
            if not present:
                self._folders_changed.wait(RECHECK_MS / 1000 if folders else None)
                self._compare()
                continue
            self._watch(present)

    def _watch(self, folders: dict[Path, tuple[int, int] | None]) -> None:
        """Compare at every burst, until the set of folders is another one."""
        # For what was saved since the files were last read, when nothing was watching.
        self._compare()
        try:
            for _ in watchfiles.watch(
                *folders,
                watch_filter=self._is_followed,
                debounce=BURST_MS,
                step=QUIET_MS,
                stop_event=self._folders_changed,
                rust_timeout=RECHECK_MS,
                yield_on_timeout=True,
                raise_interrupt=False,
                force_polling=self._force_polling,
                poll_delay_ms=POLL_MS,
                recursive=False,
            ):
                self._compare()
                if any(_identity(folder) != identity for folder, identity in folders.items()):
                    return  # made anew: the watch is on the folder that was deleted
        except (OSError, _rust_notify.WatchfilesRustInternalError) as exc:
            if self._force_polling:
                logger.warning(
                    "Cannot watch %s: %s. Looking now and then.", ", ".join(map(str, folders)), exc
                )
                self._folders_changed.wait(RECHECK_MS / 1000)
            else:
                logger.warning("No file events to be had (%s): polling the folders instead.", exc)
                self._force_polling = True

    def _is_followed(self, change: watchfiles.Change, path: str) -> bool:
        return Path(path) in self._known

    def _compare(self) -> None:
        changed = self._take_changes(believe_gone=False)
        deadline = time.monotonic() + GONE_S
        while changed is None:
            time.sleep(QUIET_MS / 1000)
            changed = self._take_changes(believe_gone=time.monotonic() > deadline)
        if changed and not self._stopped:
            try:
                self._on_change(changed)
            except Exception as error:
                say_failure("What follows a saved file failed, and the file is watched further", error)

    def _take_changes(self, believe_gone: bool) -> set[Path] | None:
        """Files whose content is not what was known, which it is from now on; None for "ask again"."""
        with self._lock:
            now = {path: _read(path) for path in self._known}
            changed = {path for path, content in now.items() if content != self._known[path]}
            if not believe_gone and any(not now[path] for path in changed):
                return None
            self._known.update(now)
        return changed


def _read(path: Path) -> Content:
    try:
        raw = read_regular_file(path, MOST_SOURCE_BYTES)
    except OSError:
        return None
    try:
        return decode(str(path), raw)
    except SyntaxError:
        return raw


def _identity(folder: Path) -> tuple[int, int] | None:
    try:
        found = folder.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino

"""Stores which task texts this user allows to run, by their hashes (`TaskContent.hash`)."""

from __future__ import annotations

import datetime
import logging
import threading
from collections.abc import Iterator, Mapping, Sequence

import msgspec

from workbench.machine.folders import locked, read_private, set_aside, user_folder, write_private
from workbench.task.content import TaskContent

log = logging.getLogger(__name__)

STORE_FILE = "trusted_tasks.json"
MAX_ENTRIES = 5000
"""Maximum number of entries; the oldest are dropped."""
MAX_ENTRIES_WITH_FILES = 200
"""Number of the newest entries that keep the hashes of their files; the hashes of 300 modules take 30 kB."""


class _Entry(msgspec.Struct, frozen=True):
    hash: str
    file: str
    """Path of the file when the user was asked; used to report that its text has changed."""
    when: str
    followed: bool = False
    """Whether later texts saved to `file` may run too."""
    files: dict[str, str] = {}
    """`TaskContent.file_sums`, to report which file has changed; empty if the hashes were dropped."""


class _Document(msgspec.Struct):
    trusted: list[_Entry]
    format: int = 1


class TrustStore:
    """The texts that this user trusts, in a file of the configuration folder.

    A store that is missing, broken or owned by another user trusts nothing. If it cannot be written, entries last until the
    program ends. All methods are thread-safe and see entries written by other processes.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._this_run: list[_Entry] = []
        self._warned: set[str] = set()

    def trusts(self, content: TaskContent) -> bool:
        """Whether exactly this text may run."""
        with self._lock:
            return any(e.hash == content.hash for e in self._all())

    def follows(self, content: TaskContent) -> bool:
        """Whether this text may run, and also all later saves of its file."""
        key = content.hash, content.main, True
        with self._lock:
            return any((e.hash, e.file, e.followed) == key for e in self._all())

    def trusted_before(self, content: TaskContent) -> Mapping[str, str] | None:
        """`TaskContent.file_sums` of the newest other trusted text of this file; None if there is none.

        Empty if the hashes were dropped.
        """
        with self._lock:
            others = [e for e in self._read() if e.file == content.main and e.hash != content.hash]
        return others[-1].files if others else None

    def trust_once(self, content: TaskContent, followed: bool = False) -> None:
        """Trust `content` until the program ends."""
        with self._lock:
            self._this_run.append(_Entry(content.hash, content.main, "", followed))

    def trust(self, content: TaskContent, followed: bool = False) -> None:
        """Trust `content` in this run and later ones."""
        now = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
        entry = _Entry(content.hash, content.main, now, followed, content.file_sums)
        with self._lock:
            self._this_run.append(entry)
            try:
                with locked(STORE_FILE):
                    kept = [known for known in self._read(repair=True) if known.hash != entry.hash]
                    self._write([*kept, entry][-MAX_ENTRIES:])
            except OSError as error:
                self._warn_once(
                    f"Your answer cannot be stored, so you will be asked again in the next run: {error}"
                )

    def _all(self) -> Iterator[_Entry]:
        """Entries of this run, then those on disk. The disk is not read if the caller stops before them."""
        yield from self._this_run
        yield from self._read()

    def _read(self, repair: bool = False) -> list[_Entry]:
        """The stored entries. Set `repair` if the store will be written next: then an unreadable store raises
        OSError, and a broken store is renamed."""
        try:
            content = read_private(STORE_FILE)
        except OSError as error:
            if repair:
                raise  # writing now would overwrite its entries
            self._warn_once(f"The stored answers about trusted code cannot be read: {error}")
            return []
        if content is None:
            return []
        try:
            return msgspec.json.decode(content, type=_Document).trusted
        except (msgspec.MsgspecError, RecursionError) as error:
            self._warn_once(f"{user_folder() / STORE_FILE} is broken, so nothing is trusted: {error}")
            if repair:
                self._warn_once(f"The broken file was renamed to {set_aside(STORE_FILE)}.")
            return []

    def _write(self, entries: Sequence[_Entry]) -> None:
        older = [msgspec.structs.replace(one, files={}) for one in entries[:-MAX_ENTRIES_WITH_FILES]]
        document = _Document([*older, *entries[-MAX_ENTRIES_WITH_FILES:]])
        write_private(STORE_FILE, msgspec.json.format(msgspec.json.encode(document), indent=1))

    def _warn_once(self, what: str) -> None:
        if what not in self._warned:
            self._warned.add(what)
            log.warning("%s", what)

"""Which task texts this user has said may run, kept by what they say (`TaskContent.hash`) in the configuration folder.

A store that is missing, broken or somebody else's trusts nothing. One that cannot be written keeps answers until the
program ends.
"""

from __future__ import annotations

import datetime
import logging
import threading
from collections.abc import Iterator, Mapping, Sequence

import msgspec

from workbench.authoring.loading.task_content import TaskContent
from workbench.machine.user_folder import locked, read_private, set_aside, user_folder, write_private

log = logging.getLogger(__name__)

STORE_FILE = "trusted_tasks.json"
MOST_KEPT = 5000
"""Answers; the oldest go first."""
MOST_WITH_FILES = 200
"""Of them, the newest, that say which files they were for: 300 modules take 30 kB."""


class _Entry(msgspec.Struct, frozen=True):
    hash: str
    file: str
    """Where it lay when it was asked about; for people, and to say that a text has changed."""
    when: str
    followed: bool = False
    """Its saves may run too, where it lay then."""
    files: dict[str, str] = {}
    """`TaskContent.file_sums`, to say which of them has changed; empty where an earlier version wrote it."""


class _Document(msgspec.Struct):
    trusted: list[_Entry]
    format: int = 1


class TrustStore:
    """All methods are thread-safe, and read what other processes have written since."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._of_this_run: list[_Entry] = []
        self._told: set[str] = set()

    def trusts(self, content: TaskContent) -> bool:
        """Whether this very text may run."""
        with self._lock:
            return any(e.hash == content.hash for e in self._all())

    def follows(self, content: TaskContent) -> bool:
        """Whether what is saved to this file, beginning with this text, may run too."""
        key = content.hash, content.main, True
        with self._lock:
            return any((e.hash, e.file, e.followed) == key for e in self._all())

    def trusted_before(self, content: TaskContent) -> Mapping[str, str] | None:
        """The `TaskContent.file_sums` of another text of the same file that was trusted last; None if none was.

        Empty where it is not known any more.
        """
        with self._lock:
            others = [e for e in self._read() if e.file == content.main and e.hash != content.hash]
        return others[-1].files if others else None

    def trust_once(self, content: TaskContent, followed: bool = False) -> None:
        """Until the program ends."""
        with self._lock:
            self._of_this_run.append(_Entry(content.hash, content.main, "", followed))

    def trust(self, content: TaskContent, followed: bool = False) -> None:
        """From now on, in every run."""
        now = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
        entry = _Entry(content.hash, content.main, now, followed, content.file_sums)
        with self._lock:
            self._of_this_run.append(entry)
            try:
                with locked(STORE_FILE):
                    kept = [known for known in self._read(mend=True) if known.hash != entry.hash]
                    self._write([*kept, entry][-MOST_KEPT:])
            except OSError as error:
                self._tell(f"What you trust cannot be kept, and is asked again in the next run: {error}")

    def _all(self) -> Iterator[_Entry]:
        """The disk is asked last, and only for what was not said in this run."""
        yield from self._of_this_run
        yield from self._read()

    def _read(self, mend: bool = False) -> list[_Entry]:
        """What is kept; with `mend`, for writing it again: a broken store is set aside, and OSError is raised."""
        try:
            content = read_private(STORE_FILE)
        except OSError as error:
            if mend:
                raise  # what it holds would be written over
            self._tell(f"What you trusted before is not known: {error}")
            return []
        if content is None:
            return []
        try:
            return msgspec.json.decode(content, type=_Document).trusted
        except (msgspec.MsgspecError, RecursionError) as error:
            self._tell(f"{user_folder() / STORE_FILE} is broken, so nothing is trusted: {error}")
            if mend:
                self._tell(f"The broken one is {set_aside(STORE_FILE)} now.")
            return []

    def _write(self, entries: Sequence[_Entry]) -> None:
        said = [msgspec.structs.replace(one, files={}) for one in entries[:-MOST_WITH_FILES]]
        document = _Document([*said, *entries[-MOST_WITH_FILES:]])
        write_private(STORE_FILE, msgspec.json.format(msgspec.json.encode(document), indent=1))

    def _tell(self, what: str) -> None:
        if what not in self._told:
            self._told.add(what)
            log.warning("%s", what)

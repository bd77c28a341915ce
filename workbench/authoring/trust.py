"""Which task texts this user has said may run, kept by what they say (`TaskContent.hash`) in the configuration folder.

A store that is missing, broken or somebody else's trusts nothing. One that cannot be written keeps answers until the
program ends.
"""

from __future__ import annotations

import datetime
import json
import logging
import threading
from dataclasses import dataclass
from typing import Any

from workbench.authoring.task_content import TaskContent
from workbench.machine.user_folder import locked, read_private, set_aside, write_private

log = logging.getLogger(__name__)

STORE_FILE = "trusted_tasks.json"
MOST_KEPT = 5000
"""Answers; the oldest go first."""


@dataclass(frozen=True)
class _Entry:
    hash: str
    file: str
    """Where it lay when it was asked about; for people, and to say that a text has changed."""
    when: str


class TrustStore:
    """All methods are thread-safe, and read what other processes have written since."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._of_this_run: set[str] = set()
        self._told: set[str] = set()

    def trusts(self, content: TaskContent) -> bool:
        """Whether this very text may run."""
        with self._lock:
            return content.hash in self._of_this_run or any(e.hash == content.hash for e in self._read())

    def trusted_before(self, content: TaskContent) -> bool:
        """Whether another text of the same file may run."""
        with self._lock:
            return any(e.file == content.main and e.hash != content.hash for e in self._read())

    def trust_once(self, content: TaskContent) -> None:
        """Until the program ends."""
        with self._lock:
            self._of_this_run.add(content.hash)

    def trust(self, content: TaskContent) -> None:
        """From now on, in every run."""
        now = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
        entry = _Entry(content.hash, content.main, now)
        with self._lock:
            self._of_this_run.add(content.hash)
            try:
                with locked(STORE_FILE):
                    kept = [known for known in self._read(mend=True) if known.hash != entry.hash]
                    self._write([*kept, entry][-MOST_KEPT:])
            except OSError as error:
                self._tell(f"What you trust cannot be kept, and is asked again in the next run: {error}")

    def _read(self, mend: bool = False) -> list[_Entry]:
        try:
            content = read_private(STORE_FILE)
        except OSError as error:
            self._tell(f"What you trusted before is not known: {error}")
            return []
        if content is None:
            return []
        try:
            return _entries(json.loads(content))
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            self._tell(f"{STORE_FILE} in the configuration folder is broken, so nothing is trusted: {error}")
            if mend:
                self._tell(f"The broken one is {set_aside(STORE_FILE)} now.")
            return []

    def _write(self, entries: list[_Entry]) -> None:
        document = {"format": 1, "trusted": [vars(entry) for entry in entries]}
        write_private(STORE_FILE, json.dumps(document, indent=1).encode())

    def _tell(self, what: str) -> None:
        if what not in self._told:
            self._told.add(what)
            log.warning("%s", what)


def _entries(document: Any) -> list[_Entry]:
    return [_Entry(str(one["hash"]), str(one["file"]), str(one["when"])) for one in document["trusted"]]

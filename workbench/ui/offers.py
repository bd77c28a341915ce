"""Files that a page may fetch: those that the server put into a table, under addresses that nobody can guess.

A browser never says a path. It is given an address with a random part, made here for one file, and what it asks for is
looked up by that part alone; the name behind it is for people (and for rerun, which tells a recording by its end).
"""

from __future__ import annotations

import secrets
import threading
import urllib.parse
from pathlib import Path

from workbench.ui.door import Door
from workbench.ui.file_reply import FileReply

PREFIX = "/offered/"
_POLICY = {
    # What is offered is data. Opened by itself, an HTML file that somebody recorded runs nothing in our name.
    "Content-Security-Policy": "default-src 'none'; sandbox; frame-ancestors 'none'",
    "Cache-Control": "no-store",
}


class Offers:
    """The table. One a door."""

    def __init__(self, door: Door) -> None:
        self._lock = threading.Lock()
        self._files: dict[str, FileReply] = {}
        self._ids: dict[FileReply, str] = {}
        door.add_route(PREFIX, self._answer, headers=_POLICY)

    def address(self, path: Path, kind: str = "application/octet-stream", download: bool = False) -> str:
        """The address, from the root of the server, of the file at `path`; the same for the same file.

        Args:
            kind: Its content type.
            download: The browser saves it instead of showing it.
        """
        path = Path(path).resolve()
        reply = FileReply(path, kind, download_as=path.name if download else None)
        with self._lock:
            key = self._ids.setdefault(reply, secrets.token_urlsafe(16))
            self._files[key] = reply
        return f"{PREFIX}{key}/{urllib.parse.quote(path.name, safe='')}"

    def _answer(self, asked: str) -> tuple[int, str, bytes] | FileReply:
        with self._lock:
            reply = self._files.get(asked.partition("/")[0])
        if reply is None:
            return 404, "text/plain; charset=utf-8", b"There is no such file."
        return reply

"""An answer that is read from its file while it is sent, and the files that a page may fetch so.

A recording may be gigabytes, and `websockets`, whose server the page is served by, knows answers only as one
string of bytes. Read whole, a file that is opened in three tabs is in memory three times, and all of it at once on
its way through the event loop. But the hook that makes the answer is a coroutine with the connection in its hand:
so the head and the blocks of the file are written from there, each when the one before is nearly gone, and what is
given back to `websockets` at the end has nothing left to say.

A browser never says a path. It is given an address with a random part, made here for one file, and what it asks for is
looked up by that part alone; the name behind it is for people (and for rerun, which tells a recording by its end).

A file may be kept as gzip (rerun's viewer: 43 MB, 14 packed) and is sent so to browsers that take it.
"""

from __future__ import annotations

import asyncio
import gzip
import os
import secrets
import threading
import urllib.parse
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Response

if TYPE_CHECKING:
    from workbench.ui.server.gated_server import Door

BLOCK = 1 << 18
"""Bytes that are read and handed on at a time."""


@dataclass(frozen=True)
class FileReply:
    """What a route answers with instead of bytes."""

    path: Path
    kind: str
    """Content type of what the browser gets."""
    gzipped: bool = False
    """The file holds the gzip of it."""
    download_as: str | None = None
    """The browser saves it under this name instead of showing it."""


class _Sent(Response):
    """For `websockets`: an answer of which every byte was written already."""

    def serialize(self) -> bytes:
        return b""


async def send_file(
    connection: ServerConnection,
    reply: FileReply,
    headers: Mapping[str, str],
    accepts_gzip: bool,
    not_found: Callable[[], Response],
) -> Response:
    """Send the file over the connection, a block at a time.

    Args:
        headers: Of the answer, without those that say what it is and how long.
        not_found: Makes the answer where the file is gone or may not be read.

    Returns:
        What is still to be sent.
    """
    try:
        file, length, packed = await asyncio.to_thread(_open, reply, accepts_gzip)
    except OSError:
        return not_found()
    fields = {"Content-Type": reply.kind, "Content-Length": str(length), **headers}
    if reply.gzipped:
        fields["Vary"] = "Accept-Encoding"
    if packed:
        fields["Content-Encoding"] = "gzip"
    if reply.download_as is not None:
        # RFC 6266: the encoded form is what browsers take, whatever is in the name.
        quoted = urllib.parse.quote(reply.download_as, safe="")
        fields["Content-Disposition"] = f"attachment; filename*=UTF-8''{quoted}"
    sent = _Sent(200, HTTPStatus.OK.phrase, Headers(fields))
    try:
        await _pour(connection, file, Response.serialize(sent), length)
    finally:
        await asyncio.to_thread(file.close)
    return sent


def _open(reply: FileReply, accepts_gzip: bool) -> tuple[BinaryIO, int, bool]:
    """The file, how many bytes of it are sent, and whether these are still packed."""
    file = reply.path.open("rb")
    length = os.fstat(file.fileno()).st_size
    if not reply.gzipped or accepts_gzip:
        return file, length, reply.gzipped
    # The last four bytes of a gzip are the length of what is in it (RFC 1952).
    file.seek(-4, os.SEEK_END)
    plain = int.from_bytes(file.read(), "little")
    file.seek(0)
    return gzip.GzipFile(fileobj=file), plain, False  # type: ignore[return-value]


async def _pour(connection: ServerConnection, file: BinaryIO, head: bytes, length: int) -> None:
    transport = connection.transport
    transport.write(head)
    left = length
    while left:
        try:
            # Never more than was announced: a recording may grow while it is read.
            block = await asyncio.to_thread(file.read, min(BLOCK, left))
        except (OSError, EOFError, zlib.error):  # the disk's, and what gzip says of a file that is torn
            block = b""
        if not block:
            # Shorter than announced. Cut off, so that the browser does not take a piece for the whole.
            transport.abort()
            return
        left -= len(block)
        transport.write(block)
        try:
            await connection.drain()
        except OSError:
            return  # the browser went away
        if transport.is_closing():
            return


# --- those that the server put into a table, under addresses that nobody can guess ---------------------

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

"""Sends a file block by block as an HTTP response, and keeps the table of files that a page may download."""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import os
import secrets
import urllib.parse
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import BinaryIO

from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Response

BLOCK = 1 << 18
"""Number of bytes that are read and sent at a time."""


@dataclass(frozen=True)
class FileReply:
    """A route's answer that is a file instead of bytes."""

    path: Path
    kind: str
    """Content type that the browser gets."""
    gzipped: bool = False
    """Whether the file holds gzipped content (rerun's viewer: 43 MB, 14 packed). It is sent packed where the
    browser accepts gzip."""
    download_as: str | None = None
    """Name under which the browser saves the file instead of showing it."""


Handler = Callable[[str], tuple[int, str, bytes] | FileReply]
"""Gets the path behind its prefix (decoded, no query, no ``..``, no backslash, no NUL); returns status, content type
and body, or a file. Runs in a thread, so it may read files."""
AddRoute = Callable[[str, Handler, Mapping[str, str]], object]
"""Adds a route: its prefix, what answers it, and headers of every reply."""


class _Sent(Response):
    """For `websockets`: a response whose bytes were all written already."""

    def serialize(self) -> bytes:
        return b""


async def send_file(
    connection: ServerConnection,
    reply: FileReply,
    headers: Mapping[str, str],
    accepts_gzip: bool,
    not_found: Callable[[], Response],
) -> Response:
    """Send the file over the connection, a block at a time, each when the one before is nearly gone.

    A recording may be gigabytes, and `websockets` takes a response as one string of bytes only: a file that is open in
    three tabs would be in memory three times. So head and blocks are written to the connection here.

    Args:
        headers: Of the response, without content type, length and encoding.
        not_found: Makes the response where the file is gone or cannot be read.

    Returns:
        The response for `websockets`, with nothing left to send.
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
        # RFC 6266: browsers take the encoded form for any name.
        fields["Content-Disposition"] = f"attachment; filename*=UTF-8''{_quoted(reply.download_as)}"
    sent = _Sent(200, HTTPStatus.OK.phrase, Headers(fields))
    try:
        await _pour(connection, file, Response.serialize(sent), length)
    finally:
        await asyncio.to_thread(file.close)
    return sent


def _quoted(name: str) -> str:
    """A file's name for an address; of one that is not UTF-8 the bytes are escaped."""
    return urllib.parse.quote(name.encode(errors="backslashreplace"), safe="")


def _open(reply: FileReply, accepts_gzip: bool) -> tuple[BinaryIO, int, bool]:
    """The file, the number of bytes to send, and whether they are packed."""
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
            # Never more than announced: a recording may grow while it is read.
            block = await asyncio.to_thread(file.read, min(BLOCK, left))
        except (OSError, EOFError, zlib.error):  # an error of the disk, or a gzip that is cut short
            block = b""
        if not block:
            # Shorter than announced: aborted, so that the browser does not take a part for the whole.
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


# --- files that the server offers for download, under addresses that cannot be guessed ----------------

PREFIX = "/offered/"
_POLICY = {
    # Downloads are data: a recorded HTML file that is opened by itself must not run scripts in our origin.
    "Content-Security-Policy": "default-src 'none'; sandbox; frame-ancestors 'none'",
    "Cache-Control": "no-store",
}


class Downloads:
    """The files that a page may fetch. One for each `GatedServer`.

    A browser never sends a path: it gets an address with a random part, made for one file, and the file is looked up
    by that part alone. The name behind it is for people (and for rerun, which tells a recording by its suffix).
    """

    def __init__(self, add_route: AddRoute) -> None:
        """
        Args:
            add_route: `GatedServer.add_route`.
        """
        self._secret = secrets.token_bytes(32)
        self._files: dict[str, FileReply] = {}
        """Files by the random part of their address; requests read it on other threads."""
        add_route(PREFIX, self._answer, _POLICY)

    def address(self, path: Path, kind: str = "application/octet-stream", download: bool = False) -> str:
        """The address of a file, from the root of the server; always the same for the same file.

        Args:
            kind: Its content type.
            download: The browser saves it instead of showing it.
        """
        path = Path(path).absolute()
        reply = FileReply(path, kind, download_as=path.name if download else None)
        # The same for the same file, and unknown to others.
        key = hashlib.blake2b(repr(reply).encode(), key=self._secret, digest_size=16).hexdigest()
        self._files[key] = reply
        return f"{PREFIX}{key}/{_quoted(path.name)}"

    def _answer(self, asked: str) -> tuple[int, str, bytes] | FileReply:
        reply = self._files.get(asked.partition("/")[0])
        if reply is None:
            return 404, "text/plain; charset=utf-8", b"There is no such file."
        return reply

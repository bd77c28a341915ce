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

BLOCK_BYTES = 1 << 18


@dataclass(frozen=True)
class FileReply:
    """A route's reply that sends a file instead of bytes."""

    path: Path
    kind: str
    """Content type."""
    gzipped: bool = False
    """Whether the file's content is gzipped (rerun's viewer: 43 MB, 14 MB compressed). It is sent compressed if the browser
    accepts gzip."""
    download_as: str | None = None
    """Name under which the browser saves the file instead of showing it."""


Handler = Callable[[str, Mapping[str, str]], tuple[int, str, bytes] | FileReply]
"""Gets the path after the route's prefix (decoded, no ``..``, no backslash, no NUL) and the fields of the query;
returns status, content type and body, or a file. Runs in a thread, so it may read files."""
AddRoute = Callable[[str, Handler, Mapping[str, str]], object]
"""Adds a route: its prefix, its handler, and headers of every reply."""


class _Sent(Response):
    """A response for `websockets` whose bytes are already written."""

    def serialize(self) -> bytes:
        return b""


async def send_file(
    connection: ServerConnection,
    reply: FileReply,
    headers: Mapping[str, str],
    accepts_gzip: bool,
    not_found: Callable[[], Response],
) -> Response:
    """Send the file over the connection in blocks; a block is written when the previous one is nearly sent.

    A recording may have gigabytes, and `websockets` accepts a response only as one bytes object: a file that is open in
    three tabs would be in memory three times. So head and blocks are written to the connection here.

    Args:
        headers: Headers of the response, without content type, length and encoding.
        not_found: Makes the response if the file does not exist or cannot be read.

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
    """A file name for a URL; bytes that are not UTF-8 are escaped."""
    return urllib.parse.quote(name.encode(errors="backslashreplace"), safe="")


def _open(reply: FileReply, accepts_gzip: bool) -> tuple[BinaryIO, int, bool]:
    """The file, the number of bytes to send, and whether they are compressed."""
    file = reply.path.open("rb")
    length = os.fstat(file.fileno()).st_size
    if not reply.gzipped or accepts_gzip:
        return file, length, reply.gzipped
    # The last four bytes of a gzip file are the length of its content (RFC 1952).
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
            # Never send more than announced: a recording may grow while it is read.
            block = await asyncio.to_thread(file.read, min(BLOCK_BYTES, left))
        except (OSError, EOFError, zlib.error):  # a disk error, or a truncated gzip
            block = b""
        if not block:
            # Shorter than announced: abort, so that the browser does not take a part for the whole file.
            transport.abort()
            return
        left -= len(block)
        transport.write(block)
        try:
            await connection.drain()
        except OSError:
            return  # the browser has disconnected
        if transport.is_closing():
            return


# --- downloads, under addresses that cannot be guessed -------------------------------------------------

PREFIX = "/offered/"
_POLICY = {
    # Downloads are data: a recorded HTML file that is opened by itself must not run scripts in our origin.
    "Content-Security-Policy": "default-src 'none'; sandbox; frame-ancestors 'none'",
    "Cache-Control": "no-store",
}


class Downloads:
    """The files that a page may fetch. One object per `GatedServer`.

    A browser never sends a path: it gets an address with a random part for one file, and the file is looked
    up by that part alone. The file name at the end of the address is for people (and for rerun, which
    recognizes a recording by its suffix).
    """

    def __init__(self, add_route: AddRoute) -> None:
        """
        Args:
            add_route: `GatedServer.add_route`.
        """
        self._secret = secrets.token_bytes(32)
        self._files: dict[str, FileReply] = {}
        """Files by the random part of their address; requests read this dict on other threads."""
        add_route(PREFIX, self._answer, _POLICY)

    def address(self, path: Path, kind: str = "application/octet-stream", download: bool = False) -> str:
        """The address of a file, from the root of the server. Equal arguments give the same address.

        Args:
            kind: Content type of the file.
            download: Whether the browser saves it instead of showing it.
        """
        path = Path(path).absolute()
        reply = FileReply(path, kind, download_as=path.name if download else None)
        # A keyed hash: equal replies get the same address, and nobody can guess it without the secret.
        key = hashlib.blake2b(repr(reply).encode(), key=self._secret, digest_size=16).hexdigest()
        self._files[key] = reply
        return f"{PREFIX}{key}/{_quoted(path.name)}"

    def _answer(self, asked: str, query: Mapping[str, str]) -> tuple[int, str, bytes] | FileReply:
        reply = self._files.get(asked.partition("/")[0])
        if reply is None:
            return 404, "text/plain; charset=utf-8", b"There is no such file."
        return reply

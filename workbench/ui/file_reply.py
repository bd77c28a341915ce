"""An answer that is read from its file while it is sent.

A recording may be gigabytes, and `websockets`, whose server the page is served by, knows answers only as one
string of bytes. Read whole, a file that is opened in three tabs is in memory three times, and all of it at once on
its way through the event loop. But the hook that makes the answer is a coroutine with the connection in its hand:
so the head and the blocks of the file are written from there, each when the one before is nearly gone, and what is
given back to `websockets` at the end has nothing left to say.

A file may be kept as gzip (rerun's viewer: 43 MB, 14 packed) and is sent so to browsers that take it.
"""

from __future__ import annotations

import asyncio
import gzip
import os
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

"""Takes another process's messages off a socket, and never believes or waits for what that process says.

The author's code runs in the process at the other end: it may write into any file descriptor, and end in the middle of a
message. Framing is that of `multiprocessing.connection.Connection`: a length of four bytes (-1 and eight more where
that is not enough), then what `wire` says.
"""

from __future__ import annotations

import os
import select
import struct
import time
from collections.abc import Sequence
from typing import Any

from workbench.jobs.wire import Unpacker, Unreadable

MOST_BYTES = 1 << 30
"""Of one message. The largest of a healthy task are its meshes and the pictures of all envs: some 100 MB."""
_AT_ONCE = 1 << 24
"""Bytes that are reserved on a message's word that it is so long; the rest as they come."""
_SHORT, _LONG = struct.Struct("!i"), struct.Struct("!Q")


class MessageReader:
    """The messages that come in on one socket. Used on one thread."""

    def __init__(self, fd: int, kinds: Sequence[type]) -> None:
        """
        Args:
            fd: of the socket, read from here only; it may be written to elsewhere.
            kinds: what may come.
        """
        self._fd, self._unpacker = fd, Unpacker(kinds)
        self._poll = select.poll()  # not select(): a server with many pages has descriptors beyond 1024
        self._poll.register(self._fd, select.POLLIN)
        self._head = bytearray()
        self._body: bytearray | None = None
        self._length = self._filled = 0

    def receive(self, timeout: float) -> Any | None:
        """The next message; None where none is complete within `timeout` seconds.

        Raises:
            Unreadable: no message begins here.
            EOFError: the other end is closed, and all that was sent whole was received.
        """
        deadline = time.monotonic() + timeout
        while True:
            left = max(0.0, deadline - time.monotonic())
            if not self._poll.poll(left * 1000):
                return None
            if (message := self._read_on()) is not None:
                return message
            if time.monotonic() >= deadline and not self._poll.poll(0):
                return None

    def _read_on(self) -> Any | None:
        """Take what has come, as far as it belongs to the message under way; that message if it is complete now."""
        if self._body is None:
            self._head += self._read(self._head_size() - len(self._head))
            if len(self._head) < self._head_size():
                return None
            self._length = self._claimed()
            self._body, self._filled = bytearray(min(self._length, _AT_ONCE)), 0
            if self._length > 0:
                return None
        else:
            self._fill(self._body)
            if self._filled < self._length:
                return None
        body, self._body = self._body, None
        self._head.clear()
        return self._unpacker.message(body)

    def _head_size(self) -> int:
        long = len(self._head) >= _SHORT.size and _SHORT.unpack_from(self._head)[0] == -1
        return _SHORT.size + _LONG.size if long else _SHORT.size

    def _claimed(self) -> int:
        length: int = _SHORT.unpack_from(self._head)[0]
        if length == -1:
            length = _LONG.unpack_from(self._head, _SHORT.size)[0]
        if not 0 <= length <= MOST_BYTES:
            raise Unreadable(f"it says that it is {length} bytes long")
        return length

    def _fill(self, body: bytearray) -> None:
        if self._filled == len(body):
            body.extend(bytes(min(len(body), self._length - len(body))))
        with memoryview(body) as whole, whole[self._filled :] as rest:
            try:
                count = os.readv(self._fd, [rest])
            except OSError as error:
                raise EOFError from error
        if count == 0:
            raise EOFError
        self._filled += count

    def _read(self, count: int) -> bytes:
        try:
            piece = os.read(self._fd, count)
        except OSError as error:
            raise EOFError from error
        if not piece:
            raise EOFError
        return piece

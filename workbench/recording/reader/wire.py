"""What passes between a reader and who asks it: a header of msgpack, and the bytes of arrays behind it.

A reader has read files of strangers, and what it says may be theirs. So nothing that comes from it is a pickle: headers
are decoded as the types of `requests`, arrays are plain numbers of a length that is there, and the sizes of both are
bounded before anything is allocated for them.
"""

from __future__ import annotations

import math
import os
import select
import socket
import struct
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

MOST_HEADER = 256 << 20
MOST_BODY = 5 << 28
_SIZES = struct.Struct("<QQ")
_PIECE = 1 << 20
_ALIGNED = 16
_KINDS = "biuf"
_LARGEST_NUMBER = 8
T = TypeVar("T")


class Closed(Exception):
    """The other end is gone."""


class TookTooLong(Exception):
    """Nothing whole came in time."""


class Garbled(Exception):
    """What came is not what was asked for."""


class ArrayRef(msgspec.Struct, frozen=True, array_like=True):
    """An array that lies in the body."""

    dtype: str
    shape: tuple[int, ...]
    begin: int


class ArrayPacker:
    """Gathers the arrays of one answer."""

    def __init__(self) -> None:
        self.parts: list[NDArray] = []
        self.size = 0

    def ref(self, array: NDArray) -> ArrayRef:
        """Raises ValueError where it holds no plain numbers."""
        plain = np.ascontiguousarray(array).reshape(array.shape)
        if plain.dtype.kind not in _KINDS or plain.dtype.itemsize > _LARGEST_NUMBER:
            raise ValueError(f"numbers of type {plain.dtype}")
        if plain.dtype.byteorder == ">":
            plain = plain.astype(plain.dtype.newbyteorder("="))
        begin = self.size
        self.parts.append(plain)
        self.size += -(-plain.nbytes // _ALIGNED) * _ALIGNED
        return ArrayRef(plain.dtype.str, plain.shape, begin)


class ArrayReader:
    """The arrays of one answer, in its body; they share its memory."""

    def __init__(self, body: NDArray[np.uint8]) -> None:
        self._body = body

    def array(self, ref: ArrayRef) -> NDArray:
        """Raises Garbled where there is no such array."""
        try:
            dtype = np.dtype(ref.dtype)
        except TypeError as error:
            raise Garbled(f"no type of numbers: {ref.dtype[:40]}") from error
        if dtype.kind not in _KINDS or dtype.itemsize > _LARGEST_NUMBER or dtype.subdtype is not None:
            raise Garbled(f"numbers of type {dtype}")
        count = math.prod(ref.shape)
        if any(size < 0 for size in ref.shape) or len(ref.shape) > 8 or ref.begin < 0:
            raise Garbled(f"an array of shape {ref.shape}")
        if ref.begin + count * dtype.itemsize > len(self._body):
            raise Garbled("an array that is longer than what came")
        if count == 0:
            return np.zeros(ref.shape, dtype)
        content = self._body[ref.begin : ref.begin + count * dtype.itemsize]
        # Any byte may stand there, and numpy takes a bool that is neither 0 nor 1 for what it likes.
        numbers = content != 0 if dtype.kind == "b" else content.view(dtype)
        return numbers.reshape(ref.shape)


def send(connection: socket.socket, message: object, arrays: ArrayPacker | None = None) -> None:
    """Raises Closed."""
    header = msgspec.msgpack.encode(message)
    parts: Sequence[NDArray] = () if arrays is None else arrays.parts
    try:
        connection.sendall(_SIZES.pack(len(header), 0 if arrays is None else arrays.size) + header)
        for part in parts:
            if part.nbytes:
                connection.sendall(part.reshape(-1).view(np.uint8).data)
                if gap := -part.nbytes % _ALIGNED:
                    connection.sendall(bytes(gap))
    except OSError as error:
        raise Closed from error


def receive(
    connection: socket.socket, decoder: msgspec.msgpack.Decoder[T], deadline: float | None = None
) -> tuple[T, ArrayReader]:
    """
    Args:
        decoder: of the header.
        deadline: of the monotonic clock; None waits for ever.

    Raises Closed, TookTooLong, or Garbled where it is something else.
    """
    header_size, body_size = _SIZES.unpack(_read(connection, _SIZES.size, deadline).data)
    if header_size > MOST_HEADER or body_size > MOST_BODY:
        raise Garbled(f"{header_size + body_size:,} bytes at once")
    header = _read(connection, header_size, deadline)
    try:
        said = decoder.decode(header.data)
    except (msgspec.MsgspecError, RecursionError, ValueError, OverflowError) as error:
        raise Garbled(str(error)) from error
    return said, ArrayReader(_read(connection, body_size, deadline))


def path_of(crossed: bytes) -> Path:
    """Of what `bytes_of` gave."""
    return Path(os.fsdecode(crossed))


def bytes_of(path: Path | str) -> bytes:
    """A path as bytes: a name need not be text."""
    return os.fsencode(path)


def _read(connection: socket.socket, size: int, deadline: float | None) -> NDArray[np.uint8]:
    # Not touched before it is written to, so a length that is only claimed takes no memory.
    content = np.empty(size, np.uint8)
    view, got = content.data, 0
    while got < size:
        if deadline is not None:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([connection], [], [], left)[0]:
                raise TookTooLong
        try:
            count = connection.recv_into(view[got:], min(size - got, _PIECE))
        except OSError as error:
            raise Closed from error
        if count == 0:
            raise Closed
        got += count
    return content

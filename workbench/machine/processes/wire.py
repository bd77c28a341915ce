"""Messages between processes (calls, answers, events), and the sockets that carry them."""

from __future__ import annotations

import functools
import math
import os
import re
import select
import socket
import struct
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, ForwardRef, Generic, TypeVar, get_args, get_origin

import msgspec
import numpy as np

MAX_MESSAGE_BYTES = 1 << 30
"""Maximum size of one message. The largest messages of a working task, its meshes and the pictures of all envs, have some
100 MB."""
_READ_BYTES, _COPIED_BYTES = 1 << 18, 1 << 14
"""`_READ_BYTES`: size of one read, larger than a socket's buffer. `_COPIED_BYTES`: smaller messages are
copied behind their length, so that one call sends both."""
_LENGTH = struct.Struct("!I")
_ARRAY, _AGAIN = 1, 2
"""msgpack extensions: `_ARRAY` stands for the next of the arrays behind the message; `_AGAIN` contains the
number of an earlier array of the same message, which occurs again."""
_ARRAY_KINDS = "biufcSU"
"""Kinds of arrays that may be sent; arrays of objects may not."""
_MAX_DESCRIPTION_BYTES = 500
"""Maximum size of the description of one array."""
_Head = tuple[str, int | None, msgspec.Raw]
Value = TypeVar("Value", covariant=True)


class Unreadable(EOFError):
    """The received bytes are not a message, and nothing after them can be read; the text has the reason."""


# --- calls -----------------------------------------------------------------------------------------


class Question(Generic[Value]):
    """Base class of requests in a `Call`; the answer is a `Value`."""

    part: ClassVar[Any] = None
    """Type of progress messages before the answer."""


@dataclass(frozen=True)
class Call:
    """A request to a worker; its answer, and progress messages before it, carry the same number."""

    number: int
    request: Question[Any]


def value_type(question: type[Question[Any]]) -> Any:
    """The type of a question's answer."""
    (base,) = question.__orig_bases__  # type: ignore[attr-defined]
    (kind,) = get_args(base)
    if isinstance(kind, ForwardRef):
        kind = vars(sys.modules[question.__module__])[kind.__forward_arg__]
    return kind


# --- sockets ---------------------------------------------------------------------------------------


def _poll(end: socket.socket) -> select.poll:
    poll = select.poll()  # not select(): a server with many pages has descriptors beyond 1024
    poll.register(end, select.POLLIN)
    return poll


def has_come(end: socket.socket, seconds: float | None = 0.0) -> bool:
    """Wait up to `seconds` (None waits for ever) for data or EOF; returns whether there is any. Thread-safe.

    Returns False if another thread has closed `end`.
    """
    # Uses its own poll object: one that two threads use at once raises RuntimeError.
    return end.fileno() >= 0 and bool(_poll(end).poll(None if seconds is None else 1000 * seconds))


class MessageSocket:
    """One end of a socket for messages. One thread may receive while another sends; any thread may call `waits`.

    The author's code runs in the worker: it may write anything into the socket, or end the worker in the
    middle of a message. So received bytes become data of the expected types, or raise `Unreadable`. A message
    is msgpack decoded by type, never a pickle:

        4 bytes    length of all that follows; framed as `multiprocessing.connection.Connection` does it
        4 bytes    length of the message
        message    msgpack: name of the class, number of the call (or nil), fields
        arrays     bytes, in the order in which the message names them
    """

    def __init__(
        self, end: socket.socket, kinds: Sequence[type] = (), questions: Sequence[type] = ()
    ) -> None:
        """
        Args:
            kinds, questions: accepted messages, as in `Unpacker`.
        """
        self.end = end
        self._unpacker = Unpacker(kinds, questions)
        self._poll = _poll(end)
        self._received, self._piece = bytearray(), memoryview(bytearray(_READ_BYTES))
        self._at = 0
        """Offset of the next message in `_received`."""

    def send(self, message: object) -> None:
        """Send a message; blocks until all of it is written. Raises OSError if the other end is closed."""
        self.send_bytes(pack_message(message))

    def send_bytes(self, raw: bytes) -> None:
        """Send a packed message. Raises as `send`."""
        head = _LENGTH.pack(len(raw))
        for piece in (head + raw,) if len(raw) < _COPIED_BYTES else (head, raw):  # do not copy large messages
            self.end.sendall(piece)

    def waits(self) -> bool:
        """Whether bytes or EOF are waiting to be read. Thread-safe."""
        return has_come(self.end)

    def receive(self, timeout: float | None) -> Any:
        """Wait up to `timeout` seconds (None waits for ever) for the next complete message; None if there is none.

        Raises:
            Unreadable: the bytes are not a message.
            EOFError: the other end is closed, and all complete messages were received.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        while (message := self._whole()) is None:
            if not self._poll.poll(
                None if deadline is None else 1000 * max(0.0, deadline - time.monotonic())
            ):
                return None
            try:
                count = self.end.recv_into(self._piece)
            except OSError as error:
                raise EOFError from error
            if not count:
                raise EOFError
            if self._at:
                self._received, self._at = self._received[self._at :], 0
            self._received += self._piece[:count]
        return message

    def _whole(self) -> Any | None:
        """The next message if it is complete."""
        begin = self._at + _LENGTH.size
        if len(self._received) < begin:
            return None
        length = _LENGTH.unpack_from(self._received, self._at)[0]
        if length > MAX_MESSAGE_BYTES:
            raise Unreadable(f"its stated length is {length} bytes")
        received, end = self._received, begin + length
        if len(received) < end:
            return None
        self._at = end
        if end == len(received):  # do not keep a large buffer until more data arrives
            self._received, self._at = bytearray(), 0
        return self._unpacker.message(memoryview(received)[begin:end])


# --- bytes -----------------------------------------------------------------------------------------


def pack(value: object) -> bytes:
    r"""Encode dataclasses, arrays and plain data.

    A text with lone surrogates arrives escaped (``\udcff``): a person can read it, but as a path it opens no
    file. A `Path` arrives unchanged.

    Raises:
        TypeError: `value` contains something else.
    """
    arrays = _Written()
    try:
        message = msgspec.msgpack.Encoder(enc_hook=arrays.hook).encode(value)
    except UnicodeEncodeError:  # a lone surrogate in the author's text, or in the name of a file
        arrays = _Written()
        plain = msgspec.to_builtins(value, builtin_types=(bytes, msgspec.msgpack.Ext), enc_hook=arrays.hook)
        message = msgspec.msgpack.encode(_can_be_written(plain))
    return b"".join((_LENGTH.pack(len(message)), message, *arrays.parts))


def pack_message(message: object) -> bytes:
    """Encode a request or an event; a `Call` is encoded under the class name of its question."""
    if isinstance(message, Call):
        return pack((type(message.request).__name__, message.number, message.request))
    return pack((type(message).__name__, None, message))


class Unpacker:
    """Decoder for `pack` and `pack_message`. Not thread-safe."""

    def __init__(self, kinds: Sequence[type] = (), questions: Sequence[type] = ()) -> None:
        """
        Args:
            kinds: accepted types of messages.
            questions: accepted types of requests in a `Call`.
        """
        self._kinds = {(kind.__name__, False): kind for kind in kinds}
        self._kinds |= {(kind.__name__, True): kind for kind in questions}
        self._decoders: dict[Any, msgspec.msgpack.Decoder[Any]] = {}
        self._arrays = _Read(memoryview(b""))

    def unpack(self, raw: bytes | bytearray | memoryview, kind: Any) -> Any:
        """Decode a value that `pack` encoded.

        Args:
            kind: type of the value, as an annotation.

        Raises:
            Unreadable: the value is not of this type.
        """
        return self._guarded(lambda: self._decoder(kind).decode(self._begin(raw)))

    def message(self, raw: bytes | bytearray | memoryview) -> Any:
        """Decode a message that `pack_message` encoded.

        Raises:
            Unreadable: the message is not of an accepted type.
        """
        return self._guarded(lambda: self._message(raw))

    def _message(self, raw: bytes | bytearray | memoryview) -> Any:
        name, number, body = self._decoder(_Head).decode(self._begin(raw))
        kind = self._kinds.get((name, number is not None))
        if kind is None:
            raise Unreadable(f"it is a {name[:100]}, which is not a message")
        message = self._decoder(kind).decode(body)
        return message if number is None else Call(number, message)

    def _begin(self, raw: bytes | bytearray | memoryview) -> memoryview:
        whole = memoryview(raw)
        end = _LENGTH.size + _LENGTH.unpack_from(whole)[0]
        if end > len(whole):
            raise ValueError("its stated length exceeds the data")
        self._arrays = _Read(whole[end:])
        return whole[_LENGTH.size : end]

    def _decoder(self, kind: Any) -> msgspec.msgpack.Decoder[Any]:
        if kind not in self._decoders:
            self._decoders[kind] = msgspec.msgpack.Decoder(
                kind, dec_hook=_checked, ext_hook=lambda code, data: self._arrays.take(code, data)
            )
        return self._decoders[kind]

    def _guarded(self, read: Any) -> Any:
        try:
            return read()
        except Unreadable:
            raise
        except Exception as error:
            # Any exception, since the bytes may be crafted to break their reader.
            raise Unreadable(f"{type(error).__name__}: {_line(error)}") from error
        finally:
            self._arrays = _Read(memoryview(b""))


class _Written:
    """Collects the arrays of a message while it is encoded."""

    def __init__(self) -> None:
        self.parts: list[Any] = []
        self._numbers: dict[int, int] = {}
        self._alive: list[np.ndarray] = []
        """Arrays that are kept alive, because Python could reuse their ids, which are the keys of
        `_numbers`."""

    def hook(self, value: object) -> object:
        if isinstance(value, np.ndarray):
            known = self._numbers.setdefault(id(value), len(self._numbers))
            if known < len(self._alive):
                return msgspec.msgpack.Ext(_AGAIN, str(known).encode())
            description = _array_description(value.dtype, value.shape)
            self._alive.append(value)
            if value.size:
                self.parts.append(np.ascontiguousarray(value).reshape(-1).view(np.uint8))
            return description
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, Path):
            return os.fsencode(value)
        if isinstance(value, Mapping):
            return dict(value)
        raise TypeError(f"a {type(value).__name__} cannot be sent")


class _Read:
    """Reads the arrays of a message while it is decoded."""

    def __init__(self, rest: memoryview) -> None:
        self._rest = rest
        self._taken: list[np.ndarray] = []

    def take(self, code: int, data: memoryview) -> np.ndarray:
        if code == _AGAIN:
            return self._taken[int(bytes(data))] if bytes(data).isdigit() else _refuse_array()
        if code != _ARRAY or len(data) > _MAX_DESCRIPTION_BYTES:
            _refuse_array()
        dtype, shape, size = _described(bytes(data))
        if size > len(self._rest):
            raise ValueError("an array is longer than the data")
        # A copy, so that one array does not keep the whole message alive.
        array = np.zeros(0, dtype) if size == 0 else np.frombuffer(self._rest[:size], dtype).copy()
        if dtype.kind == "b":  # other bytes than 0 and 1 are undefined in numpy
            array = array.view(np.uint8) != 0
        array = array.reshape(shape)
        self._rest = self._rest[size:]
        self._taken.append(array)
        return array


def _refuse_array() -> Any:
    raise ValueError("invalid description of an array")


@functools.lru_cache(1000)
def _array_description(dtype: np.dtype, shape: tuple[int, ...]) -> msgspec.msgpack.Ext:
    if dtype.kind not in _ARRAY_KINDS:
        raise TypeError(f"an array of {dtype} cannot be sent")
    return msgspec.msgpack.Ext(_ARRAY, msgspec.msgpack.encode((dtype.str, shape)))


@functools.lru_cache(1000)
def _described(data: bytes) -> tuple[np.dtype, tuple[int, ...], int]:
    name, shape = msgspec.msgpack.decode(data, type=tuple[str, tuple[int, ...]])
    # Accept dtypes only as numpy writes them ("<f4"): numpy also reads records, and old aliases with a warning.
    if re.fullmatch(rf"[<>|][{_ARRAY_KINDS}]\d+", name) is None:
        _refuse_array()
    dtype = np.dtype(name)
    if dtype.itemsize == 0 or min(shape, default=0) < 0:
        _refuse_array()
    return dtype, shape, dtype.itemsize * math.prod(shape)


def _checked(kind: Any, value: Any) -> Any:
    """Check a value of a type that msgpack does not have."""
    if (get_origin(kind) or kind) is np.ndarray and isinstance(value, np.ndarray):
        return value
    if kind is Path and isinstance(value, bytes):
        return Path(os.fsdecode(value))
    raise ValueError(f"a {type(value).__name__} in place of a {getattr(kind, '__name__', kind)}")


def _can_be_written(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, dict):
        return {_can_be_written(key): _can_be_written(one) for key, one in value.items()}
    return [_can_be_written(one) for one in value] if isinstance(value, list | tuple) else value


def _line(error: BaseException) -> str:
    return " ".join(str(error)[:2000].split())[:300] or "no reason given"

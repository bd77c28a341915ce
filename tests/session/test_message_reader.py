"""Whatever comes in on a worker's line is a message, the end of the worker, or not all there yet."""

from __future__ import annotations

import pickle
import random
import socket
import struct
import threading
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import pytest

from tests.drive.waiting import until
from workbench.session.message_reader import MOST_BYTES, MessageReader, Unreadable, message_from
from workbench.session.messages import Event, Loading, Status


class Line:
    def __init__(self) -> None:
        self.ours, self.theirs = socket.socketpair()
        self.reader = MessageReader(self.ours, Event)

    def close(self) -> None:
        self.ours.close()
        self.theirs.close()


@pytest.fixture
def line() -> Iterator[Line]:
    line = Line()
    yield line
    line.close()


def framed(raw: bytes) -> bytes:
    return struct.pack("!i", len(raw)) + raw


class _Calls:
    """Pickled it is a call."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self._call = function, arguments

    def __reduce__(self) -> Any:
        return self._call


class _HasNoText(Exception):
    def __str__(self) -> str:
        raise ValueError("no text")


def _raise_it() -> None:
    raise _HasNoText


def test_messages_come_as_a_connection_sends_them_whatever_their_size(line: Line) -> None:
    sender = Connection(line.theirs.detach())
    sent = [Loading("x" * size) for size in (0, 10, 16_384, 70_000, 40_000_000)]
    thread = threading.Thread(target=lambda: [sender.send(event) for event in sent])
    thread.start()
    got = []

    def all_came() -> bool:
        event = line.reader.receive(0.05)
        got.extend([] if event is None else [event])
        return len(got) == len(sent)

    until(all_came, "all messages", seen=lambda: len(got))
    thread.join()
    assert got == sent
    sender.close()
    with pytest.raises(EOFError) as caught:
        line.reader.receive(1.0)
    assert not isinstance(caught.value, Unreadable)


def test_a_message_that_stops_in_the_middle_is_not_waited_for(line: Line) -> None:
    whole = framed(pickle.dumps(Loading("importing")))
    for byte in whole[:-1]:
        line.theirs.send(bytes([byte]))
        assert line.reader.receive(0) is None
    line.theirs.send(whole[-1:])
    assert line.reader.receive(0) == Loading("importing")


@pytest.mark.parametrize(
    ("sent", "says"),
    [
        (framed(b""), "EOFError"),
        (framed(b"hello"), "UnpicklingError"),
        (framed(pickle.dumps(Loading("x"))[:-3]), "UnpicklingError|EOFError"),
        (framed(pickle.dumps({"a": 1})), "it was a dict, which is no message"),
        (framed(pickle.dumps(Loading)), "it was a type"),
        (framed(b"cworkbench.session.messages\nNoSuch\n."), "AttributeError"),
        (framed(b"cno_such_module\nname\n."), "ModuleNotFoundError"),
        (framed(pickle.dumps(_Calls(bytearray, 1 << 62))), "MemoryError"),
        (framed(pickle.dumps(_Calls(exit, 3))), "SystemExit|NameError"),
        (framed(pickle.dumps(_Calls(_raise_it))), "its __str__ raised ValueError"),
        (struct.pack("!i", -2), "it says that it is -2 bytes long"),
        (struct.pack("!i", 2**31 - 1), "bytes long"),
        (struct.pack("!iQ", -1, 2**63), "it says that it is 9223372036854775808 bytes long"),
        (b"print(1)\n", "it says that it is 1886546286 bytes long"),
    ],
)
def test_what_is_no_message_is_said_to_be_unreadable(line: Line, sent: bytes, says: str) -> None:
    line.theirs.sendall(sent)
    with pytest.raises(Unreadable, match=says):
        for _ in range(5):
            line.reader.receive(0.2)


def test_a_length_alone_takes_no_memory(line: Line) -> None:
    line.theirs.sendall(struct.pack("!i", MOST_BYTES))
    assert line.reader.receive(0) is None
    line.theirs.sendall(b"x")
    assert line.reader.receive(0) is None
    body = line.reader._body
    assert body is not None and len(body) < 2**25


def test_an_end_in_the_middle_of_a_message_is_an_end(line: Line) -> None:
    line.theirs.sendall(framed(pickle.dumps(Loading("x")))[:7])
    line.theirs.close()
    with pytest.raises(EOFError):
        for _ in range(5):
            line.reader.receive(0.2)


@pytest.mark.parametrize("seed", [1, *[pytest.param(n, marks=pytest.mark.slow) for n in range(2, 30)]])
def test_bytes_that_changed_on_the_way_raise_nothing_else(seed: int) -> None:
    chosen = random.Random(seed)
    good = pickle.dumps(Status(True, 3.0, 1.0, "x" * 40))
    for _ in range(3000):
        raw = bytearray(good)
        for _ in range(chosen.randint(1, 4)):
            byte = chosen.randrange(256)
            # A pickle may ask for a memo of 2**32 entries, which the interpreter allocates: not in a test.
            raw[chosen.randrange(len(raw))] = byte if byte not in b"rp" else 0
        try:
            assert isinstance(message_from(raw, Event), Event)
        except Unreadable as error:
            assert str(error)


def test_arrays_can_be_written_to(line: Line) -> None:
    message = message_from(pickle.dumps(np.arange(3)), np.ndarray)
    message += 1
    assert message.tolist() == [1, 2, 3]

"""Whatever comes in on a worker's line is a message, the end of the worker, or not all there yet."""

from __future__ import annotations

import pickle
import socket
import struct
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import get_args

import pytest

from tests.drive.waiting import until
from workbench.jobs.message_reader import MOST_BYTES, MessageReader
from workbench.jobs.wire import Unreadable, pack, pack_message
from workbench.session.messages import Event, Loading


class Line:
    def __init__(self) -> None:
        self.ours, self.theirs = socket.socketpair()
        self.reader = MessageReader(self.ours.fileno(), get_args(Event))

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


def test_messages_come_as_a_connection_sends_them_whatever_their_size(line: Line) -> None:
    sender = Connection(line.theirs.detach())
    sent = [Loading("x" * size) for size in (0, 10, 16_384, 70_000, 40_000_000)]
    thread = threading.Thread(target=lambda: [sender.send_bytes(pack_message(event)) for event in sent])
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
    whole = framed(pack_message(Loading("importing")))
    for byte in whole[:-1]:
        line.theirs.send(bytes([byte]))
        assert line.reader.receive(0) is None
    line.theirs.send(whole[-1:])
    assert line.reader.receive(0) == Loading("importing")


def test_what_is_there_is_read_at_once_and_what_is_missing_is_waited_for(line: Line) -> None:
    whole = framed(pack_message(Loading("importing")))
    line.theirs.sendall(whole)
    assert line.reader.receive(0) == Loading("importing")
    with ThreadPoolExecutor(1) as threads:
        received = threads.submit(line.reader.receive, 60.0)
        line.theirs.sendall(whole[:-1])
        until(lambda: line.reader._filled == len(whole) - 5, "all but one byte taken")
        line.theirs.sendall(whole[-1:])
        assert received.result(timeout=60) == Loading("importing")


@pytest.mark.parametrize(
    ("sent", "says"),
    [
        (framed(b""), "unpack"),
        (framed(b"hello"), "longer than it is"),
        (framed(pack_message(Loading("x"))[:-3]), "longer than it is"),
        (framed(pickle.dumps(Loading("x"))), "longer than it is"),
        (framed(pack(("dict", None, {}))), "it was a dict, which is no message"),
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
    line.theirs.sendall(framed(pack_message(Loading("x")))[:7])
    line.theirs.close()
    with pytest.raises(EOFError):
        for _ in range(5):
            line.reader.receive(0.2)


@pytest.mark.parametrize("begun", [b"", b"\0\0", framed(b"hello")[:6]])
def test_a_process_that_goes_without_reading_what_it_was_sent_is_an_end(line: Line, begun: bytes) -> None:
    line.theirs.sendall(begun)
    assert line.reader.receive(0) is None
    line.ours.sendall(b"a request")
    line.theirs.close()  # the kernel says that the connection was reset, and not that it is over
    with pytest.raises(EOFError) as caught:
        line.reader.receive(1.0)
    assert not isinstance(caught.value, Unreadable)

"""Whatever comes in on a worker's line is a message, the end of the worker, or not all there yet."""

from __future__ import annotations

import os
import pickle
import socket
import struct
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import get_args

import pytest

from tests.drive.waiting import until
from workbench.machine.processes.wire import MOST_BYTES, MessageSocket, Unreadable, pack, pack_message
from workbench.session.protocol.messages import Event, Loading


class Ends:
    def __init__(self) -> None:
        self.ours, self.theirs = socket.socketpair()
        self.line = MessageSocket(self.ours, get_args(Event))

    def close(self) -> None:
        self.ours.close()
        self.theirs.close()


@pytest.fixture
def ends() -> Iterator[Ends]:
    ends = Ends()
    yield ends
    ends.close()


def framed(raw: bytes) -> bytes:
    return struct.pack("!i", len(raw)) + raw


@pytest.mark.parametrize("by_connection", [True, False])
def test_messages_come_as_they_were_sent_whatever_their_size(ends: Ends, by_connection: bool) -> None:
    sent = [Loading("x" * size) for size in (0, 10, 16_384, 70_000, 300_000, 40_000_000, 0, 1)]

    def send() -> None:
        """As a pool's process does, too: what is sent to it are not messages."""
        line, connection = MessageSocket(ends.theirs), Connection(os.dup(ends.theirs.fileno()))
        for event in sent:
            connection.send_bytes(pack_message(event)) if by_connection else line.send(event)
        connection.close()

    thread = threading.Thread(target=send)
    thread.start()
    got = []

    def all_came() -> bool:
        event = ends.line.receive(0.05)
        got.extend([] if event is None else [event])
        return len(got) == len(sent)

    until(all_came, "all messages", seen=lambda: len(got))
    thread.join()
    assert got == sent and not ends.line._came, "what was read is not kept"
    ends.theirs.close()
    with pytest.raises(EOFError) as caught:
        ends.line.receive(1.0)
    assert not isinstance(caught.value, Unreadable)


def test_what_came_whole_is_received_before_the_end_and_without_a_time_it_is_waited_for(ends: Ends) -> None:
    sent = [Loading(f"step {number}") for number in range(1000)]
    ends.theirs.sendall(b"".join(framed(pack_message(event)) for event in sent))
    assert ends.line.waits()
    assert ends.line.receive(None) == sent[0]
    assert not ends.line.waits(), "all of it came together"
    ends.theirs.close()
    assert [ends.line.receive(0) for _ in sent[1:]] == sent[1:]
    with pytest.raises(EOFError):
        ends.line.receive(None)


def test_several_threads_may_ask_at_once_whether_something_waits(ends: Ends) -> None:
    # The one that checks rules asks between two steps, and the one that gives the cores back when a person waits.
    stop = threading.Event()

    def ask() -> int:
        count = 0
        while not stop.is_set():
            assert not ends.line.waits()
            count += 1
        return count

    with ThreadPoolExecutor(3) as threads:
        asked = [threads.submit(ask) for _ in range(3)]
        try:
            assert ends.line.receive(0.5) is None
        finally:
            stop.set()
        assert all(one.result() > 10 for one in asked)


def test_what_was_read_is_let_go_of_also_where_the_next_message_has_always_begun(ends: Ends) -> None:
    whole = framed(pack_message(Loading("x" * 100_000)))
    ends.theirs.sendall(whole[:1])
    for _ in range(30):
        ends.theirs.sendall(whole[1:] + whole[:1])
        assert ends.line.receive(10) == Loading("x" * 100_000)
        assert len(ends.line._came) < 3 * len(whole)


def test_it_is_waited_for_no_shorter_than_was_asked_for(ends: Ends) -> None:
    begun = time.monotonic()
    assert ends.line.receive(0.2) is None
    assert time.monotonic() - begun >= 0.2


def test_a_message_that_stops_in_the_middle_is_not_waited_for(ends: Ends) -> None:
    whole = framed(pack_message(Loading("importing")))
    for byte in whole[:-1]:
        ends.theirs.send(bytes([byte]))
        assert ends.line.receive(0) is None
    ends.theirs.send(whole[-1:])
    assert ends.line.receive(0) == Loading("importing")


def test_what_is_there_is_read_at_once_and_what_is_missing_is_waited_for(ends: Ends) -> None:
    whole = framed(pack_message(Loading("importing")))
    ends.theirs.sendall(whole)
    assert ends.line.receive(0) == Loading("importing")
    with ThreadPoolExecutor(1) as threads:
        received = threads.submit(ends.line.receive, 60.0)
        ends.theirs.sendall(whole[:-1])
        until(lambda: len(ends.line._came) == len(whole) - 1, "all but one byte taken")
        ends.theirs.sendall(whole[-1:])
        assert received.result(timeout=60) == Loading("importing")


@pytest.mark.parametrize(
    ("sent", "says"),
    [
        (framed(b""), "unpack"),
        (framed(b"hello"), "exceeds the data"),
        (framed(pack_message(Loading("x"))[:-3]), "exceeds the data"),
        (framed(pickle.dumps(Loading("x"))), "exceeds the data"),
        (framed(pack(("dict", None, {}))), "it was a dict, which is no message"),
        (struct.pack("!i", -2), "it says that it is 4294967294 bytes long"),
        (struct.pack("!i", 2**31 - 1), "bytes long"),
        (struct.pack("!iQ", -1, 2**63), "it says that it is 4294967295 bytes long"),
        (b"print(1)\n", "it says that it is 1886546286 bytes long"),
    ],
)
def test_what_is_no_message_is_said_to_be_unreadable(ends: Ends, sent: bytes, says: str) -> None:
    ends.theirs.sendall(sent)
    with pytest.raises(Unreadable, match=says):
        for _ in range(5):
            ends.line.receive(0.2)


def test_a_length_alone_takes_no_memory(ends: Ends) -> None:
    ends.theirs.sendall(struct.pack("!i", MOST_BYTES))
    assert ends.line.receive(0) is None
    ends.theirs.sendall(b"x")
    assert ends.line.receive(0) is None
    assert len(ends.line._came) < 2**25


def test_an_end_in_the_middle_of_a_message_is_an_end(ends: Ends) -> None:
    ends.theirs.sendall(framed(pack_message(Loading("x")))[:7])
    ends.theirs.close()
    with pytest.raises(EOFError):
        for _ in range(5):
            ends.line.receive(0.2)


@pytest.mark.parametrize("begun", [b"", b"\0\0", framed(b"hello")[:6]])
def test_a_process_that_goes_without_reading_what_it_was_sent_is_an_end(ends: Ends, begun: bytes) -> None:
    ends.theirs.sendall(begun)
    assert ends.line.receive(0) is None
    ends.ours.sendall(b"a request")
    ends.theirs.close()  # the kernel says that the connection was reset, and not that it is over
    with pytest.raises(EOFError) as caught:
        ends.line.receive(1.0)
    assert not isinstance(caught.value, Unreadable)

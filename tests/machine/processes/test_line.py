"""Data on a worker's socket is a message, EOF, an incomplete message, or unreadable."""

from __future__ import annotations

import pickle
import socket
import struct
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import get_args

import psutil
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.drive.waiting import until
from workbench.live.messages import Event, Loading
from workbench.machine.processes.wire import MAX_MESSAGE_BYTES, MessageSocket, Unreadable, pack, pack_message


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
def test_messages_of_any_size_arrive_as_sent(ends: Ends, by_connection: bool) -> None:
    sent = [Loading("x" * size) for size in (0, 10, 16_384, 70_000, 300_000, 20_000_000, 0, 1)]

    def send() -> None:
        """Send through a multiprocessing connection, as a pool's process does, or through a `MessageSocket`."""
        with ends.theirs:
            if by_connection:
                connection = Connection(ends.theirs.detach())
                for event in sent:
                    connection.send_bytes(pack_message(event))
                connection.close()
            else:
                line = MessageSocket(ends.theirs)
                for event in sent:
                    line.send(event)

    got: list[object] = []
    with ThreadPoolExecutor(1) as threads:
        sending = threads.submit(send)
        while len(got) < len(sent):
            got.append(ends.line.receive(None))
        sending.result(60)
    assert got == sent
    with pytest.raises(EOFError) as caught:
        ends.line.receive(60.0)
    assert not isinstance(caught.value, Unreadable)


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.text(max_size=30), min_size=1, max_size=6), st.data())
def test_messages_in_pieces_are_received_whole_and_in_order(texts: list[str], data: st.DataObject) -> None:
    ends, sent = Ends(), [Loading(text.encode(errors="backslashreplace").decode()) for text in texts]
    raw, got, ready = b"".join(framed(pack_message(event)) for event in sent), [], 0
    whole = [len(framed(pack_message(event))) for event in sent]
    while raw:
        cut = data.draw(st.integers(1, len(raw)))
        ends.theirs.sendall(raw[:cut])
        raw, ready = raw[cut:], ready + cut
        assert ends.line.waits()
        while (event := ends.line.receive(0)) is not None:
            got.append(event)
        due = sum(sum(whole[: k + 1]) <= ready for k in range(len(sent)))
        assert got == sent[:due]
    ends.theirs.close()
    with pytest.raises(EOFError):
        ends.line.receive(0)
    ends.close()


def test_read_bytes_are_freed_even_if_the_next_message_has_begun(ends: Ends) -> None:
    whole = framed(pack_message(Loading("x" * 100_000)))
    ends.theirs.sendall(whole[:1])
    before = psutil.Process().memory_info().rss
    for _ in range(1000):
        ends.theirs.sendall(whole[1:] + whole[:1])
        assert ends.line.receive(60) == Loading("x" * 100_000)
    assert psutil.Process().memory_info().rss - before < 50 * 2**20
    ends.theirs.sendall(whole[1:] + struct.pack("!i", MAX_MESSAGE_BYTES) + b"x")
    assert ends.line.receive(60) is not None and ends.line.receive(0) is None
    assert psutil.Process().memory_info().rss - before < 100 * 2**20, (
        "a length header alone must not allocate memory"
    )


def test_several_threads_can_poll_and_receive_waits_for_its_full_timeout(ends: Ends) -> None:
    stop = threading.Event()

    def poll() -> int:
        count = 0
        while not stop.is_set():
            assert not ends.line.waits()
            count += 1
        return count

    with ThreadPoolExecutor(3) as threads:
        polls = [threads.submit(poll) for _ in range(3)]
        began = time.monotonic()
        try:
            assert ends.line.receive(0.3) is None and time.monotonic() - began >= 0.3
        finally:
            stop.set()
        assert all(one.result() > 0 for one in polls)
        received = threads.submit(ends.line.receive, 60.0)
        whole = framed(pack_message(Loading("importing")))
        ends.theirs.sendall(whole[:-1])
        until(lambda: not ends.line.waits(), "all bytes but one to be read")
        ends.theirs.sendall(whole[-1:])
        assert received.result(timeout=60) == Loading("importing")


@pytest.mark.parametrize(
    "sent",
    [
        framed(b""),
        framed(b"hello"),
        framed(pack_message(Loading("x"))[:-3]),
        framed(pickle.dumps(Loading("x"))),
        framed(pack(("dict", None, {}))),
        struct.pack("!i", -2),
        struct.pack("!i", 2**31 - 1),
        struct.pack("!iQ", -1, 2**63),
        b"print(1)\n",
    ],
)
def test_invalid_messages_raise_unreadable(ends: Ends, sent: bytes) -> None:
    ends.theirs.sendall(sent)
    with pytest.raises(Unreadable):
        ends.line.receive(60.0)


@pytest.mark.parametrize("begun", [b"", b"\0\0", framed(b"hello")[:6]])
def test_a_process_that_ends_mid_message_or_without_reading_is_eof(ends: Ends, begun: bytes) -> None:
    ends.theirs.sendall(begun)
    assert ends.line.receive(0) is None
    ends.ours.sendall(b"a request")
    ends.theirs.close()  # the kernel reports ECONNRESET here, not EOF
    with pytest.raises(EOFError) as caught:
        ends.line.receive(60.0)
    assert not isinstance(caught.value, Unreadable)

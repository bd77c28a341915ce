"""Limits for connections without the token: time, number, bytes and log lines."""

from __future__ import annotations

import contextlib
import logging
import re
import socket
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tests.drive.knocking import PROTOCOL, ask, both, client, cookie_of, knock, token_of
from workbench.page.door import connection_limits as strangers
from workbench.page.door.access import cookie_name
from workbench.page.door.connection_limits import RateLimitedLog
from workbench.page.door.gated_server import GatedServer


def connected(gated_server: GatedServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", gated_server.port), timeout=30)


def is_closed(sock: socket.socket) -> bool:
    """Whether the other end has closed; waits up to the socket's timeout."""
    try:
        return sock.recv(1 << 16) == b""
    except ConnectionResetError:
        return True


@pytest.mark.thorough
@pytest.mark.parametrize(
    "said", [b"", b"GET / HTTP/1.1\r\n", b"GET / HTTP/1.1\r\nHost: x\r\nX: ", b"\x16\x03"]
)
def test_a_connection_without_a_request_is_closed_after_a_timeout(gated_server, monkeypatch, said):
    monkeypatch.setattr(strangers, "TOKEN_TIMEOUT_SECONDS", 0.3)
    with connected(gated_server) as quiet:
        quiet.sendall(said)
        assert is_closed(quiet)
    assert both(gated_server) == (200, 101)


@pytest.mark.thorough
def test_sending_the_head_byte_by_byte_does_not_extend_the_timeout(gated_server, monkeypatch):
    monkeypatch.setattr(strangers, "TOKEN_TIMEOUT_SECONDS", 0.5)
    with connected(gated_server) as slow, pytest.raises(OSError):
        for byte in b"GET / HTTP/1.1\r\nX: " + b"y" * 10_000:
            slow.sendall(bytes([byte]))
            time.sleep(0.02)  # under test: a few bytes arrive all the time


def test_a_refused_client_that_does_not_close_is_closed(gated_server, monkeypatch):
    monkeypatch.setattr(strangers, "TOKEN_TIMEOUT_SECONDS", 0.5)
    with connected(gated_server) as refused:
        refused.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        answer = b""
        while piece := refused.recv(1 << 16):
            answer += piece
    assert answer.startswith(b"HTTP/1.1 403")


@pytest.mark.thorough
def test_a_page_with_the_token_has_no_timeout(gated_server, monkeypatch):
    monkeypatch.setattr(strangers, "TOKEN_TIMEOUT_SECONDS", 0.3)
    slow = (200, "application/octet-stream", b"x" * 1000)
    # Both take longer than the timeout without a token.
    gated_server.add_route("/slow/", lambda path, query: time.sleep(0.8) or slow)
    assert ask(gated_server, "/slow/x")[2] == b"x" * 1000
    with client(gated_server) as page:
        time.sleep(0.6)
        page.ping().wait(30)


def test_many_silent_connections_do_not_lock_out_others(gated_server, monkeypatch, caplog):
    monkeypatch.setattr(strangers, "MAX_WITHOUT_TOKEN", 10)
    with contextlib.ExitStack() as stack, caplog.at_level(logging.WARNING):
        idle = [stack.enter_context(connected(gated_server)) for _ in range(30)]
        for _ in range(5):
            assert both(gated_server) == (200, 101)
            assert ask(gated_server, "/", Cookie=None)[0] == 403
        # The oldest are closed, the newest are still open.
        assert is_closed(idle[0])
        idle[-1].settimeout(0.2)
        with pytest.raises(TimeoutError):
            idle[-1].recv(1)
    assert "10 connections are open without the token (from 127.0.0.1)" in caplog.text


def test_the_peer_with_the_most_connections_loses_its_oldest(gated_server, monkeypatch):
    monkeypatch.setattr(strangers, "MAX_WITHOUT_TOKEN", 10)
    address = "127.0.0.1", gated_server.port
    with contextlib.ExitStack() as stack:
        other = stack.enter_context(
            socket.create_connection(address, timeout=30, source_address=("127.0.0.2", 0))
        )
        crowd = [stack.enter_context(connected(gated_server)) for _ in range(20)]
        assert is_closed(crowd[0])
        other.settimeout(0.2)
        with pytest.raises(TimeoutError):
            other.recv(1)


@pytest.mark.parametrize(
    "head",
    [
        b"GET / HTTP/1.1\r\n" + b"X: " + b"y" * 8000 + b"\r\n",
        b"GET /" + b"y" * 5000 + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" + b"more" * 50_000,
    ],
)
def test_a_head_above_the_size_limit_is_refused(gated_server, head):
    with connected(gated_server) as large:
        with contextlib.suppress(OSError):
            for _ in range(200):
                large.sendall(head)
        with contextlib.suppress(ConnectionResetError):
            while piece := large.recv(1 << 16):
                assert b" 200 " not in piece[:20]
    assert both(gated_server) == (200, 101)


def test_the_size_of_a_head_is_that_of_all_its_pieces(gated_server):
    """Else a stranger makes the server keep a megabyte per connection, a line at a time."""
    with connected(gated_server) as large:
        large.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n")
        with contextlib.suppress(OSError):
            for number in range(strangers.MAX_HEAD_BYTES // 4000 + 1):
                large.sendall(b"X-%d: " % number + b"y" * 4000 + b"\r\n")
            large.sendall(b"\r\n")
        assert large.recv(100).startswith(b"HTTP/1.1 431 ")


def test_cookies_of_many_other_programs_fit_into_the_head(gated_server):
    others = "; ".join(f"other-{number}={'x' * 3000}" for number in range(2))
    assert both(gated_server, Cookie=f"{others}; {cookie_of(gated_server)}") == (200, 101)


REQUESTS = st.lists(
    st.sampled_from(
        [
            *(b"GET ", b"POST ", b"/", b" HTTP/1.1\r\n", b" HTTP/1.0\r\n", b"Host: 127.0.0.1\r\n", b"\r\n"),
            *(b"Upgrade: websocket\r\nConnection: Upgrade\r\n", b"Sec-WebSocket-Key: x\r\n", b"Cookie: "),
            *(b"Sec-WebSocket-Version: 13\r\n", b"Content-Length: 5\r\n", b"Transfer-Encoding: chunked\r\n"),
            *(b"?token=", b"%00", b"\xff\xfe", b"\n", b":", b"\x81\x85\0\0\0\0", b"x" * 9000),
        ]
    )
    | st.binary(max_size=20),
    max_size=14,
).map(b"".join)


@pytest.fixture
def fuzzed(gated_server: GatedServer, capfd: pytest.CaptureFixture[str]) -> Iterator[GatedServer]:
    """A server that still lets a page in after the fuzzing, and has printed nothing."""
    yield gated_server
    assert both(gated_server) == (200, 101)
    assert "Traceback" not in capfd.readouterr().err


with_fixtures = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@settings(with_fixtures, max_examples=60)
@given(REQUESTS)
@example(b"\x00\x01\x02\r\n\r\n")
@example(b"GET / HTTP/1.1\r\nHost\r\n\r\n")
@example(b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 1000 + b"\r\n")
@example(b"\x16\x03\x01\x02\x00\x01\x00")  # TLS
def test_any_data_without_the_token_is_refused(fuzzed, raw):
    with connected(fuzzed) as sock, contextlib.suppress(ConnectionResetError, BrokenPipeError):
        sock.sendall(raw)
        sock.shutdown(socket.SHUT_WR)
        answer = b""
        while piece := sock.recv(1 << 16):
            answer += piece
        assert answer == b"" or answer.startswith((b"HTTP/1.1 403", b"HTTP/1.1 431"))


# Log lines ------------------------------------------------------------------------------------

MAX_LINES = 20
"""Maximum terminal lines from a few hundred connections in some seconds."""


def reset(sock: socket.socket) -> None:
    """Close with a reset, so that later writes of the other end fail."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    sock.close()


def page_of(gated_server: GatedServer, protocol: str) -> socket.socket:
    """A raw connection with the token, after its handshake."""
    sock, host = connected(gated_server), f"127.0.0.1:{gated_server.port}"
    head = f"GET / HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nCookie: {cookie_of(gated_server)}\r\n"
    head += "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
    sock.sendall(f"{head}Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: {protocol}\r\n\r\n".encode())
    assert b" 101 " in sock.recv(1 << 12)
    return sock


def zeros(gated_server: GatedServer) -> None:
    with connected(gated_server) as sock, contextlib.suppress(OSError):
        sock.sendall(bytes(70_000))
        is_closed(sock)


def long_protocol(gated_server: GatedServer) -> None:
    page_of(gated_server, f"viser-v{'x' * 3000}").close()


def pings(gated_server: GatedServer) -> None:
    sock = page_of(gated_server, PROTOCOL)
    with contextlib.suppress(OSError):
        for _ in range(50):
            sock.sendall(b"\x89\x81\0\0\0\0x" * 200)
    reset(sock)


def broken_frames(gated_server: GatedServer) -> None:
    for frame in (
        b"\xff" * 300,
        b"\x82\xfe\x01\x00" + bytes(260),
        b"\x81\x81\0\0\0\0\xff",
        b"\x82\x81\0\0\0\0\xc0",
    ):
        sock = page_of(gated_server, PROTOCOL)
        sock.sendall(frame)
        reset(sock)


def fails(gated_server: GatedServer) -> None:
    assert ask(gated_server, "/fails/" + "y" * 200)[0] == 500


def presses(gated_server: GatedServer) -> None:
    (entry,) = gated_server.server.gui._command_handle_from_uuid
    message = {"type": "CommandTriggerMessage", "uuid": entry}
    with client(gated_server) as page:
        page.send(msgspec.msgpack.encode(message))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("attack", "times"),
    [(zeros, 60), (long_protocol, 30), (pings, 5), (broken_frames, 30), (fails, 60), (presses, 60)],
)
def test_any_attack_prints_only_a_few_short_lines(
    gated_server: GatedServer,
    attack: Callable[[GatedServer], None],
    times: int,
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
) -> None:
    def fail(*what: object) -> Any:
        raise RuntimeError("z" * 100_000)

    gated_server.add_route("/fails/", fail)
    gated_server.server.gui.add_command("Fails").on_trigger(fail)
    for _ in range(times):
        attack(gated_server)
    assert both(gated_server) == (200, 101)
    time.sleep(0.5)  # for failures in threads
    gated_server.close()
    last_resort = logging.lastResort
    assert last_resort is not None
    said = [last_resort.format(record) for record in caplog.records if record.levelno >= logging.WARNING]
    printed = capfd.readouterr()
    lines = "\n".join((*said, printed.out, printed.err)).strip().splitlines()
    assert len(lines) <= MAX_LINES * (4 if attack in (fails, presses) else 1), lines[:100]
    if attack not in (
        fails,
        presses,
    ):  # a terminal truncates the lines of a traceback (tests/machine/test_terminal_text.py)
        assert all(len(line) <= 600 for line in lines)


def test_refused_requests_are_counted_and_logged_once_per_kind(gated_server, caplog):
    hostile = "\x1b[31m\n<b>"
    with caplog.at_level(logging.WARNING):
        assert gated_server.turned_away == 0  # the server's self-test does not count
        for _ in range(3):
            ask(gated_server, "/", Cookie=None)
            ask(gated_server, f"/?token=wrong{'x' * 30}", Cookie=None)
            ask(gated_server, "/", Cookie=f"{cookie_name(gated_server.port)}=old")
            knock(gated_server, Origin="https://evil.example")
            ask(gated_server, "/", Host="evil.example")
        ask(gated_server, "/" + hostile.encode().hex())
    assert gated_server.turned_away == 15
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 4
    assert all(
        "from 127.0.0.1" in line and "evil" not in line and token_of(gated_server) not in line
        for line in lines
    )


def test_a_repeated_message_is_logged_less_and_less_often(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(strangers.time, "monotonic", lambda: now[0])
    said: list[str] = []
    log = RateLimitedLog(said.append, pause=60.0)
    for _ in range(4 * 3600):
        log.add("a", "It happened.")
        now[0] += 1.0
    assert said[:2] == ["It happened.", "It happened. (59 more times since the last message.)"]
    assert len(said) < 12
    lines = len(said)
    for _ in range(2):
        log.flush()
    assert len(said) == lines + 1, "suppressed messages are reported once"
    suppressed = sum(int(number) for line in said for number in re.findall(r"\((\d+) more times", line))
    assert lines + suppressed == 4 * 3600
    log.add("b", "Another\x1b[2J\nthing\u202e.")
    assert said[-1] == r"Another\x1b[2J\nthing\u202e."

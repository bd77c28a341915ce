"""Files served by a route over a real socket: never longer than announced, even if the file changes."""

from __future__ import annotations

import gzip
import os
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.drive.knocking import ask, cookie_of
from tests.drive.waiting import until
from workbench.page.door.file_response import BLOCK_BYTES, Downloads, FileReply
from workbench.page.door.gated_server import GatedServer, ServerOptions, open_server

LARGE_BYTES = 48 * 2**20
"""More than the kernel buffers for a connection whose other end does not read."""


@pytest.fixture(scope="module")
def gated_server() -> Iterator[GatedServer]:
    """One server for all tests of this file."""
    with closing(open_server(ServerOptions(port=0))) as gated_server:
        yield gated_server


@pytest.fixture
def file(gated_server: GatedServer, tmp_path: Path, request: pytest.FixtureRequest) -> tuple[str, Path]:
    """An address, and the file that is served there."""
    path = tmp_path / "recording.rerun.write"
    prefix = f"/{request.node.name.partition('[')[0]}-{tmp_path.name}/"
    gated_server.add_route(
        prefix, lambda _, query: FileReply(path, "application/x-rerun", download_as="Größe 1.rrd")
    )
    return f"{prefix}x", path


def started(gated_server: GatedServer, address: str) -> tuple[socket.socket, bytes]:
    """A connection whose response was read only up to its head and a few bytes."""
    raw = socket.socket()
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
    raw.settimeout(30)
    raw.connect(("127.0.0.1", gated_server.port))
    request = f"GET {address} HTTP/1.1\r\nHost: 127.0.0.1:{gated_server.port}\r\nCookie: {cookie_of(gated_server)}\r\n\r\n"
    raw.sendall(request.encode())
    got = b""
    while b"\r\n\r\n" not in got:
        got += raw.recv(1 << 10)
    return raw, got


def rest(raw: socket.socket, got: bytes) -> tuple[int, int]:
    """The announced length, and the number of bytes until the server closed the connection."""
    head, _, body = got.partition(b"\r\n\r\n")
    (announced,) = [int(line[15:]) for line in head.split(b"\r\n") if line.startswith(b"Content-Length:")]
    count = len(body)
    with raw:
        try:
            while block := raw.recv(1 << 20):
                count += len(block)
        except ConnectionResetError:
            pass  # cut off
    return announced, count


def open_files(path: Path) -> int:
    return sum(found.path == str(path) for found in psutil.Process().open_files())


def position(path: Path) -> int:
    """How far this process has read the file; -1 where it is not open."""
    for found in psutil.Process().open_files():
        if found.path == str(path):
            return found.position  # type: ignore[attr-defined]
    return -1


@pytest.mark.parametrize("size", [0, 1, BLOCK_BYTES - 1, BLOCK_BYTES, 2 * BLOCK_BYTES + 1])
def test_a_file_is_sent_whole_and_under_its_name(
    gated_server: GatedServer, file: tuple[str, Path], size: int
) -> None:
    address, path = file
    path.write_bytes(os.urandom(size))
    status, headers, body = ask(gated_server, address)
    assert (status, body) == (200, path.read_bytes())
    assert headers["Content-Type"] == "application/x-rerun"
    assert headers["Content-Length"] == str(size)
    assert headers["Content-Disposition"] == "attachment; filename*=UTF-8''Gr%C3%B6%C3%9Fe%201.rrd"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert "Content-Encoding" not in headers
    until(lambda: open_files(path) == 0, "the end of the reading")


def test_a_file_that_grows_is_sent_only_up_to_the_announced_length(
    gated_server: GatedServer, file: tuple[str, Path]
) -> None:
    address, path = file
    path.touch()
    os.truncate(path, LARGE_BYTES + 100)
    raw, got = started(gated_server, address)
    os.truncate(path, LARGE_BYTES + 10 * BLOCK_BYTES)
    assert rest(raw, got) == (LARGE_BYTES + 100, LARGE_BYTES + 100)


def test_a_file_that_shrinks_is_cut_off_and_not_padded(
    gated_server: GatedServer, file: tuple[str, Path]
) -> None:
    address, path = file
    path.touch()
    os.truncate(path, LARGE_BYTES)
    raw, got = started(gated_server, address)
    os.truncate(path, LARGE_BYTES // 2)
    announced, count = rest(raw, got)
    assert announced == LARGE_BYTES and count <= LARGE_BYTES // 2
    until(lambda: open_files(path) == 0, "the end of the reading")


def test_a_client_that_leaves_midway_keeps_no_file_open_and_logs_nothing(
    gated_server: GatedServer, file: tuple[str, Path], caplog: pytest.LogCaptureFixture
) -> None:
    address, path = file
    path.touch()
    os.truncate(path, LARGE_BYTES)
    raw, _ = started(gated_server, address)
    assert open_files(path) == 1
    raw.close()
    until(lambda: open_files(path) == 0, "the end of the reading")
    assert ask(gated_server, "/")[0] == 200
    assert caplog.records == []


def test_the_file_is_not_read_ahead_for_a_client_that_does_not_read(
    gated_server: GatedServer, file: tuple[str, Path]
) -> None:
    address, path = file
    path.touch()
    os.truncate(path, LARGE_BYTES)
    raw, _ = started(gated_server, address)
    with raw:
        still, at = 0, -1
        while still < 30:
            assert ask(gated_server, "/workbench/logo.svg")[0] == 200
            before, at = at, position(path)
            still = still + 1 if at == before else 0
        assert 0 < at < LARGE_BYTES, "the whole file is in memory"


@pytest.mark.parametrize("kind", ["missing", "folder"])
def test_a_deleted_file_is_not_found(gated_server: GatedServer, file: tuple[str, Path], kind: str) -> None:
    address, path = file
    if kind == "folder":
        path.mkdir()
    status, headers, body = ask(gated_server, address)
    assert (status, body) == (404, b"There is no such file.")
    assert headers["X-Content-Type-Options"] == "nosniff" and "Content-Security-Policy" in headers


def test_a_compressed_file_is_decompressed_for_clients_that_cannot(
    gated_server: GatedServer, tmp_path: Path
) -> None:
    plain = b"wasm " * BLOCK_BYTES
    path = tmp_path / "viewer.wasm.gz"
    path.write_bytes(gzip.compress(plain))
    gated_server.add_route("/packed/", lambda _, query: FileReply(path, "application/wasm", gzipped=True))
    status, headers, body = ask(gated_server, "/packed/x", Accept_Encoding="br, gzip")
    assert (status, headers["Content-Encoding"], headers["Vary"]) == (200, "gzip", "Accept-Encoding")
    assert body == path.read_bytes() and "Content-Disposition" not in headers
    status, headers, body = ask(gated_server, "/packed/x", Accept_Encoding="identity")
    assert (status, headers["Vary"], body) == (200, "Accept-Encoding", plain)
    assert headers["Content-Length"] == str(len(plain)) and "Content-Encoding" not in headers
    until(lambda: open_files(path) == 0, "the end of the reading")


@pytest.mark.parametrize("damage", ["not packed at all", "torn off", "turned"])
def test_a_damaged_compressed_file_is_cut_off_without_terminal_output(
    gated_server: GatedServer, tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    packed = bytearray(gzip.compress(os.urandom(6 * BLOCK_BYTES)))
    if damage == "not packed at all":
        packed[:2] = b"no"
    elif damage == "torn off":
        packed[3 * BLOCK_BYTES : -4] = b""
    else:
        packed[3 * BLOCK_BYTES : 3 * BLOCK_BYTES + 4096] = b"\xff" * 4096
    path = tmp_path / "viewer.wasm.gz"
    path.write_bytes(packed)
    prefix = f"/damaged-{damage.replace(' ', '-')}/"
    gated_server.add_route(prefix, lambda _, query: FileReply(path, "application/wasm", gzipped=True))
    raw, got = started(gated_server, f"{prefix}x")
    announced, count = rest(raw, got)
    assert announced == 6 * BLOCK_BYTES and count < announced
    until(lambda: open_files(path) == 0, "the end of the reading")
    assert caplog.records == []


def test_a_file_is_served_only_under_the_address_that_its_page_got(
    gated_server: GatedServer, tmp_path: Path
) -> None:
    downloads = Downloads(gated_server.add_route)
    one, other = tmp_path / "one.rrd", tmp_path / "größe?.html"
    one.write_bytes(b"one")
    other.write_bytes(b"<script>alert(1)</script>")
    first, second = downloads.address(one), downloads.address(other, "text/html", download=True)
    assert first == downloads.address(one) != downloads.address(one, "text/plain") and first.endswith(
        "/one.rrd"
    )
    status, headers, body = ask(gated_server, first)
    assert (status, body, headers["Content-Type"]) == (200, b"one", "application/octet-stream")
    assert "Content-Disposition" not in headers and "sandbox" in headers["Content-Security-Policy"]
    status, headers, body = ask(gated_server, second)
    assert (status, body) == (200, other.read_bytes())
    assert "attachment" in headers["Content-Disposition"] and "sandbox" in headers["Content-Security-Policy"]
    routes: list[Any] = []
    elsewhere = Downloads(lambda *route: routes.append(route)).address(one)
    for address in (elsewhere, f"/offered/{one}", "/offered/", "/offered/x/one.rrd"):
        assert ask(gated_server, address)[0] == 404, "nobody can guess an address"
    one.write_bytes(b"changed")
    assert ask(gated_server, first)[2] == b"changed"
    one.unlink()
    assert ask(gated_server, first)[0] == 404

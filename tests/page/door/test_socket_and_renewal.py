"""A page on a Unix socket, and a token that is renewed while pages are open."""

from __future__ import annotations

import http.client
import os
import shutil
import signal
import socket
import stat
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import unix_connect

from tests.drive.knocking import (
    CAMERA,
    PROTOCOL,
    Bell,
    ask,
    both,
    client,
    close_code,
    cookie_of,
    say,
    token_of,
)
from tests.drive.tabs import open_deaf_tab
from tests.drive.waiting import until
from workbench.machine.processes.child_environment import child_environment, python_command
from workbench.page.door import listening_socket as listening
from workbench.page.door.access import cookie_name
from workbench.page.door.gated_server import GatedServer, ServerOptions, open_server
from workbench.page.door.listening_socket import ServerError


@pytest.fixture
def folder() -> Iterator[Path]:
    # A socket path must be short, and pytest's are long.
    folder = Path(tempfile.mkdtemp(prefix="wb-"))
    yield folder
    shutil.rmtree(folder)


@pytest.fixture
def gated_server(folder: Path) -> Iterator[GatedServer]:
    gated_server = open_server(ServerOptions(socket=folder / "page.sock"))
    yield gated_server
    gated_server.close()


def get(gated_server: GatedServer, path: str = "/", host: str = "localhost:8080", **headers: str) -> int:
    assert gated_server.options.socket is not None
    connection = http.client.HTTPConnection(host, timeout=20)
    connection.sock = socket.socket(socket.AF_UNIX)
    connection.sock.settimeout(20)
    connection.sock.connect(str(gated_server.options.socket))
    try:
        connection.request("GET", path, headers=headers)
        return connection.getresponse().status
    finally:
        connection.close()


def listening_ports() -> set[int]:
    own = psutil.Process().net_connections(kind="tcp")
    return {one.laddr.port for one in own if one.status == psutil.CONN_LISTEN}


@pytest.fixture
def before() -> set[int]:
    """Listening ports that other tests of this process left open."""
    return listening_ports()


def test_only_the_owner_can_connect_and_no_port_is_open(before, gated_server, folder):
    found = (folder / "page.sock").lstat()
    assert stat.S_ISSOCK(found.st_mode) and stat.S_IMODE(found.st_mode) == 0o600
    assert listening_ports() <= before
    assert f"-L 8080:{folder.resolve() / 'page.sock'} " in gated_server.ssh_hint


def test_the_gate_is_the_same_as_on_a_port(gated_server):
    cookie = f"{cookie_name(8080)}={token_of(gated_server)}"
    assert get(gated_server) == 403
    assert get(gated_server, f"/?token={token_of(gated_server)}") == 303
    assert get(gated_server, Cookie=cookie) == 200
    assert get(gated_server, Cookie=cookie, Origin="https://evil.example") == 403
    assert get(gated_server, host="evil.example", Cookie=cookie) == 403
    # A different port at the other end of ssh -L.
    assert (
        get(gated_server, host="localhost:9000", Cookie=f"{cookie_name(9000)}={token_of(gated_server)}")
        == 200
    )


def test_a_websocket_works_over_it(gated_server):
    bell = Bell(gated_server)
    with unix_connect(
        str(gated_server.options.socket),
        uri="ws://localhost:8080/",
        subprotocols=[PROTOCOL],  # type: ignore[list-item]
        origin="http://localhost:8080",  # type: ignore[arg-type]
        additional_headers={"Cookie": f"{cookie_name(8080)}={token_of(gated_server)}"},
        max_size=None,
        close_timeout=0.2,
    ) as connection:
        say(connection, CAMERA)  # without a camera message viser counts no page as connected
        bell.rings(connection)


def test_the_socket_file_is_removed_at_the_end_and_a_stale_one_replaced(folder):
    place = folder / "page.sock"
    left = socket.socket(socket.AF_UNIX)
    left.bind(str(place))
    left.close()
    assert place.exists()
    gated_server = open_server(ServerOptions(socket=place))
    assert get(gated_server) == 403
    gated_server.close()
    assert not place.exists()


def test_a_file_that_is_not_ours_is_left_alone(folder):
    place = folder / "page.sock"
    (folder / "target").write_text("kept")
    for make in (
        lambda: place.write_text("a file"),
        lambda: place.symlink_to(folder / "target"),
        lambda: place.mkdir(),
        lambda: os.mkfifo(place),
    ):
        make()
        with pytest.raises(ServerError, match="not a socket of yours"):
            open_server(ServerOptions(socket=place))
        assert os.path.lexists(place)
        place.rmdir() if place.is_dir() else place.unlink()
    assert (folder / "target").read_text() == "kept"


def test_a_socket_that_another_program_listens_on_is_left_alone(gated_server, folder):
    with pytest.raises(ServerError, match="Another program is listening"):
        open_server(ServerOptions(socket=folder / "page.sock"))
    assert get(gated_server) == 403


def test_a_socket_that_was_replaced_is_not_removed(folder):
    place = folder / "page.sock"
    gated_server = open_server(ServerOptions(socket=place))
    place.unlink()
    place.write_text("somebody else's")
    gated_server.close()
    assert place.read_text() == "somebody else's"


def test_a_folder_writable_by_others_is_refused(folder):
    folder.chmod(0o777)
    with pytest.raises(ServerError, match="Others can write into"):
        open_server(ServerOptions(socket=folder / "page.sock"))
    folder.chmod(0o1777)  # as /tmp: files there stay their owner's
    open_server(ServerOptions(socket=folder / "page.sock")).close()


def test_only_one_of_many_concurrent_starts_succeeds(folder):
    made: list[listening.Listening] = []

    def start() -> None:
        try:
            made.append(listening.listen_on_file(folder / "page.sock", 0))
        except ServerError:
            pass

    threads = [threading.Thread(target=start) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (only,) = made
    only.connect(timeout=10).close()
    only.socket.close()


# Renewal -----------------------------------------------------------------------------------------


@pytest.fixture
def on_port() -> Iterator[GatedServer]:
    gated_server = open_server(ServerOptions(port=0))
    yield gated_server
    gated_server.close()


def test_a_renewed_token_locks_out_holders_of_the_old_one(on_port):
    old_url, old_cookie, old_token = on_port.url, cookie_of(on_port), token_of(on_port)
    with client(on_port) as one, client(on_port) as two:
        assert on_port.renew_token() == on_port.url != old_url
        assert close_code(one) == close_code(two) == 1008
    assert both(on_port, Cookie=old_cookie) == (403, 403)
    assert ask(on_port, f"/?token={old_token}", Cookie=None)[0] == 403
    assert ask(on_port, f"/?token={token_of(on_port)}", Cookie=None)[0] == 303
    assert both(on_port) == (200, 101)
    assert on_port.addresses("/x/") == (f"http://127.0.0.1:{on_port.port}/x/?token={token_of(on_port)}",)


def test_renewing_the_token_cuts_off_a_response_in_progress(on_port):
    begun, go_on = threading.Event(), threading.Event()

    def slow(path: str, query: object) -> tuple[int, str, bytes]:
        begun.set()
        go_on.wait(30)
        return 200, "text/plain", b"secret"

    on_port.add_route("/slow/", slow)
    got: list[object] = []

    def fetch() -> None:
        try:
            got.append(ask(on_port, "/slow/x")[2])
        except (http.client.HTTPException, OSError) as error:
            got.append(error)

    thread = threading.Thread(target=fetch)
    thread.start()
    assert begun.wait(30)
    on_port.renew_token()
    thread.join(30)
    go_on.set()
    assert len(got) == 1 and isinstance(got[0], ConnectionError), "it is cut off, not timed out"


def test_a_page_that_does_not_read_is_closed_too(on_port):
    tab = open_deaf_tab(on_port.url)
    until(on_port.server.get_clients, "the page")
    on_port.renew_token()
    until(lambda: not on_port.server.get_clients(), "the end of the page")
    with pytest.raises(ConnectionClosed):
        while True:
            tab.recv(timeout=30)


def until_line(process: subprocess.Popen[str], wanted: Callable[[str], bool]) -> str:
    assert process.stdout is not None
    for line in process.stdout:
        if wanted(line):
            return line
    pytest.fail("the command ended without the expected line")


@pytest.mark.slow
def test_one_signal_renews_the_token_and_another_ends_the_command(child_process: None, tmp_path, folder):
    place = folder / "review.sock"
    process = subprocess.Popen(
        [*python_command("-m", "workbench.cli.main"), "review", str(tmp_path), "--socket", str(place)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=child_environment(),
    )
    try:
        first = until_line(process, lambda line: line.startswith("  page"))
        until_line(process, lambda line: "Ctrl-C" in line)
        process.send_signal(signal.SIGUSR1)
        second = until_line(process, lambda line: line.startswith("  page"))
        assert "?token=" in first and "?token=" in second and first != second
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
        assert not place.exists()
    finally:
        process.kill()
        process.communicate()

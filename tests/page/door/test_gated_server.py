"""The door for legitimate users: where it listens, what it prints and what it serves."""

from __future__ import annotations

import base64
import hashlib
import os
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import psutil
import pytest
import viser
import viser._icons
import viser._messages
import viser.infra._infra

from tests.drive.knocking import ask, token_of
from workbench.cli.output import print_addresses
from workbench.page.door import gated_server as door_module
from workbench.page.door import listening_socket as listening
from workbench.page.door import viser_private
from workbench.page.door.gated_server import ServerOptions, open_server
from workbench.page.door.listening_socket import ServerError


def listening_addresses(port: int) -> set[str]:
    return {
        connection.laddr.ip
        for connection in psutil.Process().net_connections(kind="tcp")
        if connection.status == psutil.CONN_LISTEN and connection.laddr.port == port
    }


@pytest.fixture
def taken_port() -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        yield taken.getsockname()[1]


@pytest.mark.parametrize("options", [ServerOptions(port=0), ServerOptions(host="LocalHost", port=0)])
def test_it_listens_on_loopback_only_unless_told_otherwise(options):
    with closing(open_server(options)) as gated_server:
        assert listening_addresses(gated_server.port) == {"127.0.0.1"}
        assert gated_server.url.startswith(f"http://127.0.0.1:{gated_server.port}/?token=")
        assert gated_server.warning is None and gated_server.addresses() == (gated_server.url,)


def test_all_interfaces_are_opened_only_with_a_token_and_a_warning(capsys):
    with closing(open_server(ServerOptions(host="0.0.0.0", port=0))) as gated_server:
        assert listening_addresses(gated_server.port) == {"0.0.0.0"}
        assert gated_server.warning is not None and "0.0.0.0" in gated_server.warning
        assert "0.0.0.0" not in gated_server.url  # no browser can open that
        assert any(url.startswith("http://127.0.0.1:") for url in gated_server.addresses())  # for a container
        assert len(token_of(gated_server)) >= 43  # 256 bits
        # Without a network the page's own address is useless to other machines.
        own = [address for host in psutil.net_if_addrs().values() for address in host]
        reach = [a.address for a in own if a.family == socket.AF_INET and not a.address.startswith("127.")]
        hosts = {url.removeprefix("http://").partition(":")[0] for url in gated_server.addresses()} - {
            "127.0.0.1"
        }
        assert {socket.gethostname(), *reach} - {"localhost"} >= hosts and hosts >= {*reach[:1]}
        assert all(
            url.endswith(f":{gated_server.port}/?token={token_of(gated_server)}")
            for url in gated_server.addresses()
        )
        for host in hosts:
            address = f"/?token={token_of(gated_server)}"
            assert ask(gated_server, address, Host=f"{host}:{gated_server.port}", Cookie=None)[0] == 303, host
        print_addresses(gated_server.addresses())
        printed = capsys.readouterr().out.splitlines()
        assert [line.split() for line in printed] == [
            ["or" if i else "page", url] for i, url in enumerate(dict.fromkeys(gated_server.addresses()))
        ]
        gated_server.renew_token()
        assert all(url.endswith(token_of(gated_server)) for url in gated_server.addresses())


def test_the_hint_for_ssh_leads_to_the_listening_port(gated_server):
    port = gated_server.port
    assert f"-L {port}:127.0.0.1:{port} " in gated_server.ssh_hint
    assert gated_server.ssh_hint.endswith(f"@{socket.gethostname()}")


def test_a_route_has_a_prefix_of_its_own_and_a_server_without_a_token_has_none_to_renew(gated_server):
    for prefix in ("recordings/", "/recordings", "/", "//"):
        with pytest.raises(ValueError, match="prefix"):
            gated_server.add_route(prefix, lambda path, query: (200, "text/plain", b"x"))
    gated_server.add_route("/recordings/", lambda path, query: (200, "text/plain", b"x"))
    with pytest.raises(ValueError, match="/recordings/"):
        gated_server.add_route("/recordings/", lambda path, query: (200, "text/plain", b"y"))
    assert ask(gated_server, "/recordings/a")[2] == b"x"
    with closing(open_server(ServerOptions(port=0, token=False))) as open_to_all:
        assert "token" not in open_to_all.url and ask(open_to_all, "/")[0] == 200
        with pytest.raises(ValueError, match="no token"):
            open_to_all.renew_token()


def test_tabs_are_renamed_and_listed_with_their_folds(server: viser.ViserServer) -> None:
    group = server.gui.add_tab_group()
    run, cameras = group.add_tab("Run"), group.add_tab("Cameras")
    with run, server.gui.add_folder("Speed"), server.gui.add_folder("More"):
        pass
    server.gui.add_folder("Apart")
    viser_private.set_tab_label(cameras, "Studio")
    assert [*viser_private.places(server)] == [
        ("Run", ""),
        ("Studio", ""),
        ("Run", "Speed"),
        ("Run", "More"),
        ("", "Apart"),
    ]


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.7.7", "gpu-server"])
def test_without_a_token_only_loopback_is_allowed(host):
    with pytest.raises(ValueError, match="token"):
        ServerOptions(host=host, token=False)
    assert not any(ServerOptions(host=own, token=False).token for own in ("127.3.4.5", "localhost", "::1"))


@pytest.mark.parametrize(
    "options",
    [
        {"host": ""},
        {"port": -1},
        {"port": 65536},
        {"socket": Path("x"), "token": False},
        {"socket": Path("x"), "host": "0.0.0.0"},
    ],
)
def test_invalid_options_are_refused(options):
    with pytest.raises(ValueError):
        ServerOptions(**options)
    assert ServerOptions(port=65535).port == 65535


def test_a_requested_port_that_is_taken_is_an_error_with_advice(taken_port):
    with pytest.raises(ServerError, match=f"Port {taken_port} is taken.*--port"):
        open_server(ServerOptions(port=taken_port))


def test_a_taken_default_port_is_replaced_with_a_notice(taken_port, monkeypatch):
    # 8080 itself may be in use on the test machine.
    monkeypatch.setattr(listening, "DEFAULT_PORT", taken_port)
    with closing(open_server(ServerOptions(port=taken_port))) as gated_server:
        assert gated_server.port != taken_port and f":{gated_server.port}/" in gated_server.url
        assert listening_addresses(gated_server.port) == {"127.0.0.1"}
        notice = gated_server.notice
        assert notice is not None and str(taken_port) in notice and str(gated_server.port) in notice


def test_closing_frees_the_port_and_ends_the_thread(gated_server):
    thread = gated_server.server._websock_server._server_thread
    # As Chromium keeps them: no request yet.
    idle = socket.create_connection(("127.0.0.1", gated_server.port))
    assert ask(gated_server, "/")[0] == 200
    gated_server.close()
    gated_server.close()
    assert not thread.is_alive()
    assert listening_addresses(gated_server.port) == set()
    idle.close()
    socket.create_server(("127.0.0.1", gated_server.port)).close()


SERVED = """
import os
before = dict(os.environ)
import numpy as np
from workbench.page.door.gated_server import ServerOptions, open_server
door = open_server(ServerOptions(port=0))
door.server.gui.add_image(np.zeros((8, 8, 3), np.uint8))
import rich
rich.print({name: value for name, value in os.environ.items() if before.get(name) != value})
"""


def test_only_the_workbench_prints_and_a_picture_does_not_change_the_environment(child_process: None) -> None:
    """Includes output at exit. Child processes inherit the environment: OpenCV adds the current folder to the library path,
    and that may be a folder of downloaded recordings."""
    environment = {name: value for name, value in os.environ.items() if name != "LD_LIBRARY_PATH"}
    done = subprocess.run(
        [sys.executable, "-c", SERVED], capture_output=True, text=True, timeout=120, env=environment
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "{}\n", "")


def test_viser_has_every_private_name_that_we_use(gated_server):
    assert viser_private.missing_names() == []
    for name in viser_private.PRIVATE_ATTRIBUTES:
        here = gated_server.server
        for part in name.split("."):
            here = getattr(here, part)


def test_a_viser_without_a_private_name_starts_no_server(monkeypatch):
    before = threading.active_count()
    monkeypatch.delattr(viser._messages, "ShareUrlRequest")
    with pytest.raises(ServerError, match=r"ShareUrlRequest.*viser==\d"):
        open_server(ServerOptions(port=0))
    assert threading.active_count() == before


def test_the_scripts_of_the_installed_page_are_the_known_ones() -> None:
    page = Path(viser.__file__).parent / "client" / "build" / "index.html"
    first, _ = viser_private.page_scripts() or ("", "")
    inline = re.findall(r"<script[^>]*>(.+?)</script>", page.read_text(), re.S)
    hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in inline]
    assert first.removeprefix("sha256-") in hashes


def test_a_viser_that_starts_its_server_differently_starts_no_server(monkeypatch):
    worker = viser.infra._infra.WebsockServer._background_worker

    def as_a_later_viser_might(self, ready):
        import websockets

        # Not with monkeypatch, which would restore our replacement module at the end, permanently.
        viser.infra._infra.websockets = websockets  # pyright: ignore[reportPrivateImportUsage]
        worker(self, ready)

    monkeypatch.setattr(viser.infra._infra.WebsockServer, "_background_worker", as_a_later_viser_might)
    with pytest.raises(ServerError, match="viser did not start its server"):
        open_server(ServerOptions(port=0))


def test_no_server_starts_if_its_gate_is_not_in_effect(monkeypatch):
    monkeypatch.setattr(
        door_module.access, "decide", lambda rules, asked: door_module.access.Admitted(asked.host[0])
    )
    with pytest.raises(ServerError, match="is not protected"):
        open_server(ServerOptions(port=0))

"""The attacker's side of the door, over real sockets on loopback and from a real browser."""

from __future__ import annotations

import contextlib
import http.client
import http.server
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from urllib.parse import quote

import msgspec
import psutil
import pytest
import viser
import viser._messages
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.drive.knocking import (
    CAMERA,
    PROTOCOL,
    Bell,
    ask,
    both,
    client,
    close_code,
    cookie_of,
    knock,
    say,
    token_of,
)
from tests.drive.messages import ANY_VALUE
from tests.drive.page import page_at
from tests.drive.waiting import until
from workbench.page.door import responses, viser_private
from workbench.page.door.access import (
    AccessRules,
    Admitted,
    Entered,
    RefusedRequest,
    RequestParts,
    cookie_name,
    decide,
)
from workbench.page.door.client_messages import KINDS, MAX_BYTES, MalformedMessage
from workbench.page.door.connection_limits import RateLimitedLog
from workbench.page.door.gated_server import GatedServer, ServerOptions, open_server
from workbench.page.door.message_filter import PageGuard

pytestmark = pytest.mark.thorough

# A slow example on a busy machine is not a failure, and all examples share one server.
with_fixtures = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])

LOADED_BY = {"Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "script"}


@pytest.fixture(scope="module")
def gated_server() -> Iterator[GatedServer]:
    """One server for all tests of this file."""
    with closing(open_server(ServerOptions(port=0))) as gated_server:
        yield gated_server


@pytest.fixture
def bystander(gated_server: GatedServer) -> Iterator[Callable[[], None]]:
    """A legitimate client that connected earlier; call it to check that it still works."""
    bell = Bell(gated_server)
    with client(gated_server) as connection:
        bell.rings(connection)
        yield lambda: bell.rings(connection)
    bell.remove()


# The gate ----------------------------------------------------------------------------------------


def test_a_legitimate_page_is_let_in(gated_server):
    assert both(gated_server) == (200, 101)
    assert both(gated_server, Sec_Fetch_Site="same-origin") == (200, 101)
    assert ask(gated_server, Sec_Fetch_Site="none")[0] == 200


ORIGINS = [
    "https://evil.example",
    "http://evil.example:{port}",
    "null",
    "",
    "http://127.0.0.1",
    "http://127.0.0.1:3000",
    "http://localhost:{port}",  # for a browser a different origin than the Host
    "http://127.0.0.1:{port}.evil.example",
    "http://127.0.0.1:{port}@evil.example",
    "http://evil.example#127.0.0.1:{port}",
    "file://",
    "chrome-extension://127.0.0.1:{port}",
]


def test_a_page_of_another_origin_is_refused_even_with_the_cookie(gated_server):
    for origin in ORIGINS:
        assert both(gated_server, Origin=origin.format(port=gated_server.port)) == (403, 403)


HOSTS = [
    "evil.example",
    "evil.example:{port}",
    "127.0.0.1.nip.io:{port}",
    "localhost.evil.example:{port}",
    "127.0.0.1:{port}.evil.example",
    "127.0.0.1:{port}@evil.example",
    "evil.example@127.0.0.1:{port}",
    "192.168.1.5:{port}",
    "0.0.0.0:{port}",
    "",
    None,
]


def test_a_rebound_host_is_refused_even_with_the_token(gated_server):
    for host in HOSTS:
        host = host and host.format(port=gated_server.port)
        origin = f"http://{host}"  # to the browser a rebound page is same-origin with its own name
        assert both(gated_server, Host=host, Origin=origin) == (403, 403)
        assert ask(gated_server, f"/?token={token_of(gated_server)}", Host=host)[0] == 403


@pytest.mark.parametrize(
    "headers",
    [
        "Host: {ours}\r\nHost: evil.example",
        "Host: {ours}\r\nOrigin: http://{ours}\r\nOrigin: https://evil.example",
    ],
    ids=["hosts", "origins"],
)
def test_two_hosts_or_two_origins_are_refused(gated_server, headers):
    headers = headers.format(ours=f"127.0.0.1:{gated_server.port}")
    request = f"GET / HTTP/1.1\r\n{headers}\r\nCookie: {cookie_of(gated_server)}\r\n\r\n"
    with socket.create_connection(("127.0.0.1", gated_server.port), timeout=20) as raw:
        raw.sendall(request.encode())
        assert raw.recv(12) == b"HTTP/1.1 403"


def test_without_the_token_nothing_is_served(gated_server):
    for path in ("/", "/index.html", "/workbench/logo.svg", "/no-such-file", "/?token="):
        assert ask(gated_server, path, Cookie=None)[0] == 403, path
    assert knock(gated_server, Cookie=None) == 403


@pytest.mark.parametrize(
    "change", [str.lower, lambda t: t[:-1], lambda t: t + "A", lambda t: "", lambda t: "é" + t]
)
def test_a_wrong_token_is_refused_wherever_it_is_sent(gated_server, change):
    wrong = change(token_of(gated_server))
    status, headers, _ = ask(gated_server, f"/?token={quote(wrong)}", Cookie=None)
    assert status == 403
    assert "Set-Cookie" not in headers
    assert both(gated_server, Cookie=f"{cookie_name(gated_server.port)}={wrong.replace('é', 'e')}") == (
        403,
        403,
    )


def test_the_right_token_becomes_a_cookie_and_is_removed_from_the_address(gated_server):
    status, headers, body = ask(gated_server, f"/some/page?token={token_of(gated_server)}&x=1", Cookie=None)
    assert (status, headers["Location"], body) == (303, "/some/page?x=1", b"")
    assert headers["Cache-Control"] == "no-store"
    cookie = headers["Set-Cookie"]
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} <= set(cookie.split("; "))
    assert both(gated_server, Cookie=cookie.partition(";")[0]) == (200, 101)


def test_the_cookie_of_another_ports_workbench_is_refused(gated_server):
    with closing(open_server(ServerOptions(port=0))) as other:
        assert both(gated_server, Cookie=cookie_of(other)) == (403, 403)
        assert both(gated_server, Cookie=f"{cookie_name(gated_server.port)}={token_of(other)}") == (403, 403)
        assert both(gated_server, Cookie=f"{cookie_name(other.port)}={token_of(gated_server)}") == (403, 403)
        # A browser that is logged in to both sends both cookies, in any order.
        assert both(gated_server, Cookie=f"{cookie_of(other)}; {cookie_of(gated_server)}") == (200, 101)
        assert both(other, Cookie=f"{cookie_of(other)}; {cookie_of(gated_server)}") == (200, 101)


PATHS = [
    "/workbench/../../../../etc/passwd",
    "/workbench/%2e%2e/%2e%2e/pyproject.toml",
    "/workbench/%2e%2e%2f%2e%2e%2fpyproject.toml",
    "/workbench/..%5cpyproject.toml",
    "/workbench/..\\pyproject.toml",
    "/workbench/%252e%252e/pyproject.toml",
    "/workbench//etc/passwd",
    "/workbench/%2fetc%2fpasswd",
    "/workbench/logo.svg%00.html",
    "/workbench/../pyproject.toml",
    "/workbench/panels/../../pyproject.toml",
    "/workbench/",
    "/workbench/panels",
    "/../../../etc/passwd",
    "/%2e%2e/%2e%2e/version.py",
    "/..\\..\\version.py",
    "//etc/passwd",
]


def test_no_path_leads_out_of_the_served_folders(gated_server):
    for path in PATHS:
        status, _, body = ask(gated_server, path)
        assert status == 404, path
        assert b"root:" not in body and b"[project]" not in body and b"version" not in body


hosts = st.from_regex(r"[A-Za-z0-9.:@\[\]/\\_-]{0,30}", fullmatch=True)


@with_fixtures
@given(host=st.one_of(hosts, st.text(max_size=30)), path=st.text(max_size=40), cookie=st.text(max_size=40))
def test_no_request_gets_in_without_the_token_and_none_raises(host, path, cookie):
    rules = AccessRules(token="x" * 43, any_address=True)
    for websocket in (False, True):
        asked = RequestParts(
            path=path, host=[host], origin=[f"http://{host}"], cookie=[cookie], websocket=websocket
        )
        assert isinstance(decide(rules, asked), RefusedRequest)


@with_fixtures
@given(hosts)
def test_without_a_token_only_loopback_hosts_are_let_in(host):
    decision = decide(AccessRules(token=None), RequestParts(path="/", host=[host]))
    name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
    loopback = name.lower() == "localhost" or name.startswith(("127.", "["))
    assert isinstance(decision, RefusedRequest) or loopback


@with_fixtures
@given(st.text(max_size=60))
def test_the_right_token_always_redirects_to_a_path_of_ours(path):
    rules = AccessRules(token="right")
    decision = decide(rules, RequestParts(path=f"{path}?token=right", host=["localhost:8080"]))
    if isinstance(decision, Entered):
        assert decision.location.startswith("/")
        assert decision.location[1:2] not in ("/", "\\")
        assert decision.location.isascii() and decision.location.isprintable()
        assert "token=right" not in decision.location


def test_a_page_without_a_token_still_refuses_foreign_pages_and_rebound_names():
    with closing(open_server(ServerOptions(port=0, token=False))) as gated_server:
        assert both(gated_server, Cookie=None) == (200, 101)
        assert both(gated_server, Cookie=None, Origin="https://evil.example") == (403, 403)
        assert both(gated_server, Cookie=None, Host="evil.example", Origin="http://evil.example") == (
            403,
            403,
        )
        assert ask(gated_server, Cookie=None, Sec_Fetch_Site="cross-site", **LOADED_BY)[0] == 403
        assert isinstance(
            decide(AccessRules(token=None), RequestParts("/", [f"localhost:{gated_server.port}"])), Admitted
        )


def test_a_server_on_all_addresses_accepts_its_addresses_and_no_foreign_name():
    with closing(open_server(ServerOptions(host="0.0.0.0", port=0))) as gated_server:
        for host in ("192.168.1.5", socket.gethostname().lower(), "localhost", "evil.example"):
            place, let_in = f"{host}:{gated_server.port}", host != "evil.example"
            asked = both(gated_server, Host=place, Origin=f"http://{place}")
            assert asked == ((200, 101) if let_in else (403, 403)), host
            assert ask(gated_server, Host=place, Cookie=None)[0] == 403


# Past the gate: what an authenticated client may send ----------------------------------------------


def test_no_client_can_open_the_share_tunnel(gated_server, bystander, caplog):
    process = psutil.Process()
    children = set(process.children())
    threads = {thread.name for thread in threading.enumerate() if "unnel" in thread.name}
    assert not set(viser_private.REFUSED_FROM_CLIENTS) & set(KINDS)
    for name in viser_private.REFUSED_FROM_CLIENTS:
        assert getattr(viser._messages, name) not in gated_server.server._websock_server._incoming_handlers
    with client(gated_server) as connection:
        say(connection, {"type": "ShareUrlRequest"})
        say(connection, {"type": "ShareUrlDisconnect"})
        Bell(gated_server).rings(connection)  # the same connection stays open, and has been read up to here
    bystander()
    assert gated_server.server._share_tunnel is None
    assert set(process.children()) <= children
    assert {thread.name for thread in threading.enumerate() if "unnel" in thread.name} == threads
    assert not [
        link
        for link in process.net_connections(kind="inet")
        if link.raddr and not link.raddr.ip.startswith("127.") and link.raddr.ip != "::1"
    ]
    assert "ShareUrlRequest" in caplog.text


def test_no_client_can_upload(gated_server, bystander):
    upload = gated_server.server.gui.add_upload_button("upload")
    known = {"source_component_uuid": upload._impl.uuid, "transfer_uuid": "t"}
    file = {"filename": "../../etc/passwd", "mime_type": "text/plain", "part_count": 2, "size_bytes": 2**40}
    with client(gated_server) as connection:
        say(connection, {"type": "FileTransferStartUpload", **known, **file})
        say(connection, {"type": "FileTransferPart", **known, "part_index": 0, "content": b"x" * 1000})
        Bell(gated_server).rings(connection)
    assert gated_server.server.gui._current_file_upload_states == {}
    upload.remove()
    bystander()


def test_messages_that_our_pages_never_send_change_nothing(gated_server, bystander):
    """Our pages have no inputs of viser's: viser would set any attribute of one and store any value."""
    slider = gated_server.server.gui.add_slider("x", 0.0, 10.0, 0.1, 5.0)
    with client(gated_server) as connection:
        for prop in ("value", "removed", "is_button", "update_cb", "uuid", "props", "__class__", "no_such"):
            say(connection, {"type": "GuiUpdateMessage", "uuid": slider._impl.uuid, "updates": {prop: 7.0}})
        say(connection, {"type": "GuiFormSubmitMessage", "uuid": slider._impl.uuid})
        say(
            connection, {"type": "RunJavascriptMessage", "source": "alert(1)"}
        )  # only the server may send that
        Bell(gated_server).rings(connection)
    assert slider.value == 5.0 and not slider._impl.removed and callable(slider.on_update)
    slider.remove()
    bystander()


def packed(**message: object) -> bytes:
    return msgspec.msgpack.encode(message)


MALFORMED = [
    *("a text frame", b"", b"\xc1garbage", bytes(range(256)), msgspec.msgpack.encode([1, 2, 3])),
    *(packed(), packed(type=7), packed(type=["GuiUpdateMessage"]), packed(type="NoSuchMessage"), packed(type="np")),
    packed(**{name: value for name, value in CAMERA.items() if name != "position"}),
    *(packed(**{**CAMERA, "position": value}) for value in ((1.0, 2.0), "abc", 5)),
    *(packed(**CAMERA, surplus=1), packed(**{**CAMERA, "fov": "wide"})),
    b"\x82\xa4type\xb3ViewerCameraMessage\xa3fov\xcb\x7f\xf8" + b"\0" * 6,  # truncated
    b"\x91" * 100_000,  # nested deeper than the stack
]  # fmt: skip


def test_a_malformed_frame_closes_its_own_connection_only(gated_server, bystander, capfd):
    for frame in (*MALFORMED, b"x" * (MAX_BYTES + 1)):
        with client(gated_server) as connection:
            connection.send(frame)
            assert close_code(connection) == (1009 if len(frame) > MAX_BYTES else 1008), frame[:40]
    bystander()
    with client(gated_server):  # and a new client still gets in
        pass
    # No traceback of an attacker's message may reach the author's terminal.
    assert "Traceback" not in capfd.readouterr().err


@with_fixtures
@given(ANY_VALUE, st.sampled_from(sorted(KINDS)), st.data())
def test_any_message_is_admitted_dropped_or_malformed(value, kind, data):
    fields = data.draw(st.lists(st.sampled_from(KINDS[kind].__struct_fields__), max_size=9))
    check(msgspec.msgpack.encode({"type": kind, **dict.fromkeys(fields, value)}))


@with_fixtures
@given(st.binary(max_size=200))
def test_any_bytes_are_admitted_dropped_or_malformed(raw):
    check(raw)


def check(raw: bytes) -> None:
    """Check a frame with a page guard without a connection; any unexpected error fails the test."""
    guard = PageGuard(lambda kind: False, RateLimitedLog(lambda line: None))
    with contextlib.suppress(MalformedMessage):
        assert guard.admits(raw) in (True, False)


INPUTS = {"GuiUpdateMessage", "GuiFormDirtyMessage", "GuiFormSubmitMessage"}
"""viser's messages about inputs, which our pages do not have."""


def test_viser_handles_only_known_message_types(gated_server, bystander):
    """A message type that a viser upgrade adds must be reviewed before clients may send it."""
    handled = {kind.__name__ for kind in gated_server.server._websock_server._incoming_handlers}
    for one in gated_server.server.get_clients().values():
        handled |= {kind.__name__ for kind in one._websock_connection._incoming_handlers}
    assert handled - set(viser_private.REFUSED_FROM_CLIENTS) <= set(KINDS) | INPUTS
    assert len(handled) > 5


# From a real browser ------------------------------------------------------------------------------


@contextlib.contextmanager
def hostile_site(html: str, handshakes: list[str] | None = None) -> Iterator[int]:
    """A web server on another local port, which serves ``html`` and records websocket handshakes."""

    class Site(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if "Upgrade" in self.headers and handshakes is not None:
                handshakes.append(self.path)
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(html.encode())

        def log_message(self, *_: object) -> None:
            pass

    site = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Site)
    thread = threading.Thread(target=site.serve_forever, daemon=True)
    thread.start()
    try:
        yield site.server_port
    finally:
        site.shutdown()
        site.server_close()
        thread.join()


@pytest.mark.slow
@pytest.mark.browser
def test_a_link_cannot_send_our_page_to_another_server(gated_server, browser, monkeypatch):
    """viser reads ``?websocket=``: code from such a server would run as our page, with our cookie."""
    came: list[str] = []
    later: list[str] = []
    with (
        # A new page for each try: requests of the first may arrive late.
        hostile_site("", came) as first,
        hostile_site("", later) as second,
        page_at(browser, "about:blank", 640, 480) as (page, _),
    ):
        page.goto(gated_server.url, wait_until="domcontentloaded")
        link = f"http://127.0.0.1:{gated_server.port}/?websocket=ws://127.0.0.1:"
        with monkeypatch.context() as without_policy:
            without_policy.setattr(responses, "page_policy", lambda authority: "frame-ancestors 'self'")
            page.goto(f"{link}{first}", wait_until="domcontentloaded")
            until(lambda: came, "the attack, which works without the policy")
        page.goto("about:blank")
        page.goto(f"{link}{second}", wait_until="domcontentloaded")
        page.wait_for_selector("canvas", timeout=60_000)
        page.wait_for_timeout(
            4000
        )  # it tries once a second, and a request that the policy blocks raises no event
        assert later == []


@pytest.mark.slow
@pytest.mark.browser
def test_pages_of_other_sites_cannot_use_a_logged_in_browser(gated_server, browser):
    """The browser has the cookie. For it ``127.0.0.1`` on another port is the same *site*, so it sends the
    cookie there; ``localhost`` is another site."""
    target = f"127.0.0.1:{gated_server.port}"
    attack = """
        <body><script>
        async function attack() {
          const seen = {};
          seen.socket = await new Promise(done => {
            const socket = new WebSocket("ws://TARGET", "PROTOCOL");
            socket.onopen = () => done("open"); socket.onerror = () => done("refused");
          });
          seen.fetch = await fetch("http://TARGET/", {credentials: "include"}).then(() => "read", () => "refused");
          seen.image = await new Promise(done => {
            const image = new Image(); image.onload = () => done("read"); image.onerror = () => done("refused");
            image.src = "http://TARGET/workbench/logo.svg";
          });
          return seen;
        }
        </script></body>
    """
    attack = attack.replace("TARGET", target).replace("PROTOCOL", PROTOCOL)
    refused = {"socket": "refused", "fetch": "refused", "image": "refused"}
    with hostile_site(attack) as port, page_at(browser, "about:blank", 640, 480) as (page, _):
        page.goto(gated_server.url, wait_until="domcontentloaded")
        until(gated_server.server.get_clients, "the page")
        # The attack itself works: from our own page it succeeds.
        own = page.evaluate(
            "() => {" + attack.partition("<script>")[2].partition("</script>")[0] + "; return attack(); }"
        )
        assert own == {"socket": "open", "fetch": "read", "image": "read"}
        for site in ("127.0.0.1", "localhost"):
            page.goto(f"http://{site}:{port}/", wait_until="domcontentloaded")
            assert page.evaluate("attack()") == refused, site

        # A user who follows a link to the printed address on another site gets in.
        page.context.clear_cookies()
        page.goto(f"http://localhost:{port}/", wait_until="domcontentloaded")
        page.evaluate(
            "address => { const a = document.createElement('a'); a.href = address; a.id = 'go'; a.text = 'go';"
            " document.body.append(a); }",
            gated_server.url,
        )
        page.click("#go")
        page.wait_for_url(f"http://{target}/", wait_until="domcontentloaded")
        page.wait_for_selector("canvas", timeout=60_000)

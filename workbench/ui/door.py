"""The one door: everything that the browser gets comes through one port, past one gate.

viser by itself listens on every interface, knows no token, looks at no Origin, moves to another port
without a word, lets any client publish the page through a tunnel and takes what clients claim as true.
The page it serves runs the author's code. One port also suits the people who work on a server over
ssh: one ``ssh -L`` line carries the page, its websocket, recordings and rerun's viewer.

`open_door` binds the socket itself (so that what is printed is what is bound), hands it to viser
through `workbench.ui.viser_seam`, and puts `workbench.ui.gate` in front of every request and every
websocket handshake. What passes is answered by a route of ours (`Door.add_route`), or by viser.
Before the address is given to anyone the door tries itself with a request that must be refused.
"""

from __future__ import annotations

import asyncio
import atexit
import errno
import getpass
import gzip
import html
import http.client
import ipaddress
import logging
import mimetypes
import secrets
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from urllib.parse import unquote

import viser
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from workbench.ui import gate, viser_seam
from workbench.web_assets import web_assets_folder

DEFAULT_PORT = 8080
PORTS_TO_TRY = 100
MAX_MESSAGE_BYTES = 8 * 1024 * 1024
"""The largest thing that a page sends is a picture of its own view."""
RESPONSE_SECONDS = 300.0
"""`websockets` gives 10 s for a request and its whole answer: too little for viser's page over a slow
line, and far too little for a recording."""

Handler = Callable[[str], tuple[int, str, bytes]]
"""Gets the path behind its prefix (decoded, no query, no ``..``, no backslash, no NUL); returns the
status, the content type and the body. Runs in a thread of its own, so it may read files."""

_log = logging.getLogger("workbench.door")


class DoorError(RuntimeError):
    """The door cannot be opened. The message says what to do."""


@dataclass(frozen=True)
class DoorOptions:
    """Where the page is served, and to whom."""

    host: str = "127.0.0.1"
    """Address or name to listen on. Loopback is for this machine (and ``ssh -L``); ``0.0.0.0`` is for
    everyone who can reach this machine."""
    port: int = DEFAULT_PORT
    """0 takes any free port. If 8080, the default, is taken, the next free one is taken and said."""
    token: bool = True
    """Ask for the token of the printed address. Can be left out on loopback only."""
    names: tuple[str, ...] = ()
    """Further names under which browsers reach this machine (a DNS alias). Its own host name, loopback
    names and, when bound wider than loopback, IP addresses need not be named."""

    def __post_init__(self) -> None:
        if not self.host:
            raise ValueError("The host to listen on is empty; give an address such as 127.0.0.1.")
        if not 0 <= self.port <= 65535:
            raise ValueError(
                f"Port {self.port} does not exist; give one from 1 to 65535, or 0 for any free one."
            )
        if not self.token and not gate.is_loopback(self.host.lower()):
            raise ValueError(
                f"Without a token everyone who can reach {self.host} could run code on this machine through the "
                "page. Leave the token on, or listen on 127.0.0.1 and come in over ssh -L."
            )
        for name in self.names:
            if gate.split_authority(name) is None:
                raise ValueError(f"{name!r} is not a host name; give it without http:// and without a path.")


@dataclass
class Door:
    """An open door. Make it with `open_door`."""

    options: DoorOptions
    server: viser.ViserServer
    port: int
    """The port that is bound."""
    url: str
    """The address to open, with the token."""
    ssh_hint: str
    """What to type on one's own machine to reach the page over ssh."""
    warning: str | None
    """For the person at the terminal: what a wider binding means. None on loopback."""
    notice: str | None
    """Said once at the start: the page is on another port than usual. None if it is not."""
    _gated: viser_seam.GatedViser = field(repr=False)
    _routes: dict[str, tuple[Handler, Mapping[str, str]]] = field(repr=False)
    _closed: bool = field(default=False, repr=False)

    def add_route(self, prefix: str, handler: Handler, headers: Mapping[str, str] | None = None) -> None:
        """Answer GET requests below ``prefix`` (``/recordings/``), behind the same gate. The longest
        prefix that fits wins.

        Args:
            prefix: begins and ends with a slash.
            handler: see `Handler`. If it raises, the browser gets a 500 and the log the traceback.
            headers: added to every reply, in place of the door's own of the same name (a page with
                other needs brings its own Content-Security-Policy).
        """
        if len(prefix) < 3 or not prefix.startswith("/") or not prefix.endswith("/"):
            raise ValueError(
                f"A route's prefix begins and ends with a slash, as in /recordings/; got {prefix!r}."
            )
        if prefix in self._routes:
            raise ValueError(f"There is a route for {prefix} already.")
        self._routes[prefix] = (handler, dict(headers or {}))

    def close(self) -> None:
        """Close every connection and stop listening. Can be called twice."""
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        self._gated.stop()


def open_door(options: DoorOptions = DoorOptions(), label: str | None = None) -> Door:
    """Serve viser's page behind the gate.

    Args:
        options: where, and to whom.
        label: shown at the top of viser's panel.

    Raises:
        DoorError: the host or port cannot be bound, or the installed viser is not one that can be gated.
    """
    listening = _listen(options)
    host, port = listening.getsockname()[:2]
    loopback = ipaddress.ip_address(host.partition("%")[0]).is_loopback
    token = secrets.token_urlsafe(32) if options.token else None
    the_gate = gate.Gate(token=token, names=_our_names(options), any_address=not loopback)
    example = f"http://{_reach(host)}:{port}/" + ("?token=…" if token else "")
    routes: dict[str, tuple[Handler, Mapping[str, str]]] = {}
    refusal_page = _refusal_page(example)

    def wrap(viser_hook: viser_seam.Hook) -> viser_seam.AsyncHook:
        async def answer(connection: ServerConnection, request: Request) -> Response | None:
            asked = _asked(request)
            verdict = gate.judge(the_gate, asked)
            if isinstance(verdict, gate.Admitted):
                if asked.websocket:
                    response = viser_hook(connection, request)
                else:
                    response = await _admitted_reply(
                        routes, viser_hook, connection, request, verdict.authority
                    )
            elif isinstance(verdict, gate.Entered):
                response = _entered_reply(verdict)
            else:
                response = _reply(
                    403, "text/html; charset=utf-8", refusal_page(verdict.reason), _PAGE_OF_OURS
                )
            if response is not None:
                # websockets gives up 10 s after the last byte was handed to the kernel; on a slow line
                # megabytes are still on their way then.
                connection.close_timeout = RESPONSE_SECONDS
            return response

        return answer

    try:
        gated = viser_seam.make_viser(listening, wrap, label, MAX_MESSAGE_BYTES, RESPONSE_SECONDS)
    except viser_seam.SeamError as error:
        raise DoorError(str(error)) from error
    door = Door(
        options=options,
        server=gated.server,
        port=port,
        url=f"http://{_reach(host)}:{port}/" + (f"?token={token}" if token else ""),
        ssh_hint=f"ssh -L {port}:{_reach(host) if loopback else '127.0.0.1'}:{port} {_user()}@{socket.gethostname()}",
        warning=None
        if loopback
        else (
            f"Listening on {options.host}, port {port}: everyone who can reach this machine can try the door, and "
            "the token and everything on the page travel unencrypted. Whoever has the address with the token can "
            "run code here. On a network that you do not trust, listen on 127.0.0.1 and come in over ssh -L."
        ),
        notice=None
        if options.port in (0, port)
        else f"Port {options.port} is taken by another program, so this page is on port {port}.",
        _gated=gated,
        _routes=routes,
    )
    # Before viser's own exit handler, which prints "Server stopped" into the author's terminal.
    atexit.register(door.close)
    try:
        _try_own_door(host, port)
    except BaseException:
        door.close()
        raise
    door.add_route("/workbench/", folder_handler(web_assets_folder()))
    return door


def folder_handler(folder: Path) -> Handler:
    """A handler that serves the files below ``folder``, and nothing that a link there points out to."""
    root = folder.resolve()

    def handle(path: str) -> tuple[int, str, bytes]:
        file = (root / path.lstrip("/")).resolve()
        if not file.is_relative_to(root) or not file.is_file():
            return 404, "text/plain; charset=utf-8", b"There is no such file."
        return 200, content_type(file.name), file.read_bytes()

    return handle


def content_type(name: str) -> str:
    """Content type by the end of a file's name. Not left to the system's table alone, which may call
    JavaScript plain text, and browsers then refuse to run it."""
    known = {
        ".css": "text/css; charset=utf-8",
        ".html": "text/html; charset=utf-8",
        ".js": "text/javascript; charset=utf-8",
        ".json": "application/json",
        ".svg": "image/svg+xml",
        ".wasm": "application/wasm",
    }
    return known.get(Path(name).suffix.lower()) or mimetypes.guess_type(name)[0] or "application/octet-stream"


# Listening ---------------------------------------------------------------------------------------


def _listen(options: DoorOptions) -> socket.socket:
    # "localhost" may be 127.0.0.1, ::1 or both; the printed address has to be the one that is bound.
    host = "127.0.0.1" if options.host.lower() == "localhost" else options.host
    try:
        family, _, _, _, address = socket.getaddrinfo(
            host, options.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (OSError, UnicodeError) as error:
        raise DoorError(
            f"Cannot listen on {options.host}: {error}. Give an address of this machine."
        ) from None
    last = min(options.port + PORTS_TO_TRY, 65536) if options.port == DEFAULT_PORT else options.port + 1
    for port in range(options.port, last):
        try:
            return socket.create_server((address[0], port), family=family, backlog=100)
        except PermissionError:
            raise DoorError(f"Port {port} needs root's rights; give one from 1024 on with --port.") from None
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise DoorError(
                    f"Cannot listen on {options.host}: {error.strerror}. Give an address of this machine."
                ) from None
    if options.port == DEFAULT_PORT:
        raise DoorError(f"Ports {options.port} to {last - 1} are all taken; --port 0 takes any free one.")
    raise DoorError(
        f"Port {options.port} is taken by another program; give another with --port, or 0 for any."
    )


def _our_names(options: DoorOptions) -> frozenset[str]:
    own = socket.gethostname()
    split = (gate.split_authority(name) for name in (options.host, own, f"{own}.local", *options.names))
    return frozenset(name[0] for name in split if name is not None)


def _reach(host: str) -> str:
    """``host`` as a browser needs it: an IPv6 address in brackets, and for "every interface" the
    address of the one that leads out. Connecting a datagram socket sends nothing."""
    address = ipaddress.ip_address(host.partition("%")[0])
    if address.is_unspecified:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect(("192.0.2.1", 9))  # TEST-NET-1, RFC 5737
                return probe.getsockname()[0]
            except OSError:
                return "127.0.0.1"
    return f"[{address}]" if address.version == 6 else str(address)


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container's user without a name
        return "USER"


def _try_own_door(host: str, port: int) -> None:
    """Knock as a rebound name would. The gate hangs on viser's inside; if it hangs loose, nobody gets
    the address."""
    address = ipaddress.ip_address(host.partition("%")[0])
    if address.is_unspecified:
        host = "::1" if address.version == 6 else "127.0.0.1"
    knock = http.client.HTTPConnection(host, port, timeout=10)
    try:
        knock.request("GET", "/", headers={"Host": "rebound.invalid"})
        status = knock.getresponse().status
    finally:
        knock.close()
    if status != 403:
        raise DoorError(
            f"The page's door does not hold: a request that must be refused got {status}. "
            f"It is written for viser {viser_seam.WRITTEN_FOR} and {viser.__version__} is installed; install "
            f"viser=={viser_seam.WRITTEN_FOR}."
        )


# Replies -----------------------------------------------------------------------------------------

_EVERY_REPLY = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "SAMEORIGIN",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Connection": "close",
}
_PAGE_OF_OURS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'self'",
    "Cache-Control": "no-store",
}


def page_policy(authority: str) -> str:
    """Content-Security-Policy for viser's page as seen on ``authority`` (``host:port``).

    viser's page is one file of inline scripts that unpack themselves into blobs, workers and wasm, so
    scripts have to be allowed from those. What the policy is for is ``connect-src``: viser's page takes
    the address of another server from its own address (``?websocket=``, ``?playbackPath=``), and what
    that server sends runs as our page. It also keeps pictures in markdown from calling home.
    """
    return "; ".join(
        (
            "default-src 'self'",
            "script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:",
            "worker-src 'self' blob:",
            "style-src 'self' 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "media-src 'self' data: blob:",
            "font-src 'self' data:",
            f"connect-src 'self' data: blob: ws://{authority} wss://{authority}",
            "frame-src 'self' blob: data:",
            "object-src 'none'",
            "base-uri 'none'",
            "form-action 'self'",
            "frame-ancestors 'self'",
        )
    )


def _asked(request: Request) -> gate.Asked:
    get = request.headers.get_all
    return gate.Asked(
        path=request.path,
        host=get("Host"),
        origin=get("Origin"),
        cookie=get("Cookie"),
        fetch_site=get("Sec-Fetch-Site"),
        fetch_mode=get("Sec-Fetch-Mode"),
        fetch_dest=get("Sec-Fetch-Dest"),
        # Exactly viser's own question, so that what it takes for a handshake is what was judged as one.
        websocket=get("Upgrade") == ["websocket"],
    )


def _refusal_page(example: str) -> Callable[[str], bytes]:
    folder = web_assets_folder()
    page = (folder / "refused.html").read_text(encoding="utf-8")
    page = page.replace("{{logo}}", (folder / "logo.svg").read_text(encoding="utf-8"))
    page = page.replace("{{example}}", html.escape(example))
    return lambda reason: page.replace("{{reason}}", html.escape(reason)).encode()


def _reply(
    status: int, kind: str, body: bytes, headers: Mapping[str, str], gzipped: bool = False
) -> Response:
    extra = {"Content-Encoding": "gzip", "Vary": "Accept-Encoding"} if gzipped else {}
    fields = {"Content-Type": kind, "Content-Length": str(len(body)), **_EVERY_REPLY, **extra, **headers}
    return Response(status, HTTPStatus(status).phrase, Headers(fields), body)


def _entered_reply(entered: gate.Entered) -> Response:
    cookie = {"Set-Cookie": entered.set_cookie, **_PAGE_OF_OURS}
    if not entered.by_page:
        return _reply(303, "text/plain; charset=utf-8", b"", {"Location": entered.location, **cookie})
    onward = f'<!doctype html><title>Workbench</title><meta http-equiv="refresh" content="0;url={html.escape(entered.location)}">'
    return _reply(200, "text/html; charset=utf-8", onward.encode(), cookie)


async def _admitted_reply(
    routes: Mapping[str, tuple[Handler, Mapping[str, str]]],
    viser_hook: viser_seam.Hook,
    connection: ServerConnection,
    request: Request,
    authority: str,
) -> Response:
    page = {"Content-Security-Policy": page_policy(authority), "Cache-Control": "no-cache"}
    # Decoded once, as viser does; what is still encoded after that is part of a file's name.
    path = unquote(request.path.partition("?")[0]).replace("\\", "/")
    prefix = max((prefix for prefix in routes if path.startswith(prefix)), key=len, default=None)
    if prefix is None:
        response = viser_hook(connection, request)
        if response is None:  # viser took for a handshake what was not judged as one
            return _reply(400, "text/plain; charset=utf-8", b"Bad request.", page)
        for name, value in {**_EVERY_REPLY, **page}.items():
            response.headers[name] = value
        return response
    if ".." in path.split("/") or "\0" in path:
        return _reply(404, "text/plain; charset=utf-8", b"There is no such file.", page)
    handler, headers = routes[prefix]
    accepts_gzip = any("gzip" in value for value in request.headers.get_all("Accept-Encoding"))

    def work() -> Response:
        try:
            status, kind, body = handler(path[len(prefix) :])
        except Exception:
            _log.exception("The route %s failed on %s.", prefix, path)
            status, kind, body = 500, "text/plain; charset=utf-8", b"This went wrong; the terminal says how."
        zip_it = accepts_gzip and len(body) > 1024 and _compresses(kind)
        return _reply(status, kind, gzip.compress(body, 6) if zip_it else body, {**page, **headers}, zip_it)

    # In a thread: reading and compressing a recording would hold up every page's websocket.
    return await asyncio.to_thread(work)


def _compresses(kind: str) -> bool:
    plain = kind.partition(";")[0]
    return plain.startswith("text/") or plain in (
        "application/json",
        "application/javascript",
        "application/wasm",
        "image/svg+xml",
    )

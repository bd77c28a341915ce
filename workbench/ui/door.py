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

import atexit
import errno
import getpass
import http.client
import ipaddress
import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field

import viser
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from workbench.ui import gate, viser_seam
from workbench.ui.replies import (
    Handler,
    admitted_reply,
    asked_of,
    entered_reply,
    folder_handler,
    refusals,
)
from workbench.ui.told_rarely import ToldRarely
from workbench.web_assets import web_assets_folder

DEFAULT_PORT = 8080
PORTS_TO_TRY = 100
RESPONSE_SECONDS = 300.0
"""`websockets` gives 10 s for a request and its whole answer: too little for viser's page over a slow
line, and far too little for a recording."""


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
            handler: see `workbench.ui.replies.Handler`. If it raises, the browser gets a 500 and the log the traceback.
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

    def address(self, path: str) -> str:
        """The address to open, with the token, for ``path`` (from the root: ``/rerun/...``) in place of the page."""
        root, _, token = self.url.partition("/?")
        return f"{root}{path}" + (f"?{token}" if token else "")

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
    refuse = refusals(example)

    def wrap(viser_hook: viser_seam.Hook) -> viser_seam.AsyncHook:
        async def answer(connection: ServerConnection, request: Request) -> Response | None:
            asked = asked_of(request)
            verdict = gate.judge(the_gate, asked)
            if isinstance(verdict, gate.Admitted):
                if asked.websocket:
                    response = viser_hook(connection, request)
                else:
                    response = await admitted_reply(
                        routes, viser_hook, connection, request, verdict.authority
                    )
            elif isinstance(verdict, gate.Entered):
                response = entered_reply(verdict)
            else:
                response = refuse(verdict.reason)
            if response is not None:
                # websockets gives up 10 s after the last byte was handed to the kernel; on a slow line
                # megabytes are still on their way then.
                connection.close_timeout = RESPONSE_SECONDS
            return response

        return answer

    try:
        gated = viser_seam.make_viser(listening, wrap, label, RESPONSE_SECONDS, ToldRarely())
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

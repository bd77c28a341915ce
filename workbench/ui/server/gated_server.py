"""The one door: everything that the browser gets comes through one port, past one gate.

viser by itself listens on every interface, knows no token, looks at no Origin, moves to another port
without a word, lets any client publish the page through a tunnel and takes what clients claim as true.
The page it serves runs the author's code. One port also suits the people who work on a server over
ssh: one ``ssh -L`` line carries the page, its websocket, recordings and rerun's viewer.

`open_door` binds the socket itself (so that what is printed is what is bound), hands it to viser
through `workbench.ui.server.viser_private`, and puts `workbench.ui.server.access` in front of every request and every
websocket handshake. What passes is answered by a route of ours (`Door.add_route`), or by viser.
Before the address is given to anyone the door tries itself with a request that must be refused.
"""

from __future__ import annotations

import atexit
import functools
import http.client
import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import viser
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from workbench.machine.web_assets import web_assets_folder
from workbench.ui.server import access, viser_private
from workbench.ui.server.listening import DEFAULT_PORT, DoorError, Listening, listen_on_file, listen_on_port
from workbench.ui.server.responses import (
    Handler,
    admitted_reply,
    asked_of,
    entered_reply,
    folder_handler,
    refusals,
)
from workbench.ui.server.strangers import Connection, ToldRarely, of_peer

RESPONSE_SECONDS = 300.0
"""`websockets` gives 10 s for a request and its whole answer: too little for viser's page over a slow
line, and far too little for a recording."""

TURNED_AWAY = {
    access.Why.NAME: "Turned away a request{} for a host name that is not this machine's.",
    access.Why.SITE: "Turned away a request{} that a page of another site made in a browser.",
    access.Why.NO_TOKEN: "Turned away a request{} that did not show the token.",
    access.Why.OTHER_TOKEN: "Turned away a request{} with a token that is not valid: a page that was open before, perhaps.",
}


@dataclass(frozen=True)
class DoorOptions:
    """Where the page is served, and to whom."""

    host: str = "127.0.0.1"
    """Address or name to listen on. Loopback is for this machine (and ``ssh -L``); ``0.0.0.0`` is for
    everyone who can reach this machine."""
    port: int = DEFAULT_PORT
    """0 takes any free port. If 8080, the default, is taken, the next free one is taken and said."""
    socket: Path | None = None
    """Listen on a Unix socket with this path instead, which only its owner can connect to; `port` is then the
    one at the other end of ``ssh -L``, and `host` is not used."""
    token: bool = True
    """Ask for the token of the printed address. Can be left out on a port of loopback only."""

    def __post_init__(self) -> None:
        if not self.host:
            raise ValueError("The host to listen on is empty; give an address such as 127.0.0.1.")
        if not 0 <= self.port <= 65535:
            raise ValueError(
                f"Port {self.port} does not exist; give one from 1 to 65535, or 0 for any free one."
            )
        if self.socket is not None and self.host != "127.0.0.1":
            raise ValueError("A socket and a host to listen on are two places; give one of them.")
        if self.socket is not None and not self.token:
            raise ValueError(
                "The other end of ssh -L is a port of that machine, to which everyone there can connect. Leave the "
                "token on."
            )
        if not self.token and not access.is_loopback(self.host.lower()):
            raise ValueError(
                f"Without a token everyone who can reach {self.host} could run code on this machine through the "
                "page. Leave the token on, or listen on 127.0.0.1 and come in over ssh -L."
            )


@dataclass
class Door:
    """An open door. Make it with `open_door`."""

    options: DoorOptions
    server: viser.ViserServer
    port: int
    """The port that is bound."""
    ssh_hint: str
    """What to type on one's own machine to reach the page over ssh."""
    warning: str | None
    """For the person at the terminal: what a wider binding means. None on loopback."""
    notice: str | None
    """Said once at the start: the page is on another port than usual. None if it is not."""
    _listening: Listening = field(repr=False)
    _doorkeeper: _Doorkeeper = field(repr=False)
    _gated: viser_private.GatedViser = field(repr=False)
    _routes: dict[str, tuple[Handler, Mapping[str, str]]] = field(repr=False)
    _closed: bool = field(default=False, repr=False)

    @property
    def turned_away(self) -> int:
        """How many requests were refused so far."""
        return self._doorkeeper.turned_away

    def add_route(self, prefix: str, handler: Handler, headers: Mapping[str, str] | None = None) -> None:
        """Answer GET requests below ``prefix`` (``/recordings/``), behind the same gate. The longest
        prefix that fits wins.

        Args:
            prefix: begins and ends with a slash.
            handler: see `workbench.ui.server.responses.Handler`. If it raises, the browser gets a 500 and the log the traceback.
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

    @property
    def url(self) -> str:
        """The address to open, with the token."""
        return self.addresses()[0]

    def addresses(self, path: str = "/") -> tuple[str, ...]:
        """The address to open, with the token, for ``path`` (from the root: ``/rerun/...``), and then those for browsers
        on other machines, none on loopback: which of them leads here depends on the network that the other machine is
        in."""
        token = self._doorkeeper.gate.token
        shown = f"?token={token}" if token else ""
        hosts = dict.fromkeys((self._listening.host, *self._listening.hosts_elsewhere()))
        return tuple(f"http://{host}:{self.port}{path}{shown}" for host in hosts)

    def renew_token(self) -> str:
        """Make a new token and return the new address: who has the old one, or its cookie, does not get in any more,
        and every page that is open is closed. From any thread but the event loop's.

        Raises:
            ValueError: this door asks for no token.
        """
        if not self.options.token:
            raise ValueError("This page asks for no token; there is none to renew.")
        token = secrets.token_urlsafe(32)
        self._doorkeeper.gate = replace(self._doorkeeper.gate, token=token)
        self._gated.close_pages("the token was renewed")
        return self.url

    def close(self) -> None:
        """Close every connection and stop listening. Can be called twice."""
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        self._gated.stop()
        self._listening.remove()
        self._doorkeeper.say_the_rest()


class _Doorkeeper:
    """Judges each request, answers it or has it answered, and tells the terminal of those that are refused."""

    def __init__(self, the_gate: access.Gate, example: str, told: ToldRarely) -> None:
        self.gate = the_gate
        self.turned_away = 0
        self.tells = False
        self._refuse = refusals(example)
        self._told = told

    async def answer(
        self,
        routes: Mapping[str, tuple[Handler, Mapping[str, str]]],
        viser_hook: viser_private.Hook,
        connection: ServerConnection,
        request: Request,
    ) -> Response | None:
        asked = asked_of(request)
        verdict = access.judge(self.gate, asked)
        if isinstance(verdict, access.Refused):
            self._count(verdict, connection)
            return self._refuse(verdict.reason)
        if isinstance(connection, Connection):
            connection.admit()
        if asked.websocket and isinstance(verdict, access.Admitted):
            return viser_hook(connection, request)
        # websockets gives up 10 s after the last byte was handed to the kernel; on a slow line
        # megabytes are still on their way then.
        connection.close_timeout = RESPONSE_SECONDS
        if isinstance(verdict, access.Entered):
            return entered_reply(verdict)
        return await admitted_reply(routes, viser_hook, connection, request, verdict.authority)

    def say_the_rest(self) -> None:
        """At the end: what was not told yet, and how many were turned away in all."""
        self._told.say_the_rest()
        if self.turned_away > 1:
            self._told.happened("total", f"In all {self.turned_away} requests were turned away.")

    def _count(self, refused: access.Refused, connection: ServerConnection) -> None:
        if self.tells:
            self.turned_away += 1
            peer = connection.peer if isinstance(connection, Connection) else ""
            self._told.happened(refused.why, TURNED_AWAY[refused.why].format(of_peer(peer)))


def open_door(options: DoorOptions = DoorOptions(), label: str | None = None) -> Door:
    """Serve viser's page behind the gate.

    Args:
        options: where, and to whom.
        label: shown at the top of viser's panel.

    Raises:
        DoorError: the host or port cannot be bound, or the installed viser is not one that can be gated.
    """
    if options.socket is None:
        listening = listen_on_port(options.host, options.port)
    else:
        listening = listen_on_file(options.socket, options.port)
    token = secrets.token_urlsafe(32) if options.token else None
    the_gate = access.Gate(token=token, names=_our_names(options), any_address=not listening.loopback)
    told = ToldRarely()
    keeper = _Doorkeeper(the_gate, f"http://{listening.authority}/" + ("?token=…" if token else ""), told)
    routes: dict[str, tuple[Handler, Mapping[str, str]]] = {}

    def wrap(viser_hook: viser_private.Hook) -> viser_private.AsyncHook:
        return functools.partial(keeper.answer, routes, viser_hook)

    try:
        gated = viser_private.make_viser(listening.socket, wrap, label, RESPONSE_SECONDS, told)
    except BaseException:
        listening.remove()
        raise
    door = Door(
        options=options,
        server=gated.server,
        port=listening.port,
        ssh_hint=listening.ssh_hint,
        warning=None
        if listening.loopback
        else (
            f"Listening on {options.host}, port {listening.port}: everyone who can reach this machine can try the "
            "door, and the token and everything on the page travel unencrypted. Whoever has the address with the "
            "token can run code here. On a network that you do not trust, listen on 127.0.0.1 and come in over ssh -L."
        ),
        notice=None
        if listening.path is not None or options.port in (0, listening.port)
        else f"Port {options.port} is taken by another program, so this page is on port {listening.port}.",
        _listening=listening,
        _doorkeeper=keeper,
        _gated=gated,
        _routes=routes,
    )
    # Before viser's own exit handler, which prints "Server stopped" into the author's terminal.
    atexit.register(door.close)
    try:
        _try_own_door(listening)
    except BaseException:
        door.close()
        raise
    keeper.tells = True
    door.add_route("/workbench/", folder_handler(web_assets_folder()))
    return door


def _our_names(options: DoorOptions) -> frozenset[str]:
    own = socket.gethostname()
    split = (access.split_authority(name) for name in (options.host, own, f"{own}.local"))
    return frozenset(name[0] for name in split if name is not None)


def _try_own_door(listening: Listening) -> None:
    """Knock as a rebound name would. The gate hangs on viser's inside; if it hangs loose, nobody gets
    the address."""
    knock = http.client.HTTPConnection("rebound.invalid", timeout=10)
    knock.sock = listening.connect(timeout=10)
    try:
        knock.request("GET", "/")
        status = knock.getresponse().status
    finally:
        knock.close()
    if status != 403:
        raise DoorError(
            f"The page's door does not hold: a request that must be refused got {status}. "
            f"It is written for viser {viser_private.WRITTEN_FOR} and {viser.__version__} is installed; install "
            f"viser=={viser_private.WRITTEN_FOR}."
        )

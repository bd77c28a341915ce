"""Serves the page, its websocket, downloads and rerun's viewer on one port, behind the checks of `access`."""

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

from workbench.machine.folders import web_assets_folder
from workbench.machine.versions import command_for_tested_versions
from workbench.page.door import access, viser_private
from workbench.page.door.connection_limits import Connection, RateLimitedLog, of_peer
from workbench.page.door.file_response import Handler
from workbench.page.door.listening_socket import (
    DEFAULT_PORT,
    Listening,
    ServerError,
    listen_on_file,
    listen_on_port,
)
from workbench.page.door.responses import (
    admitted_reply,
    entered_reply,
    folder_handler,
    refusals,
    request_parts,
)

RESPONSE_SECONDS = 300.0
"""Timeout for a request and its whole response. The 10 s of `websockets` are too short for viser's page over a slow
connection, and far too short for a recording."""

TURNED_AWAY = {
    access.Why.NAME: "Refused a request{} for a host name that is not this machine's.",
    access.Why.SITE: "Refused a request{} made by a page of another site.",
    access.Why.NO_TOKEN: "Refused a request{} without the token.",
    access.Why.OTHER_TOKEN: "Refused a request{} with an invalid token, perhaps from a page that was open before.",
}


@dataclass(frozen=True)
class ServerOptions:
    """Address of the page, and who may open it."""

    host: str = "127.0.0.1"
    """Address or name to listen on: loopback for this machine (and ``ssh -L``), ``0.0.0.0`` for everyone who can reach
    it."""
    port: int = DEFAULT_PORT
    """0 takes any free port. If 8080, the default, is taken, the next free one is used and printed."""
    socket: Path | None = None
    """Listen on a Unix socket at this path instead, to which only its owner can connect; `port` is then the port at the
    other end of ``ssh -L``, and `host` must be the default."""
    token: bool = True
    """Require the token of the printed address. False is allowed only on a loopback port."""

    def __post_init__(self) -> None:
        if not self.host:
            raise ValueError("The host to listen on is empty; give an address such as 127.0.0.1.")
        if not 0 <= self.port <= 65535:
            raise ValueError(
                f"Port {self.port} does not exist; give one from 1 to 65535, or 0 for any free one."
            )
        if self.socket is not None and self.host != "127.0.0.1":
            raise ValueError("Give a socket or a host to listen on, not both.")
        if self.socket is not None and not self.token:
            raise ValueError(
                "With a socket, ssh -L opens a port on your own machine, and all users of that machine can connect "
                "to it. Leave the token on."
            )
        if not self.token and not access.is_loopback(self.host.lower()):
            raise ValueError(
                f"Without a token everyone who can reach {self.host} could run code on this machine through the "
                "page. Leave the token on, or listen on 127.0.0.1 and connect over ssh -L."
            )


@dataclass
class GatedServer:
    """The running server. Make it with `open_server`.

    viser itself listens on every interface, has no token, checks no Origin, moves to another port silently, lets any client
    publish the page through a tunnel and trusts every value of a client. The page that it serves runs the author's code.
    Everything is on one port, so that one ``ssh -L`` is enough.
    """

    options: ServerOptions
    server: viser.ViserServer
    port: int
    """The bound port."""
    ssh_hint: str
    """Command to type on the user's own machine to reach the page over ssh."""
    warning: str | None
    """Warning for the terminal about a binding wider than loopback or an unknown viser version; None if there
    is neither."""
    notice: str | None
    """Notice for the terminal if the page is on another port than requested; else None."""
    _listening: Listening = field(repr=False)
    _access_check: _AccessCheck = field(repr=False)
    _gated: viser_private.GatedViser = field(repr=False)
    _routes: dict[str, tuple[Handler, Mapping[str, str]]] = field(repr=False)
    _closed: bool = field(default=False, repr=False)

    @property
    def turned_away(self) -> int:
        """Number of requests refused so far."""
        return self._access_check.turned_away

    def add_route(self, prefix: str, handler: Handler, headers: Mapping[str, str] | None = None) -> None:
        """Add a route for GET requests below ``prefix`` (``/recordings/``), behind the checks. The longest
        prefix wins.

        Args:
            prefix: begins and ends with a slash.
            handler: see `file_response.Handler`. If it raises, the browser gets a 500 and the log the traceback.
            headers: added to every reply; they replace the server's own headers of the same name (such as the
                Content-Security-Policy).
        """
        if len(prefix) < 3 or not prefix.startswith("/") or not prefix.endswith("/"):
            raise ValueError(
                f"A route's prefix begins and ends with a slash, as in /recordings/; got {prefix!r}."
            )
        if prefix in self._routes:
            raise ValueError(f"There is a route for {prefix} already.")
        self._routes[prefix] = (handler, dict(headers or {}))

    def add_channel(self, path: str, serve: viser_private.Serve) -> None:
        """Serve WebSockets that pages open at this path, behind the checks."""
        self._gated.channels[path] = serve

    @property
    def url(self) -> str:
        """The address to open, with the token."""
        return self.addresses()[0]

    def addresses(self, path: str = "/") -> tuple[str, ...]:
        """The addresses of ``path`` (from the root: ``/rerun/...``), with the token. The first is for a
        browser on this machine. The rest are for other machines; which of them works depends on the network.
        A server on loopback has only the first."""
        token = self._access_check.rules.token
        shown = f"?token={token}" if token else ""
        hosts = dict.fromkeys((self._listening.host, *self._listening.external_hosts()))
        return tuple(f"http://{host}:{self.port}{path}{shown}" for host in hosts)

    def renew_token(self) -> str:
        """Make a new token and return the new address. The old token and its cookies are refused, and every open page is
        closed. Must not be called on the event loop.

        Raises:
            ValueError: the server requires no token.
        """
        if not self.options.token:
            raise ValueError("This page asks for no token; there is none to renew.")
        token = secrets.token_urlsafe(32)
        self._access_check.rules = replace(self._access_check.rules, token=token)
        self._gated.close_pages("the token was renewed")
        return self.url

    def close(self) -> None:
        """Close every connection and stop listening. May be called twice."""
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        self._gated.stop()
        self._listening.remove()
        self._access_check.flush()


class _AccessCheck:
    """Decides on each request, answers it, and reports refused ones in the terminal."""

    def __init__(self, rules: access.AccessRules, example: str, events_log: RateLimitedLog) -> None:
        self.rules = rules
        self.turned_away = 0
        self.reports_refusals = False
        """Whether refusals are counted and reported; not during the server's own test."""
        self._refuse = refusals(example)
        self._events_log = events_log

    async def answer(
        self,
        routes: Mapping[str, tuple[Handler, Mapping[str, str]]],
        viser_hook: viser_private.Hook,
        connection: ServerConnection,
        request: Request,
    ) -> Response | None:
        asked = request_parts(request)
        decision = access.decide(self.rules, asked)
        if isinstance(decision, access.RefusedRequest):
            self._count(decision, connection)
            return self._refuse(decision.reason)
        if isinstance(connection, Connection):
            connection.admit()
        if asked.websocket and isinstance(decision, access.Admitted):
            return viser_hook(connection, request)
        # `websockets` closes the connection 10 s after it passed the last byte to the kernel; on a slow connection
        # megabytes are still in transit then.
        connection.close_timeout = RESPONSE_SECONDS
        if isinstance(decision, access.Entered):
            return entered_reply(decision)
        return await admitted_reply(
            routes, viser_hook, connection, request, decision.authority, self._events_log
        )

    def flush(self) -> None:
        """Print lines that were held back, and the number of refused requests; for the end of the program."""
        self._events_log.flush()
        if self.turned_away > 1:
            self._events_log.add("total", f"{self.turned_away} requests were refused in total.")

    def _count(self, refused: access.RefusedRequest, connection: ServerConnection) -> None:
        if self.reports_refusals:
            self.turned_away += 1
            peer = connection.peer if isinstance(connection, Connection) else ""
            self._events_log.add(refused.why, TURNED_AWAY[refused.why].format(of_peer(peer)))


def open_server(options: ServerOptions = ServerOptions(), label: str | None = None) -> GatedServer:
    """Serve viser's page behind the checks of `access`.

    This function binds the socket itself, so that the printed address is the bound one. Before it returns, it
    tests the server with a request that must be refused.

    Args:
        options: address and access.
        label: shown at the top of viser's panel.

    Raises:
        ServerError: the host or port cannot be bound, or the installed viser is an unknown version.
    """
    if options.socket is None:
        listening = listen_on_port(options.host, options.port)
    else:
        listening = listen_on_file(options.socket, options.port)
    token = secrets.token_urlsafe(32) if options.token else None
    rules = access.AccessRules(token=token, names=_our_names(options), any_address=not listening.loopback)
    events_log = RateLimitedLog()
    access_check = _AccessCheck(
        rules, f"http://{listening.authority}/" + ("?token=…" if token else ""), events_log
    )
    routes: dict[str, tuple[Handler, Mapping[str, str]]] = {}

    def wrap(viser_hook: viser_private.Hook) -> viser_private.AsyncHook:
        return functools.partial(access_check.answer, routes, viser_hook)

    try:
        gated = viser_private.make_viser(listening.socket, wrap, label, RESPONSE_SECONDS, events_log)
    except BaseException:
        listening.remove()
        raise
    wide = (
        f"Listening on {options.host}, port {listening.port}: everyone who can reach this machine can send requests, and "
        "the token and everything on the page travel unencrypted. Anyone with the address and its token can run code "
        "here. On a network that you do not trust, listen on 127.0.0.1 and connect over ssh -L."
    )
    if listening.loopback:
        wide = ""
    gated_server = GatedServer(
        options=options,
        server=gated.server,
        port=listening.port,
        ssh_hint=listening.ssh_hint,
        warning=" ".join(filter(None, (wide, viser_private.unknown_page_text()))) or None,
        notice=None
        if listening.path is not None or options.port in (0, listening.port)
        else f"Port {options.port} is taken by another program, so this page is on port {listening.port}.",
        _listening=listening,
        _access_check=access_check,
        _gated=gated,
        _routes=routes,
    )
    # Runs before viser's own exit handler, which prints "Server stopped" into the author's terminal.
    atexit.register(gated_server.close)
    try:
        _test_refusal(listening)
    except BaseException:
        gated_server.close()
        raise
    access_check.reports_refusals = True
    gated_server.add_route("/workbench/", folder_handler(web_assets_folder()))
    return gated_server


def _our_names(options: ServerOptions) -> frozenset[str]:
    own = socket.gethostname()
    split = (access.split_authority(name) for name in (options.host, own, f"{own}.local"))
    return frozenset(name[0] for name in split if name is not None)


def _test_refusal(listening: Listening) -> None:
    """Send a request with a rebound host name. If it is not refused, the checks are not in front of viser.

    Raises:
        ServerError: the request was not refused.
    """
    knock = http.client.HTTPConnection("rebound.invalid", timeout=10)
    knock.sock = listening.connect(timeout=10)
    try:
        knock.request("GET", "/")
        status = knock.getresponse().status
    finally:
        knock.close()
    if status != 403:
        raise ServerError(
            f"The page is not protected: a request that must be refused got the status {status}. "
            f"viser {viser.__version__} is installed. The tested versions: {command_for_tested_versions()}"
        )

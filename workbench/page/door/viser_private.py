"""The only module that uses private names of viser: it runs viser's server behind our checks."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import rich
import viser
import viser._gui_api
import viser._gui_handles
import viser._messages
import viser._threadpool_exceptions
import viser.infra
import viser.infra._infra
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.http11 import Request, Response

from workbench.machine.processes.child_environment import unchanged_environment
from workbench.machine.versions import command_for_tested_versions
from workbench.page.door.client_messages import KINDS, MAX_BYTES, MalformedMessage
from workbench.page.door.connection_limits import (
    Connection,
    ConnectionLimits,
    RateLimitedLog,
    close_when_stalled,
)
from workbench.page.door.listening_socket import ServerError
from workbench.page.door.message_filter import PageGuard
from workbench.page.door.send_pacing import CompressWhenFar, PageConnection

Hook = Callable[[ServerConnection, Request], Response | None]
Serve = Callable[[ServerConnection], Awaitable[None]]
"""Serves one page until it disconnects."""
AsyncHook = Callable[[ServerConnection, Request], Awaitable[Response | None]]

PAGES = {
    "1.1.1": ("5iRcjB7VnwnYpbUpHa15FmjNIRu22hIQnvWuocHMxJw=", "o/BTEGoB4UnTxqb+3RxwUFQZkWXpqUxouHkbDNrAkqE="),
}
"""sha256 of the two scripts of viser's page, by viser's version: first the script in the page, then the
script that the first one decompresses.

A browser that allows only these scripts runs no other one that slipped past escaping
(`responses.page_policy`). To find the second hash of a new version, allow only the first: the browser prints
the second in its console.
"""

REFUSED_FROM_CLIENTS = (
    "ShareUrlRequest",  # opens a tunnel that makes the page public, for any client
    "ShareUrlDisconnect",
    "FileTransferStartUpload",  # viser limits no size and trusts the file name; we accept no uploads
    "FileTransferPart",
    "SceneNodeClickMessage",  # our nodes handle no clicks, and our buttons cannot be held
    "GuiButtonHoldMessage",
)

PRIVATE_NAMES = (
    "infra.websockets.asyncio.server.serve",
    "infra.websockets.datastructures.Headers",
    "infra.websockets.exceptions.ConnectionClosedOK",
    "infra.websockets.exceptions.ConnectionClosedError",
    "infra.WebsockServer._background_worker",
    "infra.WebsockMessageHandler.unregister_handler",
    "messages.Message",
    *(f"messages.{name}" for name in (*sorted(KINDS), *REFUSED_FROM_CLIENTS)),
    "gui.AssignablePropsBase._queue_update",
    "gui._TabContainerMixin._rebuild_tab_props",
    "callbacks.print_threadpool_errors",
    "callbacks.print_awaited_callback_error",
    "callbacks.traceback.print_exception",
)
"""Names that this module relies on.

``infra`` is ``viser.infra._infra``, ``messages`` ``viser._messages``, ``gui`` ``viser._gui_handles``, ``callbacks``
``viser._threadpool_exceptions``.
"""

PRIVATE_ATTRIBUTES = (
    "_websock_server",
    "_websock_server._incoming_handlers",
    "_websock_server._server_thread",
    "_websock_server._broadcast_buffer.message_counter",
    "_websock_server._broadcast_buffer.generator_cursors",
    "gui._container_handle_from_uuid",
    "scene._handle_from_node_name",
)
"""Attributes of a `viser.ViserServer` that this module relies on."""

STOP_SECONDS = 1.0
"""Timeout for a page to answer the closing handshake."""

_making = threading.Lock()

# A page may have closed just before a message is queued for it.
warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)

# Any: viser does not export these names.
infra: Any = viser.infra._infra


def set_tab_label(tab: viser.GuiTabHandle, label: str) -> None:
    """Change the label of a tab; viser can change only its icon."""
    if tab._label != label:
        tab._label = label
        tab._parent._rebuild_tab_props()


def places(server: viser.ViserServer) -> Iterator[tuple[str, str]]:
    """Yield pairs of labels, in order of creation: (tab, "") for each tab in a tab group, and (tab around the
    fold, fold) for each fold; the first label is empty for a fold outside tabs."""
    containers = server.gui._container_handle_from_uuid
    for handle in list(containers.values()):
        if isinstance(handle, viser.GuiTabHandle):
            if isinstance(handle._parent, viser.GuiTabGroupHandle):
                yield handle._label, ""
        elif isinstance(handle, viser.GuiFolderHandle) and handle.label is not None:
            around: Any = handle
            while isinstance(around, viser.GuiFolderHandle):
                around = containers.get(around._impl.parent_container_id)
            yield (around._label if isinstance(around, viser.GuiTabHandle) else ""), handle.label


def wait_until_taken(server: viser.ViserServer, timeout: float) -> None:
    """Wait up to `timeout` seconds until all messages so far are in a batch that is being sent to each page.

    A page handles a batch as a whole: messages written after this call do not delay earlier ones.
    """
    buffer = server._websock_server._broadcast_buffer
    written, end = buffer.message_counter - 1, time.monotonic() + timeout
    # A slow page lags by more than this timeout, and must not delay the others.
    while any(taken < written for taken in list(buffer.generator_cursors.values())):
        if time.monotonic() > end:
            return
        time.sleep(0.0005)


def remove_nodes_except(server: viser.ViserServer | viser.ClientHandle, kept: tuple[str, ...]) -> None:
    """Remove every node of the 3-D view except those at and below these names."""
    for name, handle in list(server.scene._handle_from_node_name.items()):
        stays = name == "/WorldAxes" or any(name == root or name.startswith(f"{root}/") for root in kept)
        # Removing a parent removes its children.
        if not stays and not handle._impl.removed:
            handle.remove()


def _missing(root: object, dotted: tuple[str, ...]) -> list[str]:
    missing: list[str] = []
    for name in dotted:
        here = root
        for part in name.split("."):
            if not hasattr(here, part):
                missing.append(name)
                break
            here = getattr(here, part)
    return missing


def missing_names() -> list[str]:
    """Names in `PRIVATE_NAMES` that the installed viser does not have."""
    roots = SimpleNamespace(
        infra=infra,
        messages=viser._messages,
        gui=viser._gui_handles,
        callbacks=viser._threadpool_exceptions,
    )
    return _missing(roots, PRIVATE_NAMES)


def page_scripts() -> tuple[str, str] | None:
    """Hashes of the scripts of the installed viser's page, see `PAGES`; None if the version is unknown."""
    return PAGES.get(viser.__version__)


def unknown_page_text() -> str:
    """Warning about a viser version whose page is unknown; empty if it is known."""
    if page_scripts() is not None:
        return ""
    return (
        f"viser {viser.__version__} is not tested with the workbench: its scripts are unknown, so the browser "
        "allows all scripts, and one that slipped past escaping would run. "
        f"The tested versions: {command_for_tested_versions()}"
    )


def _moved(what: str) -> ServerError:
    return ServerError(
        f"The page cannot be made safe: {what}. viser {viser.__version__} is installed. The tested versions: "
        f"{command_for_tested_versions()}"
    )


def _is_of_viser(kind: str) -> bool:
    """Whether viser has a message of this kind."""
    known = getattr(viser._messages, kind, None)
    return isinstance(known, type) and issubclass(known, viser._messages.Message)


def _watched(handler: Serve, channels: dict[str, Serve], events_log: RateLimitedLog) -> Serve:
    async def watched(connection: ServerConnection) -> None:
        request = connection.request
        if request is not None and (ours := channels.get(urlsplit(request.path).path)) is not None:
            await ours(connection)
            return
        if connection.subprotocol != f"viser-v{viser.__version__}":
            # Handled here, since viser prints the client's version, of any length, and sends it back.
            events_log.add("version", "Refused a page that another version of viser has served: reload it.")
            await connection.close(1002, f"Version mismatch. Server: {viser.__version__}")
            return
        receive = connection.recv
        guard = PageGuard(_is_of_viser, events_log)

        async def receive_checked() -> object:
            while True:
                raw = await receive()
                await guard.wait_turn(len(raw))
                if guard.admits(raw):
                    return raw

        line = PageConnection(connection)
        connection.recv = receive_checked  # type: ignore[method-assign,assignment]
        connection.send = line.send  # type: ignore[method-assign,assignment]
        listening = asyncio.create_task(close_when_stalled(connection, events_log, lambda: line.unanswered))
        try:
            await handler(connection)
        except MalformedMessage as error:
            # Without this `websockets` closes the connection too, but prints a traceback into the author's terminal for
            # every such frame.
            events_log.add("malformed", f"Closed a page's connection: it sent {error}.")
            # The page may keep sending and never answer the closing handshake.
            connection.close_timeout = STOP_SECONDS
            await connection.close(1008, "malformed message")
        finally:
            listening.cancel()

    return watched


class _Terminal(logging.Filter):
    """Limits the output of viser, `websockets` and asyncio about pages to some lines a minute: a page could fill the
    terminal with a line per frame or a traceback per connection. Installed once per process."""

    def __init__(self) -> None:
        super().__init__()
        self.events_log = RateLimitedLog()
        self._installed = False

    def install(self) -> None:
        if self._installed:
            return
        self._installed = True
        for name in (_WEBSOCKETS_LOG, "asyncio"):
            logging.getLogger(name).addFilter(self)
        print_rich = rich.print

        def print_unless_viser(*things: Any, **options: Any) -> None:
            # ``verbose=False`` does not suppress viser's lines about start, stop and refused pages. Lines of
            # other code are printed.
            if not sys._getframe(1).f_globals.get("__name__", "").startswith("viser"):
                print_rich(*things, **options)

        rich.print = print_unless_viser
        callbacks: Any = viser._threadpool_exceptions
        callbacks.print = lambda *things, **options: None
        callbacks.traceback = SimpleNamespace(print_exception=self._callback_failed)

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno < logging.WARNING:
            return True
        error = record.exc_info[1] if record.exc_info else None
        if record.levelno >= logging.ERROR and not _has_left(error):
            kind = record.name, record.pathname, record.lineno, type(error)
            self.events_log.add(kind, record.getMessage(), error)
        return False

    def _callback_failed(self, kind: object, error: BaseException, *_: object) -> None:
        frames = traceback.extract_tb(error.__traceback__)
        place = (frames[-1].filename, frames[-1].lineno) if frames else None
        self.events_log.add(("callback", type(error), place), "A callback of a page failed.", error)


_terminal = _Terminal()


@dataclass(frozen=True)
class GatedViser:
    """A `viser.ViserServer` on our socket behind our checks. Make it with `make_viser`."""

    server: viser.ViserServer
    _serving: websockets.asyncio.server.serve
    channels: dict[str, Serve]
    """Our own WebSocket handlers by path."""
    _closing: set[asyncio.Task[None]] = field(default_factory=set)

    def close_pages(self, reason: str) -> None:
        """Close every page and every response in progress; returns when closing has begun."""
        listening = self._serving.server
        begun = threading.Event()

        def close() -> None:
            for connection in list(listening.handlers):
                if connection in listening.connections:
                    connection.close_timeout = STOP_SECONDS
                    closing = connection.loop.create_task(connection.close(1008, reason))
                    self._closing.add(closing)
                    closing.add_done_callback(self._closing.discard)
                elif isinstance(connection, Connection) and connection.admitted:
                    connection.transport.abort()
            begun.set()

        listening.get_loop().call_soon_threadsafe(close)
        begun.wait(timeout=10.0)

    def stop(self) -> None:
        """Stop viser and close every connection, within about a second.

        `websockets` would wait for each idle socket (Chromium holds some open), and ten seconds for a page that does
        not answer the closing handshake.
        """
        listening = self._serving.server
        loop = listening.get_loop()
        started = loop.time()

        def drop() -> None:
            patient = loop.time() - started < STOP_SECONDS
            for connection in list(listening.handlers):
                if not (patient and connection in listening.connections):
                    connection.transport.abort()
            # Repeat: a socket that was just accepted is not among the handlers yet.
            loop.call_later(0.02, drop)

        if not loop.is_closed():
            with contextlib.suppress(RuntimeError):  # the loop has closed: there is nothing to drop
                loop.call_soon_threadsafe(drop)
        with _making:
            self.server.stop()


def make_viser(
    listening: socket.socket,
    wrap: Callable[[Hook], AsyncHook],
    label: str | None,
    response_seconds: float,
    events_log: RateLimitedLog,
) -> GatedViser:
    """Make a `viser.ViserServer` that serves only on ``listening``, behind the hook that ``wrap`` makes from viser's own.

    viser serves page and websocket from one ``websockets`` server that it starts in ``viser/infra/_infra.py``, without a
    way to check a request first, choose the socket, refuse a message or suppress output. So while the server is made, the
    name ``websockets`` in that module is a stand-in whose ``serve`` is ours. Our ``serve`` passes viser's
    arguments on but changes some, such as the socket, ``process_request``, compression and the handler. Our
    handler checks every message first, sends as fast as the page acknowledges, and closes stalled clients.
    `missing_names` is checked before, and `gated_server` tests the result with a forbidden request.

    Args:
        listening: bound and listening; the server owns it from here on.
        wrap: gets viser's ``process_request`` (files for plain requests, None for a handshake).
        label: shown at the top of viser's panel.
        response_seconds: timeout of one request including its whole response.
        events_log: logs misbehaviour of pages.

    Raises:
        ServerError: the installed viser is an unknown version. Nothing is left listening.
    """
    missing = missing_names()
    if missing:
        listening.close()
        raise _moved("viser no longer has " + ", ".join(missing))
    _terminal.install()
    _terminal.events_log = events_log
    real_serve = websockets.asyncio.server.serve
    serving: list[websockets.asyncio.server.serve] = []
    channels: dict[str, Serve] = {}
    strangers = ConnectionLimits(events_log)

    def serve(handler: Serve, host: str, port: int, **options: Any) -> websockets.asyncio.server.serve:
        # Do not use viser's host and port: viser silently binds another port if this one is taken, or the port of the
        # environment (_VISER_PORT_OVERRIDE).
        options.update(
            process_request=wrap(options["process_request"]),
            max_size=MAX_BYTES,
            extensions=[CompressWhenFar()],
            open_timeout=response_seconds,
            server_header=None,
            create_connection=strangers.connection,
            unix=listening.family == socket.AF_UNIX,
            logger=_quiet_logger(),
        )
        made = real_serve(_watched(handler, channels, events_log), sock=listening, **options)
        serving.append(made)
        return made

    look_alike = SimpleNamespace(
        asyncio=SimpleNamespace(server=SimpleNamespace(serve=serve, ServerConnection=ServerConnection)),
        datastructures=infra.websockets.datastructures,
        exceptions=infra.websockets.exceptions,
    )
    with _making:
        real = infra.websockets
        infra.websockets = look_alike  # type: ignore[assignment]
        try:
            # A version of viser that does not call our `serve` listens on loopback only, on any port, until
            # it is stopped below.
            server = viser.ViserServer(host="127.0.0.1", port=0, label=label, verbose=False)
        finally:
            infra.websockets = real
    missing = _missing(server, PRIVATE_ATTRIBUTES)
    if missing or len(serving) != 1:
        server.stop()
        listening.close()
        raise _moved(
            "viser did not start its server as expected" if not missing else f"viser has no {missing}"
        )
    for name in REFUSED_FROM_CLIENTS:
        server._websock_server.unregister_handler(getattr(viser._messages, name))
    with unchanged_environment():
        # For its first picture viser imports OpenCV, which adds the working directory to the library path
        # of all child processes.
        server.gui.add_image(np.zeros((1, 1, 3), np.uint8)).remove()
    return GatedViser(server, serving[0], channels)


_WEBSOCKETS_LOG = "workbench.door.websockets"


def _quiet_logger() -> logging.Logger:
    """Logger for `websockets`."""
    logger = logging.getLogger(_WEBSOCKETS_LOG)
    logger.setLevel(logging.WARNING)
    return logger


def _has_left(error: BaseException | None) -> bool:
    """Whether the error comes from a port scanner's garbage, or from a browser that leaves before its response is complete."""
    if isinstance(error, AssertionError):
        # `websockets` asserts that a connection is still open after its response: here the client has left.
        return traceback.extract_tb(error.__traceback__)[-1].name == "send_eof"
    return isinstance(error, (InvalidHandshake, ConnectionClosed, ConnectionError, EOFError))

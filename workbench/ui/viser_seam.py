"""The only place that reaches into viser's private names; written for viser 1.1.1.

viser serves its page and its websocket from one ``websockets`` server that it starts in
``viser/infra/_infra.py``, and offers no way to look at a request first, to choose the socket, to
refuse a message from a client, or to keep quiet. All four are needed (see `workbench.ui.door`), so
while a `viser.ViserServer` is being made, the name ``websockets`` in that one viser module stands for
a look-alike whose ``serve`` is ours. Ours gives the real one the same arguments, with three changed:
the socket (ours, already bound), ``process_request`` (viser's own hook, handed to the caller to wrap)
and the handler (viser's own, but every message from a client is looked at before viser sees it, and a
client that reads nothing is let go, see `workbench.ui.deaf_clients`).

Two nets below that: `missing_names` lists what an upgrade of viser took away, and is asked before
anything starts; and `workbench.ui.door` sends a request that must be refused through the finished
server before it tells anyone the address.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import socket
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import rich
import viser
import viser._gui_handles
import viser._messages
import viser.infra
import viser.infra._infra
import websockets.asyncio.server
from numpy.typing import NDArray
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from workbench.ui.deaf_clients import let_go_when_deaf

WRITTEN_FOR = "1.1.1"

Hook = Callable[[ServerConnection, Request], Response | None]
AsyncHook = Callable[[ServerConnection, Request], Awaitable[Response | None]]

MESSAGES_FROM_CLIENTS = frozenset(
    {
        "CommandTriggerMessage",
        "GetRenderResponseMessage",
        "GuiButtonHoldMessage",
        "GuiFormDirtyMessage",
        "GuiFormSubmitMessage",
        "GuiUpdateMessage",
        "LocalStorageGetItemResponseMessage",
        "SceneNodeClickMessage",
        "SceneNodeDragMessage",
        "ScenePointerMessage",
        "TransformControlsDragEndMessage",
        "TransformControlsDragStartMessage",
        "TransformControlsUpdateMessage",
        "ViewerCameraMessage",
    }
)
"""What a page has to say: everything that viser registers a handler for, less the four below."""

REFUSED_FROM_CLIENTS = (
    "ShareUrlRequest",  # opens a tunnel that makes the page public, whoever asks
    "ShareUrlDisconnect",
    "FileTransferStartUpload",  # no size limit, file name taken verbatim; nothing here takes uploads
    "FileTransferPart",
)

PRIVATE_NAMES = (
    "infra.websockets.asyncio.server.serve",
    "infra.websockets.datastructures.Headers",
    "infra.websockets.exceptions.ConnectionClosedOK",
    "infra.websockets.exceptions.ConnectionClosedError",
    "infra.WebsockServer._background_worker",
    "infra.WebsockMessageHandler.unregister_handler",
    "infra.Message.deserialize",
    *(f"messages.{name}" for name in (*sorted(MESSAGES_FROM_CLIENTS), *REFUSED_FROM_CLIENTS)),
    "gui.AssignablePropsBase._queue_update",
)
"""Names that this module relies on.

``infra`` is ``viser.infra._infra``, ``messages`` ``viser._messages``, ``gui`` ``viser._gui_handles``.
"""

PRIVATE_ATTRIBUTES = (
    "_websock_server",
    "_websock_server._incoming_handlers",
    "_websock_server._server_thread",
    "_websock_server._broadcast_buffer.message_counter",
    "_websock_server._broadcast_buffer.generator_cursors",
    "scene._handle_from_node_name",
)
"""Attributes of a `viser.ViserServer` that this module relies on."""

STOP_SECONDS = 1.0
"""How long a page gets to answer the closing handshake."""

_log = logging.getLogger("workbench.door")
_making = threading.Lock()

# Any: the checker rightly says that viser does not export these names.
infra: Any = viser.infra._infra


class SeamError(RuntimeError):
    """viser is not the viser that this module was written for."""


class MalformedMessage(ValueError):
    """A client sent what no page of ours sends."""


def element_id(handle: viser.GuiButtonHandle | viser.GuiNumberHandle) -> str:
    """The ``id`` of its element in the page (viser's ``Button.tsx``, ``NumberInput.tsx``), for HTML that works it."""
    return handle._impl.uuid


def send_lines(
    handle: viser.GuiUplotHandle,
    data: tuple[NDArray[np.float64], ...],
    sent: tuple[NDArray[np.float64] | list[float | None], ...],
) -> None:
    """Give a chart these data, and its browsers `sent`, in which None is a gap: viser's property makes NaN of it."""
    props: Any = handle._impl.props
    props.data = data
    handle._queue_update("data", sent)


def wait_until_taken(server: viser.ViserServer, patience: float) -> None:
    """Return when all that was written so far is in a batch on its way to each page, or after `patience` seconds.

    A page takes a batch as a whole, so what is written after this does not hold up what was written before.
    """
    buffer = server._websock_server._broadcast_buffer
    written, end = buffer.message_counter - 1, time.monotonic() + patience
    # A page that reads slowly is behind by more than this wait; it must not keep the others waiting.
    while any(taken < written for taken in list(buffer.generator_cursors.values())):
        if time.monotonic() > end:
            return
        time.sleep(0.0005)


def remove_nodes_but(server: viser.ViserServer, kept: tuple[str, ...]) -> None:
    """Remove every node of the 3-D view but those at and below these names, as ``scene.reset`` removes all."""
    for name, handle in list(server.scene._handle_from_node_name.items()):
        stays = name == "/WorldAxes" or any(name == root or name.startswith(f"{root}/") for root in kept)
        # A child goes with its parent.
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
    """Those of `PRIVATE_NAMES` that the installed viser does not have."""
    roots = SimpleNamespace(infra=infra, messages=viser._messages, gui=viser._gui_handles)
    return _missing(roots, PRIVATE_NAMES)


def _moved(what: str) -> SeamError:
    return SeamError(
        f"The page cannot be made safe: {what}. workbench/ui/viser_seam.py is written for viser {WRITTEN_FOR} "
        f"and viser {viser.__version__} is installed; install viser=={WRITTEN_FOR}."
    )


def _finite(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, dict):
        return all(_finite(item) for item in value.values())
    if isinstance(value, list):
        return all(_finite(item) for item in value)
    return True


def admits(raw: object) -> bool:
    """Whether a message from a client goes on to viser; False drops it.

    Dropped: the types in `REFUSED_FROM_CLIENTS`, types that only the server sends, and an update of
    anything but a control's ``value`` (viser would set any attribute that it has, ``removed`` too).

    Raises:
        MalformedMessage: a text frame, not msgpack, an unknown type, missing, surplus or ill-typed
            fields, or a number that is not finite.
    """
    if not isinstance(raw, bytes):
        raise MalformedMessage("a text frame")
    try:
        decoded = msgspec.msgpack.decode(raw)
        finite = _finite(decoded)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise MalformedMessage(f"not msgpack ({error})") from None
    kind = decoded.get("type") if isinstance(decoded, dict) else None
    if not isinstance(kind, str):
        raise MalformedMessage("a message without a type")
    if kind not in MESSAGES_FROM_CLIENTS:
        if isinstance(getattr(viser._messages, kind, None), type):
            _log.warning("Dropped a message from a browser: %s is not for pages to send.", kind)
            return False
        raise MalformedMessage("an unknown type")
    if not finite:
        raise MalformedMessage(f"a number in {kind} that is not finite")
    try:
        message = viser._messages.Message.deserialize(raw)
    except (TypeError, ValueError, KeyError, AttributeError, OverflowError) as error:
        raise MalformedMessage(f"wrong fields in {kind} ({type(error).__name__})") from None
    # viser only warns about a tuple of the wrong length, passes the list on, and every reader of
    # client.camera.position then meets a vector of two.
    if any(isinstance(value, list) for value in vars(message).values()):
        raise MalformedMessage(f"a vector of the wrong length in {kind}")
    if kind == "GuiUpdateMessage":
        updates = decoded["updates"]
        if not isinstance(updates, dict):
            raise MalformedMessage("wrong fields in GuiUpdateMessage")
        return set(updates) == {"value"}
    return True


def _watched(
    handler: Callable[[ServerConnection], Awaitable[None]],
) -> Callable[[ServerConnection], Awaitable[None]]:
    async def watched(connection: ServerConnection) -> None:
        receive = connection.recv

        async def receive_checked() -> object:
            while True:
                raw = await receive()
                if admits(raw):
                    return raw

        connection.recv = receive_checked  # type: ignore[method-assign,assignment]
        listening = asyncio.create_task(let_go_when_deaf(connection))
        try:
            await handler(connection)
        except MalformedMessage as error:
            # Without this the connection is closed as well, but with a traceback of websockets in the
            # author's terminal for every frame that a stranger cares to send.
            _log.warning("Closed a browser's connection: it sent %s.", error)
            await connection.close(1008, "malformed message")
        finally:
            listening.cancel()

    return watched


@contextlib.contextmanager
def _quiet_viser() -> Iterator[None]:
    """Drop what viser prints of its own accord; ``verbose=False`` does not stop its start and stop
    lines. Only calls that come from viser are dropped, so that others may print meanwhile."""
    print_rich = rich.print

    def print_unless_viser(*things: Any, **options: Any) -> None:
        if not sys._getframe(1).f_globals.get("__name__", "").startswith("viser"):
            print_rich(*things, **options)

    rich.print = print_unless_viser
    try:
        yield
    finally:
        rich.print = print_rich


@dataclass(frozen=True)
class GatedViser:
    server: viser.ViserServer
    _serving: websockets.asyncio.server.serve

    def stop(self) -> None:
        """Stop viser and close every connection, within about a second.

        `websockets` would wait for each socket on which a browser has not asked anything yet (Chromium
        holds such sockets open), and ten seconds for a page that does not answer the closing handshake.
        """
        listening = self._serving.server
        loop = listening.get_loop()
        started = loop.time()

        def drop() -> None:
            patient = loop.time() - started < STOP_SECONDS
            for connection in list(listening.handlers):
                if not (patient and connection in listening.connections):
                    connection.transport.abort()
            # Again: a socket that was just accepted is not among the handlers yet.
            loop.call_later(0.02, drop)

        if not loop.is_closed():
            with contextlib.suppress(RuntimeError):  # closed since: then nothing is left to drop
                loop.call_soon_threadsafe(drop)
        with _making, _quiet_viser():
            self.server.stop()


def make_viser(
    listening: socket.socket,
    wrap: Callable[[Hook], AsyncHook],
    label: str | None,
    max_message_bytes: int,
    response_seconds: float,
) -> GatedViser:
    """Make a `viser.ViserServer` that serves on ``listening`` only, behind the hook that ``wrap`` makes
    of viser's own.

    Args:
        listening: bound and listening; the server owns it from here on.
        wrap: gets viser's ``process_request`` (files for plain requests, None for a handshake).
        label: shown at the top of viser's panel.
        max_message_bytes: a larger message from a client closes its connection (code 1009).
        response_seconds: longest that one request may take, its whole answer included.

    Raises:
        SeamError: the installed viser has moved. Nothing is left listening.
    """
    missing = missing_names()
    if missing:
        listening.close()
        raise _moved("viser no longer has " + ", ".join(missing))
    real_serve = websockets.asyncio.server.serve
    serving: list[websockets.asyncio.server.serve] = []

    def serve(
        handler: Callable[[ServerConnection], Awaitable[None]], host: str, port: int, **options: Any
    ) -> websockets.asyncio.server.serve:
        # viser's host and port are left out: it would bind another port without a word if this one
        # were taken, and let the environment (_VISER_PORT_OVERRIDE) choose it.
        options.update(
            process_request=wrap(options["process_request"]),
            max_size=max_message_bytes,
            open_timeout=response_seconds,
            logger=_quiet_logger(),
        )
        made = real_serve(_watched(handler), sock=listening, **options)
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
            with _quiet_viser():
                # If viser ever stops calling our serve, this is where it binds: loopback, any port.
                server = viser.ViserServer(host="127.0.0.1", port=0, label=label, verbose=False)
        finally:
            infra.websockets = real
    missing = _missing(server, PRIVATE_ATTRIBUTES)
    if missing or len(serving) != 1:
        with _quiet_viser():
            server.stop()
        listening.close()
        raise _moved(
            "viser did not start its server the known way" if not missing else f"viser has no {missing}"
        )
    for name in REFUSED_FROM_CLIENTS:
        server._websock_server.unregister_handler(getattr(viser._messages, name))
    return GatedViser(server, serving[0])


def _quiet_logger() -> logging.Logger:
    """Logger for `websockets`: a port scanner's garbage is no error of ours, and it must not put a
    traceback into the author's terminal."""
    logger = logging.getLogger("workbench.door.websockets")
    logger.setLevel(logging.WARNING)
    if not logger.filters:
        logger.addFilter(lambda record: record.getMessage() != "opening handshake failed")
    return logger

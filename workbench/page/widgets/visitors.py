"""The open pages, and our WebSocket for their numbered commands: handled in order, one reply each."""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import viser
from websockets.asyncio.server import ServerConnection

from workbench.machine.loop import submit
from workbench.page.command import Command, CommandList, Refused
from workbench.page.door.connection_limits import RateLimitedLog
from workbench.page.widgets.templates import render

log = logging.getLogger(__name__)

PATH = "/do"
NOTICE_SECONDS = 8.0
"""Time for which a refusal is shown."""


class Message(msgspec.Struct, forbid_unknown_fields=True):
    """``{"n": 3, "do": ["select_env", {"env": 3}]}``"""

    n: int
    do: tuple[str, dict[str, Any]]


class Reply(msgspec.Struct, omit_defaults=True):
    n: int
    refused: str = ""


_decoder = msgspec.json.Decoder(Message)


@dataclass(eq=False)
class Visitor:
    """One open page: a browser's tab."""

    name: str
    """Random name, sent only to this page."""
    client: viser.ClientHandle
    page_width: int = 0
    """Width of the page in CSS pixels at its last connection; 0 before the first."""

    _sent: viser.GuiHtmlHandle | None = None

    def send(self, html: str) -> None:
        """Add an HTML element to this page. The page's script acts on the element (``arrivals`` in
        ``input.js``). The element replaces that of the previous call."""
        if self._sent is not None:
            self._sent.remove()
        self._sent = self.client.gui.add_html(html)

    def notify(self, text: str, title: str = "Not possible") -> None:
        self.client.add_notification(title, text, color="orange", auto_close_seconds=NOTICE_SECONDS)


Done = Coroutine[Any, Any, None] | None
"""Coroutine for the rest of a command that has to wait; None if the command is done."""
Do = Callable[[Command, Visitor], Done]
"""Carries out a command of a page, on the loop (`machine.loop`). Raises `Refused` with a sentence for the user."""


class Visitors:
    """The open pages of a server. All their commands go through `do`.

    Args:
        server: The viser server.
        commands: All commands that a page can send.
    """

    def __init__(self, server: viser.ViserServer, commands: CommandList) -> None:
        self.commands = commands
        self.do: Do = _nothing
        """Carries out a command on the shown page; set by `app.server`, refuses until then."""
        self._events_log = RateLimitedLog()
        self._by_name: dict[str, Visitor] = {}
        self._by_client: dict[int, Visitor] = {}
        server.on_client_connect(self._on_connect)
        server.on_client_disconnect(self._on_disconnect)

    async def _on_connect(self, client: viser.ClientHandle) -> None:
        # A random name instead of viser's client number: viser counts from 0 again at each start, and a
        # client that reconnects gets a new number.
        visitor = Visitor(secrets.token_urlsafe(12), client)
        self._by_name[visitor.name] = self._by_client[client.client_id] = visitor
        client.gui.add_html(render("page_name", name=visitor.name))

    async def _on_disconnect(self, client: viser.ClientHandle) -> None:
        visitor = self._by_client.pop(client.client_id)
        del self._by_name[visitor.name]

    def all(self) -> list[Visitor]:
        """The open pages."""
        return list(self._by_name.values())

    def on(self, command: Command) -> Callable[[viser.CommandEvent], Coroutine[Any, Any, None]]:
        """Callback for an entry of viser's palette."""

        async def asked(event: viser.CommandEvent) -> None:
            visitor = event.client and self._by_client.get(event.client.client_id)
            if visitor:
                await self.ask(command, visitor)

        return asked

    async def ask(self, command: Command, visitor: Visitor) -> str:
        """Carry out a command after all earlier commands of any page. If it is refused or fails, tell the
        page and return the reason; else return an empty text."""
        try:
            await asyncio.wrap_future(submit(self._carry_out(command, visitor)))
        except Refused as reason:
            visitor.notify(str(reason))
            return str(reason)
        except Exception:
            log.exception("Failed: %r", command)
            visitor.notify("The command failed. The reason is in the terminal.", "Failed")
            return "it failed"
        return ""

    async def _carry_out(self, command: Command, visitor: Visitor) -> None:
        rest = self.do(command, visitor)
        if rest is not None:
            await rest

    async def serve(self, connection: ServerConnection) -> None:
        """Handle one page's commands until it disconnects."""
        assert connection.request is not None
        query = parse_qs(urlsplit(connection.request.path).query)
        visitor = self._by_name.get(query.get("page", [""])[0])
        if visitor is None:
            await connection.close(1008, "no such page")
            return
        width = query.get("width", [""])[0]
        visitor.page_width = int(width) if width.isdecimal() and len(width) < 6 else 0
        async for raw in connection:
            try:
                message = _decoder.decode(raw)
                refused = ""
                try:
                    command = self.commands.decode(*message.do)
                except Refused as reason:
                    refused = str(reason)
                    visitor.notify(refused)
                else:
                    refused = await self.ask(command, visitor)
            except (msgspec.DecodeError, UnicodeDecodeError, KeyError) as fault:
                self._events_log.add(
                    "malformed", f"Closed a page's connection: it sent no valid command ({fault!r})."
                )
                await connection.close(1008, "malformed message or unknown command")
                return
            await connection.send(msgspec.json.encode(Reply(message.n, refused)).decode())


def _nothing(command: Command, visitor: Visitor) -> None:
    raise Refused("Nothing is shown yet.")

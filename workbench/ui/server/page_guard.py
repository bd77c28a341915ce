"""Filters the messages of a page before viser sees them, and limits their rate."""

from __future__ import annotations

import asyncio
import time
from typing import Any, Protocol

from workbench.ui.server.client_messages import (
    KINDS,
    ClientMessage,
    GuiFormDirtyMessage,
    GuiFormSubmitMessage,
    GuiUpdateMessage,
    ImpossibleValue,
    MalformedMessage,
    kind_of,
    read_message,
    read_value,
)
from workbench.ui.server.control_values import check_value
from workbench.ui.server.strangers import RareLog

HANDS_OFF = 1.2
"""Seconds without another value until a control shows the true one again: a hand may still be on it."""
RATE = 200.0
"""Sustained messages a second of a page; a drag sends about twenty."""
BURST = 400.0
BYTES_EACH = 2048
"""A message counts once for each block of this many bytes."""
PATIENCE = 5.0
"""Seconds for which a page may be slowed down without a pause; then its connection is closed."""
TURN = 16
"""Messages after which the event loop serves the other pages."""


class ServedPage(Protocol):
    """viser's side of one connection (`viser_private.ViserPage`)."""

    def control(self, uuid: str) -> Any | None:
        """The input with this id, of all pages or of this one; None if there is none."""

    def has_form(self, uuid: str) -> bool:
        """Whether a form has this id."""
        ...

    def is_from_server(self, kind: str) -> bool:
        """Whether viser has a message of this kind."""
        ...

    def show_again(self, control: Any) -> None:
        """Send the control's value to this page only."""

    def tell(self, sentence: str) -> None:
        """Show this page a notification."""


class PageGuard:
    """The filter of one connection, on its event loop.

    A message that no page of ours sends closes the connection. A value that a control cannot hold is dropped: viser
    does not store it, and the page is told and shown the true value. That is no attack: the ends of a slider or a list
    of options may have changed since the click. (Number fields are checked in the page first, ``typed_numbers.js``.) A
    page that sends faster than a page can is slowed down, so that the others keep their share of the event loop.
    """

    def __init__(self, page: ServedPage, told: RareLog) -> None:
        self._page, self._told = page, told
        self._level, self._at = BURST, time.monotonic()
        self._slowed, self._turns = 0.0, 0
        self._corrections: dict[str, asyncio.TimerHandle] = {}

    async def wait_turn(self, size: int) -> None:
        """Wait until the page may speak again, after a message of `size` bytes.

        Raises:
            MalformedMessage: It keeps sending too fast; close the connection.
        """
        now = time.monotonic()
        self._level = min(BURST, self._level + (now - self._at) * RATE) - 1 - size // BYTES_EACH
        self._at, self._turns = now, self._turns + 1
        if self._level >= BURST / 2:
            self._slowed = 0.0
        if self._level < 0:
            self._slowed -= self._level / RATE
            if self._slowed > PATIENCE:
                raise MalformedMessage("too many messages")
            await asyncio.sleep(-self._level / RATE)
        elif self._turns % TURN == 0:
            await asyncio.sleep(0)

    def admits(self, raw: object) -> bool:
        """Whether a frame is passed on to viser; False drops it.

        Raises:
            MalformedMessage: Close the connection.
        """
        kind = kind_of(raw)
        if kind not in KINDS:
            if not self._page.is_from_server(kind):
                raise MalformedMessage("an unknown type")
            self._told.happened(kind, f"Dropped a message from a page: {kind} is not for pages to send.")
            return False
        assert isinstance(raw, bytes)
        try:
            message = read_message(raw, kind)
        except ImpossibleValue as error:
            self._told.happened(kind, f"Dropped a message from a page: {error}, in {kind}.")
            return False
        return self._admits_message(message)

    def close(self) -> None:
        for correction in self._corrections.values():
            correction.cancel()
        self._corrections.clear()

    def _admits_message(self, message: ClientMessage) -> bool:
        if isinstance(message, GuiUpdateMessage):
            return self._admits_update(message)
        if isinstance(message, (GuiFormDirtyMessage, GuiFormSubmitMessage)):
            # viser sends it to all pages and keeps it for later ones, for any id.
            return self._page.has_form(message.uuid)
        return True

    def _admits_update(self, message: GuiUpdateMessage) -> bool:
        control = self._page.control(message.uuid)
        # None: removed a moment ago. viser would set any attribute of a control, ``removed`` too.
        if control is None or set(message.updates) != {"value"}:
            return False
        try:
            check_value(control, read_value(message.updates["value"]))
        except ValueError as error:
            self._correct_later(message.uuid, str(error))
            return False
        self._forget_correction(message.uuid)
        return True

    def _correct_later(self, uuid: str, why: str) -> None:
        self._forget_correction(uuid)
        loop = asyncio.get_running_loop()
        self._corrections[uuid] = loop.call_later(HANDS_OFF, self._correct, uuid, why)

    def _forget_correction(self, uuid: str) -> None:
        if uuid in self._corrections:
            self._corrections.pop(uuid).cancel()

    def _correct(self, uuid: str, why: str) -> None:
        self._corrections.pop(uuid, None)
        control = self._page.control(uuid)
        if control is None:
            return
        self._told.happened("value", f"Rejected a value from a page: {why}")
        self._page.tell(why)
        self._page.show_again(control)

"""One input of the page whose truth is in the session.

Three parties may set a value: the person at the input, a key or a second page, and the session
itself (a value that it refuses). The input only asks, the session decides, and the page shows what
the session says. Two things go wrong if that is done plainly. A value that comes back while the
person still drags would pull the slider out of their hand: so an input that was touched a moment
ago is left alone. And each key stroke in a text field would be applied: so an input may ask to be
left to settle first.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, Generic, Literal, TypeVar

import viser

from workbench.ui.parts import Clock

T = TypeVar("T")
Handle = TypeVar("Handle", bound=viser.GuiInputHandle)

KEY_SETTLES = 0.03
"""Seconds. An input that has the focus takes the arrow keys too, and what it says comes in any order with the key."""
HANDS_OFF = 0.5
"""Seconds after a person touched an input in which it is not written to."""


def tell_all(
    server: viser.ViserServer,
    title: str,
    text: str,
    color: Literal["orange", "red"] | None = "orange",
    seconds: float | None = None,
) -> None:
    """Notify every open page: a key does not tell which one it was pressed on."""
    for client in server.get_clients().values():
        client.add_notification(title, text, color=color, auto_close_seconds=seconds)


@contextmanager
def refusals_told(
    client: viser.ClientHandle | None,
    title: str = "Not possible",
    then: Callable[[], None] = lambda: None,
) -> Iterator[None]:
    """A ValueError within ends what is within, and is shown to the page that asked."""
    try:
        yield
    except ValueError as error:
        then()
        if client is not None:
            client.add_notification(title, str(error), color="orange", auto_close_seconds=8.0)


class Control(Generic[Handle, T]):
    """Ties one viser input to one setting of the session.

    Args:
        handle: The input. What it cannot hold never comes here (`control_values.check_value`).
        send: Asks the session for a value. Must not block. Raises ValueError with a sentence for the person.
        read: The input's value as the session's; raises as `send`.
        shown: The session's value as the input's.
        settle: Seconds without a change before a value is sent.
        clock: Of the page.
    """

    _last_touch: ClassVar[float] = -1e9

    def __init__(
        self,
        handle: Handle,
        send: Callable[[T], None],
        read: Callable[[Any], T] = lambda value: value,
        shown: Callable[[T], Any] = lambda value: value,
        settle: float = 0.0,
        clock: Clock = time.monotonic,
    ) -> None:
        self.handle = handle
        self._read = read
        self._send = send
        self._shown = shown
        self._settle = settle
        self._clock = clock
        self._touched = -1e9
        self._waiting: viser.ClientHandle | None = None
        self._lock = threading.Lock()
        handle.on_update(self._on_update)

    @staticmethod
    def took_the_key() -> bool:
        """For a command of the arrow keys: whether an input that has the focus took the key as well. Sleeps a moment."""
        time.sleep(KEY_SETTLES)
        return time.monotonic() - Control._last_touch < 10 * KEY_SETTLES

    def show(self, value: T) -> None:
        """Show what the session says, unless someone has their hand on the input; send what settled."""
        idle = self._clock() - self._touched
        with self._lock:
            client = self._waiting if idle >= self._settle else None
            if client is not None:
                self._waiting = None
        if client is not None:
            self._apply(client)
        elif idle > HANDS_OFF + self._settle:
            self.handle.value = self._shown(value)

    def enable(self, enabled: bool) -> None:
        self.handle.disabled = not enabled

    async def _on_update(self, event: viser.GuiEvent) -> None:
        # Async, so that it runs with the message itself: in viser's pool of threads it may come so late that `show`
        # has put the session's value over the new one, which is then what would be sent.
        if event.client is None:
            return  # `show` wrote it; sending it back would make an endless exchange.
        # Keys are of this moment, whatever the clock of the page says.
        self._touched, Control._last_touch = self._clock(), time.monotonic()
        if self._settle:
            with self._lock:
                self._waiting = event.client
        else:
            self._apply(event.client)

    def _apply(self, client: viser.ClientHandle) -> None:
        # Callbacks run in a pool of threads and finish in any order: the handle has the newest.
        with refusals_told(client, then=self._let_go):
            self._send(self._read(self.handle.value))

    def _let_go(self) -> None:
        self._touched = -1e9

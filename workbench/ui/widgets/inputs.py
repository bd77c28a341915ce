"""One input of the page whose truth is in the session.

Three parties may set a value: the person at the input, a key or a second page, and the session
itself (a value that it refuses). The input only asks, the session decides, and the page shows what
the session says. Two things go wrong if that is done plainly. A value that comes back while the
person still drags would pull the slider out of their hand: so an input that was touched a moment
ago is left alone. And each key stroke in a text field would be applied: so an input may ask to be
left to settle first.

Each folder has a bar under its own button, and the one that was pressed last shows what runs: one bar above all would
push the pressed button away, one at the end is not seen. A result is brought into sight for a moment only (HTML carries
``into_sight.html`` while it is new): a tab that is opened again draws its HTML anew, and nobody wants to be taken there.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, Generic, Literal, TypeVar

import viser

from workbench.session.live.session import Session
from workbench.session.process.job_lane import Progress
from workbench.ui.widgets.parts import Clock
from workbench.ui.widgets.templates import render

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


# --- How far work in the background is, and the way into sight for what came of it ------------


JUST = 1.0
"""Seconds."""


class Arrival:
    def __init__(self) -> None:
        self._before: object = None
        self._waiting = False
        self._came = -1e9

    def asked(self, now: object) -> None:
        """Something was asked for, which is to come in place of what there is now."""
        self._before, self._waiting = now, True

    def just_came(self, now: object) -> bool:
        """Whether it came a moment ago. To be asked at every draw, with what there is."""
        if self._waiting and now is not self._before and now:
            self._waiting, self._came = False, time.monotonic()
        return time.monotonic() - self._came < JUST


SHORT = 0.5
"""Seconds that something may take without a bar."""


class Answer:
    """What is asked for with the button above, in the present container: a bar while it runs, and then what came of it."""

    _asked_last: ClassVar[Answer | None] = None

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        gui = server.gui
        self._bar = gui.add_html("", visible=False)
        self._stop = gui.add_button("Stop", icon=viser.Icon.PLAYER_STOP, color="gray", visible=False)
        self._stop.on_click(lambda _: session.studio.judging.stop())
        self._html = gui.add_html("", visible=False)
        self._began: float | None = None
        self._arrival = Arrival()
        self._drawn: object = None

    def asked(self, now: object) -> None:
        """What runs from now on was asked for here, and is to come in place of what there is now."""
        Answer._asked_last = self
        self._arrival.asked(now)

    def draw(self, running: Progress | None, came: object, told: object, html: Callable[[bool], str]) -> None:
        """Draw what is new.

        Args:
            came: what is to be shown, if anything.
            told: what else is to be seen in its HTML; compared.
            html: makes that of it, given whether it came a moment ago.
        """
        self._draw_bar(running)
        new = self._arrival.just_came(came)
        if (wanted := (id(came), told, new)) != self._drawn:
            self._drawn = wanted
            self._html.visible = bool(came)
            if came:
                self._html.content = html(new)

    def _draw_bar(self, running: Progress | None) -> None:
        if running is None or Answer._asked_last is not self:
            self._began = None
        elif self._began is None:
            self._began = time.monotonic()
        shown = self._began is not None and time.monotonic() - self._began >= SHORT
        for handle in (self._bar, self._stop):
            handle.visible = shown
        if shown:
            self._bar.content = render("camera_progress", running=running)

"""HTML elements that can be pressed like viser's buttons, by mouse, touch or keyboard."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Hashable
from weakref import WeakKeyDictionary

import viser

from workbench.ui.server.control_values import name_control
from workbench.ui.server.viser_private import element_id
from workbench.ui.widgets.templates import render

PLACE_STEPS = 10_000
"""Steps from one border of a picture to the other, as ``pressed.js`` counts them."""
NUMBERS = 10**8
"""What ``pressed.js`` sends of a row or a place is below this."""
MOST_SECONDS_BEFORE = 0.5
"""How long an action of a page waits for the action before it."""
_LAST = 1e6
"""viser's order of elements: the hidden ones come after all others of their container."""
_asked_last: WeakKeyDictionary[object, asyncio.Event] = WeakKeyDictionary()
"""By page: set when its last action is done. Used on the server's event loop only."""


async def in_turn(client: object, do: Callable[[], None]) -> None:
    """Run an action of a page on a thread, after the action before it of the same page.

    viser's own threads take presses and keys in any order: Enter right after a press on a row opened the row that had
    been selected before. Await it in a callback that viser runs on its loop, which keeps the order of the messages.
    """
    before, done = _asked_last.get(client), asyncio.Event()
    _asked_last[client] = done
    try:
        if before is not None:
            # A slow action must not block the page.
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(before.wait(), MOST_SECONDS_BEFORE)
        await asyncio.to_thread(do)
    finally:
        done.set()


class Presses:
    """The hidden buttons and inputs of one container. Make it inside the container.

    viser's HTML is one-way, and its buttons cannot be rows of a table. So a row carries the id of a hidden viser button
    (``.wb-presses`` in page.css) in ``data-press``, and ``pressed.js`` presses that button. The server
    learns no more than "this button was pressed".

    A position in a picture (``data-place``) and a row of a long table with shift or control (``data-numbers``)
    are whole numbers written into a hidden number input, with a counter, since an input whose value stays the same
    sends nothing. The Tab key reaches such parts, and Enter or Space presses them (``pressed_by_key.js``).

    The mouse counts when it goes down: a table that is redrawn a few times a second would lose the click of a person
    whose finger is still on the button. A touch counts as a click, or scrolling would press.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        # Everything after this mark in its container is hidden by the style sheet.
        server.gui.add_html(render("presses"), order=_LAST)
        self._folder = server.gui.add_folder(None, order=_LAST + 1)
        self._ids: dict[Hashable, str] = {}

    def id_of(self, key: Hashable, pressed: Callable[[viser.ClientHandle | None], None]) -> str:
        """The id to put into ``data-press``; the same key always gives the same button.

        Args:
            pressed: called with the page that pressed it, on a thread, in turn.
        """
        if key not in self._ids:
            with self._folder:
                button = self._server.gui.add_button("·")
            name_control(button, _in_words(key))

            async def clicked(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
                await in_turn(event.client, lambda: pressed(event.client))

            button.on_click(clicked)
            self._ids[key] = element_id(button)
        return self._ids[key]

    def when_unfolded(self, unfolded: Callable[[], None]) -> None:
        """Call this whenever the container's panel is unfolded, also by viser's own buttons.

        Args:
            unfolded: called on a thread, in turn, once a page (``unfolded.js``).
        """
        pressed = self.id_of("unfolded", lambda _: unfolded())
        self._server.gui.add_html(render("unfolded", id=pressed), order=_LAST + 2)

    def when_drawn_in_software(self, told: Callable[[viser.ClientHandle | None], None]) -> None:
        """Call this with each page that draws its view in software.

        Args:
            told: called on a thread, in turn, once a page (``unfolded.js``).
        """
        pressed = self.id_of("drawn in software", told)
        self._server.gui.add_html(render("in_software", id=pressed), order=_LAST + 2)

    def number_id(self, key: Hashable, pressed: Callable[[int], None]) -> str:
        """The id to put into ``data-numbers`` around the rows; the same key always gives the same input.

        Args:
            pressed: called with the number that was pressed, below `NUMBERS`, on a thread, in turn.
        """
        return self._typed(key, lambda sent, _: pressed(sent % NUMBERS))

    def number_of_page_id(self, key: Hashable, pressed: Callable[[viser.ClientHandle, int], None]) -> str:
        """As `number_id`; `pressed` gets the page, too."""
        return self._typed(key, lambda sent, client: pressed(client, sent % NUMBERS))

    def place_id(self, key: Hashable, pressed: Callable[[float, float], None]) -> str:
        """The id to put into ``data-place``; the same key always gives the same input.

        Args:
            pressed: called with column and row in the picture, (0, 0) at its upper left corner and (1, 1) at its
                lower right one, on a thread, in turn.
        """
        return self._typed(key, lambda sent, _: pressed(*place_of(sent)))

    def _typed(self, key: Hashable, take: Callable[[int, viser.ClientHandle], None]) -> str:
        """The id of a hidden number input; `take` gets what is written into it."""
        if key not in self._ids:
            with self._folder:
                number = self._server.gui.add_number("·", 0, min=0)
            name_control(number, _in_words(key))

            async def typed(event: viser.GuiEvent[viser.GuiNumberHandle[int]]) -> None:
                # Read now, before the next message changes it: a double click on a recording sends three.
                sent, client = event.target.value, event.client
                if client is not None:
                    await in_turn(client, lambda: take(sent, client))

            number.on_update(typed)
            self._ids[key] = element_id(number)
        return self._ids[key]


class Paged:
    """Which page of a long list is shown, `most` rows at a time. Thread-safe."""

    def __init__(self, most: int) -> None:
        self._most, self.first, self._count = most, 0, 0

    def go_to(self, place: int) -> None:
        """Show the page that holds this row; `places` clamps it to the list."""
        self.first = max(place, 0) // self._most * self._most

    def turn(self, by: int) -> None:
        """Move by this many pages."""
        self.go_to(self.first + by * self._most)

    def places(self, count: int) -> range:
        """The rows to show of a list of this length."""
        self._count = count
        if self.first >= count:
            self.go_to(count - 1)
        return range(self.first, min(self.first + self._most, count))

    def shown(self, press: Callable[[str, Callable[[], None]], str]) -> dict[str, object] | None:
        """For a template: first, last, count, and the ids of the buttons; None where one page holds all rows.

        Args:
            press: the id of the button that runs a function.
        """
        if self._count <= self._most:
            return None
        back, on = press("back", lambda: self.turn(-1)), press("on", lambda: self.turn(1))
        last = min(self.first + self._most, self._count)
        return {"first": self.first + 1, "last": last, "of": self._count, "back": back, "on": on}


def _in_words(key: Hashable) -> str:
    return " ".join(_in_words(part) for part in key) if isinstance(key, tuple) else str(key)


def place_of(number: int) -> tuple[float, float]:
    """Column and row in 0..1 of what ``pressed.js`` sends of a place."""
    place = number % PLACE_STEPS**2
    return (place // PLACE_STEPS) / (PLACE_STEPS - 1), (place % PLACE_STEPS) / (PLACE_STEPS - 1)

"""Parts of our own HTML that can be pressed, as buttons can.

viser's HTML is one-way, and what it has for pressing (a button, a group of them) cannot be a row of a table with
a curve in it. But each viser button is an element with an id, and pressing it sends what it always sends. So a
pressable part of a table carries the id of a button that is in the page and not seen (``.wb-presses`` in
page.css), and two handlers on the table, fixed text of a template (``pressable.html``), press it. Nothing from the
page becomes more than "this button was pressed", which the server knows how to take.

Where in a picture somebody pressed is a number of the page, and takes another way: ``placeable.html`` writes it into
a number input of viser's that is not seen either, as if it had been typed. One whole number says both coordinates, in
ten-thousandths of the picture, and a running part, since an input that is given the value that it has says nothing.

A table of thousands of rows, of which a press with shift or control means another thing, takes that way too
(``choosable.html``): a row has a number, and the number that is written into the input is eight times that, and what
was held.

Whoever has no mouse walks to such a part with the Tab key and presses it with Enter or Space (``pressed_by_key.js``): the
templates write both the id and the stop of the Tab key with the macro ``press`` (``can_be_pressed.html``).

The mouse counts when it goes down: a table that is drawn anew a few times a second would lose the click of a
person whose finger is still on the button. A touch counts as a click, or scrolling would press.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Hashable
from weakref import WeakKeyDictionary

import viser

from workbench.ui.server.control_values import name_control
from workbench.ui.server.viser_private import element_id
from workbench.ui.widgets.templates import render

PARTS = 10_000
"""Steps from one border of a picture to the other, as ``placeable.html`` counts them."""
NUMBERS = 10**8
"""What ``choosable.html`` sends is below this."""
MOST_SECONDS_BEFORE = 0.5
"""For which what a page asks for waits for what it asked for before."""
_LAST = 1e6
"""viser's order of elements: the hidden ones come after all others of their container."""
_asked_last: WeakKeyDictionary[object, asyncio.Event] = WeakKeyDictionary()
"""Of each page: set once it is done. Of the loop of its server alone."""


async def in_turn(client: object, do: Callable[[], None]) -> None:
    """Do on a thread what a page asks for, after what the same page asked for before.

    viser's own threads take presses and keys in any order: Enter right after a press on a row opened what had been
    selected before. To be awaited by what viser calls on its loop, which is in the order of the messages.
    """
    before, done = _asked_last.get(client), asyncio.Event()
    _asked_last[client] = done
    try:
        if before is not None:
            # What takes longer does not keep the page waiting.
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(before.wait(), MOST_SECONDS_BEFORE)
        await asyncio.to_thread(do)
    finally:
        done.set()


class Presses:
    """The hidden buttons of one container. Make it inside of the container."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        # Everything after this mark in its container is hidden by the style sheet.
        server.gui.add_html(render("presses"), order=_LAST)
        self._folder = server.gui.add_folder(None, order=_LAST + 1)
        self._ids: dict[Hashable, str] = {}

    def id_of(self, key: Hashable, pressed: Callable[[viser.ClientHandle | None], None]) -> str:
        """The id to put into ``data-press``; the same key is the same button for good.

        Args:
            pressed: called with the page that did it, on a thread, in turn.
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
        """Call this whenever the panel that the container is in comes into a page: by viser's own buttons too.

        Args:
            unfolded: called on a thread, in turn, once a page; `unfolded.js` says how.
        """
        pressed = self.id_of("unfolded", lambda _: unfolded())
        self._server.gui.add_html(render("unfolded", id=pressed), order=_LAST + 2)

    def number_id(self, key: Hashable, pressed: Callable[[int], None]) -> str:
        """The id to put into ``data-numbers`` around ``choosable.html``; the same key is the same input for good.

        Args:
            pressed: called with the number that was pressed, below `NUMBERS`, on a thread, in turn.
        """
        return self._typed(key, lambda sent: pressed(sent % NUMBERS))

    def place_id(self, key: Hashable, pressed: Callable[[float, float], None]) -> str:
        """The id to put into ``data-place``; the same key is the same input for good.

        Args:
            pressed: called with the place in the picture, 0, 0 at its upper left corner and 1, 1 at its lower right
                one, on a thread, in turn.
        """
        return self._typed(key, lambda sent: pressed(*place_of(sent)))

    def _typed(self, key: Hashable, take: Callable[[int], None]) -> str:
        """The id of a hidden input whose number is taken."""
        if key not in self._ids:
            with self._folder:
                number = self._server.gui.add_number("·", 0, min=0)
            name_control(number, _in_words(key))

            async def typed(event: viser.GuiEvent[viser.GuiNumberHandle[int]]) -> None:
                # Read with its own message: a recording that is pressed twice is selected and opened by three.
                sent, client = event.target.value, event.client
                if client is not None:
                    await in_turn(client, lambda: take(sent))

            number.on_update(typed)
            self._ids[key] = element_id(number)
        return self._ids[key]


class Paged:
    """Which page of a long list is shown, of `most` at a time. From any thread."""

    def __init__(self, most: int) -> None:
        self._most, self.first, self._count = most, 0, 0

    def go_to(self, place: int) -> None:
        """To the page of a place; `places` takes the nearest that there is."""
        self.first = max(place, 0) // self._most * self._most

    def turn(self, by: int) -> None:
        """Go on by so many pages."""
        self.go_to(self.first + by * self._most)

    def places(self, count: int) -> range:
        """What is shown of a list that is so long now."""
        self._count = count
        if self.first >= count:
            self.go_to(count - 1)
        return range(self.first, min(self.first + self._most, count))

    def shown(self, press: Callable[[str, Callable[[], None]], str]) -> dict[str, object] | None:
        """For a template: from where to where, of how many, and the ids of the buttons; None where one page has all.

        Args:
            press: gives what turns the page an id.
        """
        if self._count <= self._most:
            return None
        back, on = press("back", lambda: self.turn(-1)), press("on", lambda: self.turn(1))
        last = min(self.first + self._most, self._count)
        return {"first": self.first + 1, "last": last, "of": self._count, "back": back, "on": on}


def _in_words(key: Hashable) -> str:
    return " ".join(_in_words(part) for part in key) if isinstance(key, tuple) else str(key)


def place_of(number: int) -> tuple[float, float]:
    """Column and row in 0..1 of what ``placeable.html`` sends."""
    place = number % PARTS**2
    return (place // PARTS) / (PARTS - 1), (place % PARTS) / (PARTS - 1)

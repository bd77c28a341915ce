"""Where in a picture, or on which row, somebody pressed, as one number of a page that may send anything."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections.abc import Callable

import pytest

from tests.drive.panels import Panels
from workbench.ui.widgets.click_targets import Paged, Presses, in_turn


@pytest.mark.parametrize("sent", [True, "12", None, -1, 0.5, math.nan, math.inf, 2**60, 1e300, (1, 2)])
def test_what_no_page_of_ours_sends_is_no_press(panels: Panels, sent: object) -> None:
    came: list[object] = []
    presses = Presses(panels.server)
    presses.place_id("place", lambda *place: came.append(place))
    presses.number_id("number", came.append)
    for name in ("place", "number"):
        panels.claim(name, sent)
    assert came == [] and len(panels.client.notices) == 2


def test_what_a_page_counts_in_is_what_its_script_says(panels: Panels) -> None:
    """``pressed.js``: a row by eights below 1e8, a place in ten-thousandths, down and across from the upper left corner."""
    came: list[object] = []
    presses = Presses(panels.server)
    presses.number_id("number", lambda sent, *_: came.append(sent))
    presses.place_id("place", lambda column, row, *_: came.append((column, row)))
    panels.claim("number", 3 * 1e8 + 99_999_999)
    panels.claim("place", 7 * 1e8 + 2500 * 10_000 + 9999)
    panels.claim("place", 88 * 1e8 + 9999 * 10_000)
    assert came == [99_999_999, (2500 / 9999, 1.0), (1.0, 0.0)]


def test_the_same_key_is_the_same_part_and_what_was_said_of_it_first_stays(panels: Panels) -> None:
    came: list[object] = []
    presses = Presses(panels.server)
    first = presses.id_of(("row", 2), lambda client: came.append(client))
    assert presses.id_of(("row", 2), lambda client: came.append("later")) == first
    assert presses.id_of(("row", 3), lambda client: came.append("another")) != first
    panels.claim("row 2", True, "button")
    assert came == [panels.client]
    number = presses.number_id("n", lambda sent, *_: came.append(sent))
    assert presses.number_id("n", lambda *_: came.append("later")) == number
    panels.claim("n", 5)
    assert came[1:] == [5]


def test_a_panel_that_comes_into_a_page_presses_a_button(panels: Panels) -> None:
    came: list[str] = []
    presses = Presses(panels.server)
    presses.when_unfolded(lambda: came.append("unfolded"))
    pressed = presses.id_of("unfolded", lambda client: came.append("another"))
    assert panels.html(f'data-unfolded="{pressed}"') and came == []
    panels.press("unfolded")
    assert came == ["unfolded"]


class Page:
    """Who asks."""


def test_what_a_page_asks_for_is_done_in_the_order_in_which_it_came() -> None:
    came: list[tuple[str, int]] = []
    one, other = Page(), Page()

    def slower_first(name: str, number: int) -> None:
        time.sleep(0.005 * (10 - number))
        came.append((name, number))

    async def ask_all() -> None:
        asked = [
            in_turn(page, lambda name=name, k=k: slower_first(name, k))
            for k in range(10)
            for page, name in ((one, "one"), (other, "other"))
        ]
        await asyncio.gather(*asked)

    asyncio.run(ask_all())
    for name in ("one", "other"):
        assert [number for who, number in came if who == name] == list(range(10))


def test_what_fails_or_takes_long_does_not_keep_the_page_waiting() -> None:
    page, long = Page(), threading.Event()
    came: list[str] = []

    def fail() -> None:
        raise LookupError("of a test")

    async def ask_all() -> None:
        asked = [in_turn(page, fail), in_turn(page, lambda: came.append("after the failure"))]
        ended = await asyncio.gather(*asked, return_exceptions=True)
        assert isinstance(ended[0], LookupError) and ended[1] is None
        first = asyncio.create_task(in_turn(page, lambda: came.append(str(long.wait(60)))))
        await asyncio.wait_for(in_turn(page, lambda: came.append("beside it")), 30)
        long.set()
        await first

    asyncio.run(ask_all())
    assert came == ["after the failure", "beside it", "True"]


def test_a_long_list_is_shown_a_page_at_a_time_whatever_its_length_becomes() -> None:
    pages = Paged(10)
    made: dict[str, Callable[[], None]] = {}

    def press(key: str, do: Callable[[], None]) -> str:
        made[key] = do
        return f"id of {key}"

    assert pages.places(10) == range(10) and pages.shown(press) is None and not made
    assert pages.places(0) == range(0)
    assert pages.places(23) == range(10)
    assert pages.shown(press) == {"first": 1, "last": 10, "of": 23, "back": "id of back", "on": "id of on"}
    made["on"]()
    assert pages.places(23) == range(10, 20)
    made["back"]()
    made["back"]()
    assert pages.places(23) == range(10), "nothing is before the first"
    pages.turn(5)
    assert pages.places(23) == range(20, 23), "nothing is behind the last"
    shown = pages.shown(press)
    assert shown is not None and (shown["first"], shown["last"]) == (21, 23)
    assert pages.places(20) == range(10, 20), "its page is gone"
    pages.go_to(9)
    assert pages.first == 0
    pages.go_to(10)
    assert pages.places(11) == range(10, 11)

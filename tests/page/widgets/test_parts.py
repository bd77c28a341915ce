from __future__ import annotations

import pytest

from tests.drive.panels import Clock
from workbench.page.widgets.parts import DrawThrottle, PagePart, Parts


class Plain(PagePart[int]):
    def __init__(self) -> None:
        self.drawn: list[int] = []

    def draw(self, view: int) -> None:
        self.drawn.append(view)


@pytest.fixture
def due(clock: Clock) -> DrawThrottle:
    return DrawThrottle(0.5, clock)


def test_a_new_value_waits_until_the_last_could_be_read(due: DrawThrottle, clock: Clock) -> None:
    assert due.is_due(1)
    clock.passes(0.25)
    assert not due.is_due(2)
    clock.passes(0.25)
    assert due.is_due(2) and not due.is_due(3)


def test_an_urgent_value_is_drawn_at_once_and_counts_as_drawn(due: DrawThrottle, clock: Clock) -> None:
    assert due.is_due(1) and due.is_due(1, urgent="pressed") and not due.is_due(1, urgent="pressed")
    clock.passes(0.25)
    assert not due.is_due(3, urgent="pressed")
    clock.passes(0.25)
    assert due.is_due(3, urgent="pressed")


class Halves(PagePart[int]):
    """Shows half of a number; large ones are urgent."""

    every = 0.5

    def __init__(self) -> None:
        self.drawn: list[int] = []

    def key(self, view: int) -> object:
        return view // 2

    def urgent(self, view: int) -> object:
        return view > 99

    def draw(self, view: int) -> None:
        self.drawn.append(view)


def test_each_part_of_a_page_is_drawn_when_its_content_changes(clock: Clock) -> None:
    halves, plain = Halves(), Plain()
    parts = Parts((halves, plain), clock)
    for view, seconds in ((2, 0.0), (3, 9.0), (4, 0.0), (6, 0.25), (100, 0.0), (102, 0.25), (102, 0.25)):
        clock.passes(seconds)
        parts.draw(view)
    assert halves.drawn == [2, 4, 100, 102]
    assert plain.drawn == [2, 3, 4, 6, 100, 102, 102], "without a key each view is drawn"

from __future__ import annotations

from typing import Any, cast

import pytest

from tests.drive.panels import Clock
from workbench.page.command import Command, Refused
from workbench.page.commands import ToggleTable, ToggleTheme
from workbench.page.widgets.parts import DrawThrottle, PagePart, Parts
from workbench.page.widgets.visitors import Visitor


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


class Moment(Halves):
    """Shows numbers of the shown moment."""

    of_the_moment = True


def test_parts_of_the_shown_moment_are_drawn_together_unless_hidden(clock: Clock) -> None:
    slow, fast, other, hidden = Moment(), Moment(), Halves(), Moment()
    fast.every = 0.1  # type: ignore[misc]
    parts: Parts[int] = Parts((slow, fast, other), clock)
    parts.add(hidden, lambda view: False)
    for view, seconds in ((2, 0.0), (4, 0.2), (6, 0.05), (8, 0.1), (8, 5.0), (10, 0.5)):
        clock.passes(seconds)
        parts.draw(view)
    assert fast.drawn == [2, 4, 8, 10] == slow.drawn, "the same views"
    assert other.drawn == [2, 10] or other.drawn == [2, 8, 10]
    assert hidden.drawn == [2, 8]


def test_a_hidden_part_is_drawn_rarely_and_at_once_when_it_is_shown(due: DrawThrottle, clock: Clock) -> None:
    assert due.is_due(1, hidden=True), "it must not open empty"
    clock.passes(1.9)
    assert not due.is_due(2, urgent="pressed", hidden=True)
    clock.passes(0.2)
    assert due.is_due(2, hidden=True) and not due.is_due(2, hidden=True)
    clock.passes(0.6)
    assert not due.is_due(3, hidden=True) and due.is_due(3)


class Counts(PagePart[int]):
    does = (ToggleTable,)

    def __init__(self) -> None:
        self.did: list[Command] = []

    def do(self, command: Command, visitor: Visitor) -> None:
        self.did.append(command)


def test_a_command_goes_to_its_part_and_one_without_a_part_is_refused() -> None:
    one, nobody = Counts(), cast(Any, None)
    parts = Parts[int]((Plain(), one))
    parts.do(ToggleTable(), nobody)
    assert one.did == [ToggleTable()] and parts.does == {ToggleTable}
    with pytest.raises(Refused):
        parts.do(ToggleTheme(), nobody)
    with pytest.raises(AssertionError):
        parts.add(Counts())

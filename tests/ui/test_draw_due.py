from __future__ import annotations

import pytest

from tests.drive.panels import Clock
from workbench.ui.draw_due import DrawDue


@pytest.fixture
def due(clock: Clock) -> DrawDue:
    return DrawDue(0.5, clock)


def test_what_was_never_drawn_is_due_whatever_it_is(due: DrawDue) -> None:
    assert due.is_due(None)


def test_the_same_is_not_drawn_again_however_long_it_stands(due: DrawDue, clock: Clock) -> None:
    assert due.is_due(1)
    clock.passes(1e6)
    assert not due.is_due(1) and not due.is_due(1, at_once=True)


def test_something_new_waits_until_the_last_could_be_read(due: DrawDue, clock: Clock) -> None:
    assert due.is_due(1)
    clock.passes(0.25)
    assert not due.is_due(2)
    clock.passes(0.25)
    assert due.is_due(2) and not due.is_due(3)


def test_what_somebody_waits_for_is_drawn_at_once_and_counts_as_drawn(due: DrawDue, clock: Clock) -> None:
    assert due.is_due(1) and due.is_due(2, at_once=True)
    clock.passes(0.25)
    assert not due.is_due(3)

"""A long list is shown some rows at a time."""

from __future__ import annotations

from workbench.commands.envs import TurnEnvs
from workbench.ui.widgets.paged import Paged


def turn(by: int) -> TurnEnvs:
    return TurnEnvs(by=by)


def test_a_long_list_is_shown_a_page_at_a_time_whatever_its_length_becomes() -> None:
    pages = Paged(10)
    assert pages.places(10) == range(10) and pages.shown(turn) is None
    assert pages.places(0) == range(0)
    assert pages.places(23) == range(10)
    assert pages.shown(turn) == {"first": 1, "last": 10, "of": 23, "back": turn(-1), "on": turn(1)}
    pages.turn(1)
    assert pages.places(23) == range(10, 20)
    pages.turn(-1)
    pages.turn(-1)
    assert pages.places(23) == range(10), "nothing is before the first"
    pages.turn(5)
    assert pages.places(23) == range(20, 23), "nothing is behind the last"
    shown = pages.shown(turn)
    assert shown is not None and (shown["first"], shown["last"]) == (21, 23)
    assert pages.places(20) == range(10, 20), "its page is gone"
    pages.go_to(9)
    assert pages.first == 0
    pages.go_to(10)
    assert pages.places(11) == range(10, 11)

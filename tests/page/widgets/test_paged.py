"""Paging of a long list."""

from __future__ import annotations

from workbench.live.env_commands import TurnEnvs
from workbench.page.widgets.paged import Paged


def turn(by: int) -> TurnEnvs:
    return TurnEnvs(by=by)


def test_a_long_list_is_shown_page_by_page_while_its_length_changes() -> None:
    pages = Paged(10)
    assert pages.places(10) == range(10) and pages.shown(10, turn) is None
    assert pages.places(0) == range(0)
    assert pages.places(23) == range(10)
    assert pages.shown(23, turn) == {"first": 1, "last": 10, "of": 23, "back": turn(-1), "on": turn(1)}
    second = pages.turned(1, 23)
    assert second.places(23) == range(10, 20)
    assert second.turned(-1, 23).turned(-1, 23).places(23) == range(10), "there is no page before the first"
    last = second.turned(5, 23)
    assert last.places(23) == range(20, 23), "there is no page after the last"
    shown = last.shown(23, turn)
    assert shown is not None and (shown["first"], shown["last"]) == (21, 23)
    assert last.places(20) == range(10, 20), "its page no longer exists"
    assert last.turned(-1, 20).places(20) == range(10), "the page before the shown one"
    assert last.places(0) == range(0)
    assert last.at(9).places(11) == range(10)
    assert last.at(10).places(11) == range(10, 11)

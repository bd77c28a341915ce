"""The table of envs on the live page."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.drive.env_rows import FELL, rows_of
from tests.drive.live import Live
from tests.drive.scenes import running
from workbench.live.env_commands import (
    NextFailedEnv,
    NextFlaggedEnv,
    ShowEnvAtEvent,
    ShowFirstFlagged,
    SortEnvs,
    ToggleEnvEntries,
    ToggleEnvEntry,
    TurnEnvs,
)
from workbench.live.events import EnvEventShown, EpisodeStepShown, SettingsChanged
from workbench.live.history.env_table import KEPT_REWARDS, EnvRows, LastEpisode
from workbench.live.panels.env_panel import FILTERS, ROWS_PER_PAGE, TABLE
from workbench.page.command import Command
from workbench.page.commands import TellUnfolded, ToggleTable

pytestmark = pytest.mark.thorough

MANY = ROWS_PER_PAGE + 6


def many(**changes: Any) -> EnvRows:
    """Enough envs for two pages of the table; odd ones have failed, the last two are flagged."""
    none, odd = np.zeros(MANY, np.int32), np.arange(MANY) % 2
    last = LastEpisode(np.where(odd, 2, 0).astype(np.int8), none, np.zeros(MANY), {})
    values: dict[str, Any] = {
        "outcome": none.astype(np.int8),
        "steps": none,
        "end": none - 1,
        "total": np.arange(MANY, dtype=float),
        "followed": np.ones(MANY, bool),
        "first": {"<b>odd</b>": odd - 1, "success": none - 1},
        "rewards": np.full((MANY, KEPT_REWARDS), np.nan, np.float32),
        "outliers": {MANY - 2: (FELL,), MANY - 1: (FELL,)},
        "last": last,
        "ended": odd,
        "succeeded": none,
        "failed": none,
    }
    return rows_of(**{**values, **changes})


class Table:
    """The table on a page, operated by a test."""

    def __init__(self, live: Live) -> None:
        self.live = live

    def show(
        self, step: int = 1, seconds: float = 60.0, env: int = 0, rows: EnvRows | None = None
    ) -> list[int]:
        self.live.show(running(MANY, step_serial=step, selected_env=env), rows or many(), seconds)
        return self.envs()

    def envs(self) -> list[int]:
        return [int(env) for env in re.findall(r'data-env="(\d+)"', self.html)]

    @property
    def html(self) -> str:
        return self.live.part("Envs").html()

    def choose(self, shown: str) -> list[int]:
        self.live.part("Envs").set("Show", shown)
        self.live.again(0.1)
        return self.envs()

    def ask(self, command: Command) -> list[int]:
        self.live.part("Envs").ask(command)
        self.live.again(0.1)  # two frames
        return self.envs()


@pytest.fixture
def table(live_page: Live) -> Table:
    table = Table(live_page)
    table.show()
    live_page.do(ToggleTable())
    table.show()
    return table


def test_pages_filters_and_rows_can_be_pressed(table: Table) -> None:
    assert table.envs() == list(range(ROWS_PER_PAGE))
    assert table.ask(TurnEnvs(by=1)) == list(range(ROWS_PER_PAGE, MANY))
    table.ask(ShowEnvAtEvent(env=MANY - 3))
    assert table.live.asked == [SettingsChanged({"selected_env": MANY - 3})], "there is no moment to seek"
    table.ask(ShowEnvAtEvent(env=MANY - 1))
    assert table.live.asked[1:] == [EpisodeStepShown(MANY - 1, 12)]
    table.live.do(
        TurnEnvs(by=1)
    )  # pressed on a page that was drawn before the last page of the table was shown
    table.live.again()
    assert table.envs() == list(range(ROWS_PER_PAGE, MANY))
    assert table.choose("flagged") == [MANY - 2, MANY - 1]
    assert "&lt;b&gt;odd" in table.html and "<b>odd" not in table.html


def test_a_new_filter_or_order_starts_on_the_first_page(table: Table) -> None:
    table.ask(TurnEnvs(by=1))
    assert table.choose("running") == list(range(ROWS_PER_PAGE))
    assert table.choose("last episode without success") == list(range(1, MANY, 2))
    assert table.choose("all envs") == list(range(ROWS_PER_PAGE))
    table.ask(TurnEnvs(by=1))
    assert table.ask(SortEnvs(column="return")) == list(range(ROWS_PER_PAGE))
    table.ask(TurnEnvs(by=1))
    assert table.ask(SortEnvs(column="return")) == list(range(MANY - 1, MANY - 1 - ROWS_PER_PAGE, -1))
    assert table.ask(SortEnvs(column="env")) == list(range(ROWS_PER_PAGE)), (
        "a new column starts with its smallest value"
    )


def test_every_column_is_as_wide_as_its_longest_cell(table: Table) -> None:
    """Else a narrow panel cuts numbers off in place of leaving out a column."""

    def width(**changes: Any) -> int:
        table.show(table.live.session.shown.step_serial + 1, rows=many(**changes))
        return max(map(int, re.findall(r"max-width: (\d+)px", table.html)))

    entries = {name: np.zeros(MANY, np.int32) for name in ("far", "near", "on")}
    usual, big = width(first=entries), np.full(MANY, 10**9)
    assert width(first=entries, steps=big) > usual
    for name in entries:
        assert width(first={**entries, name: big}) > usual, name


def test_a_step_reaches_the_table_with_a_delay_and_a_press_at_once(table: Table) -> None:
    before = table.html
    later = many(steps=np.full(MANY, 5, np.int32))
    table.show(2, 0.0, rows=later)
    assert table.html == before, "the table was drawn a moment ago"
    table.show(2, 0.0, env=3, rows=later)
    assert "wb-selected" in table.html and table.html != before
    before = table.html
    table.show(3, 0.0, env=3, rows=many(steps=np.full(MANY, 6, np.int32)))
    table.ask(SortEnvs(column="return"))
    assert table.html != before


@pytest.mark.parametrize("by_hand", [True, False])
def test_the_key_toggles_the_table_however_it_was_opened(live_page: Live, by_hand: bool) -> None:
    assert live_page.is_folded("Envs")
    live_page.do(TellUnfolded(panel=TABLE) if by_hand else ToggleTable())
    if not by_hand:
        assert not live_page.is_folded("Envs")
        live_page.do(TellUnfolded(panel=TABLE))  # the message of a page
    for folded in (True, False, True):
        live_page.do(ToggleTable())
        assert live_page.is_folded("Envs") == folded


def test_a_folded_table_is_not_redrawn_on_steps(table: Table) -> None:
    def stepped(number: int) -> str:
        table.show(number, rows=many(steps=np.full(MANY, number, np.int32)))
        return table.html

    shown = stepped(4)
    assert stepped(5) != shown
    table.live.do(ToggleTable())
    folded = stepped(6)
    assert stepped(7) == folded
    table.live.do(ToggleTable())
    assert stepped(7) != folded, "unfolded it shows the current state"


def test_keys_cycle_through_failed_and_through_flagged_envs(table: Table) -> None:
    def after(env: int, command: Command) -> int:
        table.live.asked.clear()
        table.show(env=env)
        table.live.do(command)
        (asked,) = table.live.asked
        return asked.env

    assert [after(env, NextFailedEnv()) for env in (0, 1, MANY - 1)] == [1, 3, 1]
    assert [after(env, NextFlaggedEnv()) for env in (0, MANY - 2, MANY - 1)] == [
        MANY - 2,
        MANY - 1,
        MANY - 2,
    ]


def test_a_press_on_an_env_that_no_longer_exists_is_refused(table: Table) -> None:
    table.show()
    table.live.session.rows = rows_of()
    table.live.part("Envs").ask(ShowEnvAtEvent(env=40))
    assert table.live.asked == [] and "no env 40" in table.live.client.notices[-1]


@pytest.fixture
def small(live_page: Live) -> Table:
    """The table of six different envs, open."""
    live_page.do(ToggleTable())
    live_page.show(running(6, selected_env=4), rows_of())
    return Table(live_page)


def headings(table: Table) -> list[str]:
    return [re.sub("<wbr>|\xa0", "", one) for one in re.findall(r"<th [^>]*>([^\n]*)</th>", table.html)]


def test_the_table_marks_the_order_the_selected_env_and_counts_states(small: Table) -> None:
    assert re.findall(r'wb-tally wb-num" title="\D*(\d+)"', small.html) == ["3", "1", "1", "1"]
    assert re.findall(r'data-env="(\d)" class="wb-selected"', small.html) == ["4"]
    assert headings(small)[:3] == ["env↑", "state", "steps"]
    assert small.ask(SortEnvs(column="steps")) == [0, 4, 2, 5, 1, 3]
    assert headings(small)[:3] == ["env", "state", "steps↑"]
    assert small.ask(SortEnvs(column="steps")) == [3, 1, 5, 2, 0, 4]
    assert headings(small)[2] == "steps↓"
    assert small.ask(SortEnvs(column="steps")) == [0, 4, 2, 5, 1, 3]
    assert small.choose("flagged") == [5] and small.live.part("Envs").typed("Show") == "flagged"
    small.live.show(running(6), rows_of(outliers={}))
    assert small.envs() == [] and FILTERS["flagged"][1] in small.html
    small.live.show(running(6))
    assert small.live.part("Envs").field("Show").off, "no task is loaded"


def test_columns_of_entries_are_switched_on_and_off(small: Table) -> None:
    def entries() -> dict[str, str]:
        found = re.findall(r'aria-checked="(\w+)">(?:✓ )?([^<]*)<', small.html)
        return {name: on for on, name in found}

    assert entries() == {} and headings(small)[5:7] == ["success", "near"]
    small.ask(ToggleEnvEntries())
    assert entries() == {"success": "true", "near": "true"}
    small.ask(SortEnvs(column="first near"))
    assert small.envs() == [5, 0, 3, 1, 2, 4]
    small.ask(ToggleEnvEntry(name="near"))
    assert entries() == {"success": "true", "near": "false"} and "near" not in headings(small)
    assert small.envs() == [*range(6)], "sorted by a column that is gone"
    small.ask(ToggleEnvEntry(name="near"))
    assert entries()["near"] == "true" and small.envs() == [5, 0, 3, 1, 2, 4]
    small.ask(ToggleEnvEntries())
    assert entries() == {}
    never = np.full(6, -1, np.int32)
    small.live.show(running(6, step_serial=2), rows_of(first={f"is_{k}": never for k in range(9)}))
    assert headings(small)[5:-2] == [f"is_{k}" for k in range(6)]
    small.ask(ToggleEnvEntries())
    small.ask(ToggleEnvEntry(name="is_8"))
    assert headings(small)[5:-2] == [*(f"is_{k}" for k in range(6)), "is_8"]


def test_keys_go_to_the_event_that_there_is(small: Table) -> None:
    def asked(command: Command, **changes: Any) -> list[Any]:
        small.live.show(running(6, selected_env=4), rows_of(**changes))
        small.live.asked.clear()
        small.live.do(command)
        return small.live.asked

    ended = np.array([0, 1, 0, 3, 0, 0], np.int8)
    before = rows_of().last
    good = replace(before, outcome=np.ones(6, np.int8))
    flagged = replace(good, outliers={3: (FELL,), 2: (FELL,)})
    assert asked(NextFailedEnv()) == [EnvEventShown(2, "failed")]
    assert asked(NextFailedEnv(), outcome=ended, last=good) == [EnvEventShown(3, "limit")]
    assert asked(NextFlaggedEnv()) == [EnvEventShown(5, "flagged")] == asked(ShowFirstFlagged())
    assert asked(ShowFirstFlagged(), outliers={}, last=flagged) == [EnvEventShown(2, "flagged")]
    assert asked(NextFlaggedEnv(), outliers={}, last=flagged) == [EnvEventShown(2, "flagged")]
    assert asked(ShowFirstFlagged(), outliers={}) == []
    for command in (NextFlaggedEnv(), NextFailedEnv()):
        refused = len(small.live.client.notices)
        assert asked(command, outliers={}, outcome=ended * 0, last=good) == []
        assert len(small.live.client.notices) == refused + 1


def test_a_folded_table_is_that_of_a_new_task(small: Table) -> None:
    small.live.do(ToggleTable())
    before = small.html
    small.live.show(running(6, step_serial=9), rows_of(steps=np.arange(6, dtype=np.int32)))
    assert small.html == before
    small.live.show(running(6, step_serial=9, task_serial=2), rows_of(steps=np.arange(6, dtype=np.int32)))
    assert small.html != before, "its width is measured before it is opened"

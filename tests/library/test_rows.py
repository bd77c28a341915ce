from __future__ import annotations

import datetime
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from workbench.episodes.row import LibraryRow, clean_facts
from workbench.library.rows import COLUMNS, SECOND_LINE, Column, OpenVersion, cells, chosen, ordered

NOW = datetime.datetime(2026, 11, 21, 12, tzinfo=datetime.timezone.utc)


def row(id: str, **facts: Any) -> LibraryRow:
    kind = facts.pop("kind", "workbench")
    paths = facts.pop("paths", (Path(f"{id}.json"), Path(f"{id}.h5")))
    values = {"task": "Push-v1", "written": NOW.timestamp(), **facts}
    return LibraryRow(kind, **values, id=id, name=f"name-{id}", place=(id, 0), paths=paths, size=1000)


ROWS = (
    row("a", seed=3, length=9, total_reward=1.0, success=True, success_once=True, written=100.0, tags=("x",)),
    row(
        "b", seed=1, length=5, total_reward=-2.0, success=False, success_once=True, written=300.0, note="Odd"
    ),
    row("c", seed=30, length=7, success=False, fail=True, written=200.0, tags=("good", "demo")),
    row("d", task="Pick-v1", total_reward=8.0, success=False, written=50.0),
    row("e", task="", kind="rrd only", written=None, problem="e.rrd is broken."),
)


def ids(rows: list[LibraryRow]) -> str:
    return "".join(row.id for row in rows)


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("", "abcde"),
        ("push", "abc"),
        ("PUSH good", "c"),
        ("odd", "b"),
        ("seed:3", "a"),
        ("seed:x", ""),
        ("broken", "e"),
        ("name-d", "d"),
        ("good odd", ""),
    ],
)
def test_every_word_must_be_found(words: str, found: str) -> None:
    assert ids(chosen(ROWS, words)) == found


@pytest.mark.parametrize(
    ("column", "up", "down"),
    [
        ("date", "dacbe", "bcade"),
        ("seed", "bacde", "cabde"),
        ("return", "badce", "dabce"),
        ("success", "cdbae", "abdce"),
        ("tags", "cabde", "acbde"),
        ("note", "bcade", "bcade"),
        ("task", "dbcae", "bcade"),
    ],
)
def test_rows_without_a_value_sort_last_in_both_orders_and_ties_newest_first(
    column: Column, up: str, down: str
) -> None:
    assert ids(ordered(ROWS, column, False)) == up
    assert ids(ordered(ROWS, column, True)) == down


_facts = st.fixed_dictionaries(
    {},
    optional={
        "task": st.sampled_from(["", "A-v1", "b-v1"]),
        "seed": st.none() | st.integers(0, 3),
        "total_reward": st.none() | st.floats(-1, 1),
        "written": st.none() | st.floats(0, 10),
        "success": st.none() | st.booleans(),
        "tags": st.just(()) | st.just(("z", "B")),
        "source_hash": st.sampled_from(["", "aa", "bb"]),
    },
)


@given(st.lists(_facts, max_size=8), st.sampled_from([*COLUMNS, *SECOND_LINE]), st.booleans())
def test_no_row_is_lost_by_sorting(facts: list[dict[str, Any]], column: Column, descending: bool) -> None:
    rows = [row(str(k), **values) for k, values in enumerate(facts)]
    assert sorted(ids(ordered(rows, column, descending))) == sorted(ids(rows))
    for one in rows:
        cells(one, OpenVersion(one.task, "aa"), NOW)


def test_rows_of_another_source_version_than_the_open_task_are_marked() -> None:
    rows = [
        row("a", source_hash="old0123456789", written=1.0),
        row("b", source_hash="of a bug, and newest", written=3.0),
        row("c", source_hash="as it is now", written=2.0),
        row("d", source_hash="older", written=0.5, task="Pick-v1"),
        row("e"),
    ]
    shown = [cells(one, OpenVersion(rows[0].task, "as it is now"), NOW) for one in rows]
    assert [one["other_version"] for one in shown] == [True, True, False, False, False]
    assert [one["version"] for one in shown] == ["old0123", "of a bu", "as it i", "older", ""]
    assert not any(cells(one, None, NOW)["other_version"] for one in rows)


@pytest.mark.parametrize(
    ("facts", "outcome"),
    [
        ({"length": 12}, "no"),
        ({"length": 50, "max_episode_steps": 50}, "no"),
        ({"length": 12, "max_episode_steps": 50}, "stopped"),
        ({"length": 12, "max_episode_steps": 50, "fail": True}, "fail"),
        ({"length": 12, "max_episode_steps": 50, "success_once": True}, "once"),
    ],
)
def test_an_episode_that_was_stopped_is_not_shown_as_failed(facts: dict[str, Any], outcome: str) -> None:
    assert cells(row("a", success=False, **facts), None, NOW)["outcome"] == outcome


def test_a_nan_return_is_shown_and_sorts_last_in_both_orders() -> None:
    kept = clean_facts(row("n", total_reward=float("nan")))
    lost = row("n", total_reward=kept.total_reward)
    assert kept == clean_facts(replace(kept, total_reward=float("nan")))
    assert cells(lost, None, NOW)["total"] == "NaN"
    assert {ids(ordered((*ROWS[:2], lost), "return", down))[-1] for down in (True, False)} == {"n"}

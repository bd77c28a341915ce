from __future__ import annotations

import datetime
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from workbench.episodes.row import LibraryRow, clean_facts
from workbench.library.job_status import SILENT_SECONDS, JobFailure, JobStatus
from workbench.library.rows import (
    COLUMNS,
    MEANS,
    SECOND_LINE,
    Column,
    OpenVersion,
    Outcome,
    cells,
    chosen,
    count_recordings,
    in_words,
    job_text,
    none_like_that,
    ordered,
)

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


@pytest.mark.parametrize(
    ("outcome", "found"), [("all", "abcde"), ("success", "a"), ("no success", "bcd"), ("broken", "e")]
)
def test_a_filter_lists_the_rows_of_its_outcome_and_task(outcome: Outcome, found: str) -> None:
    assert ids(chosen(ROWS, outcome=outcome)) == found
    of_push = "".join(one for one in found if one in "abc")
    assert ids(chosen(ROWS, outcome=outcome, task="Push-v1")) == of_push
    assert "Push-v1" in none_like_that("", outcome, "Push-v1") and "odd" in none_like_that(
        " odd ", outcome, None
    )
    assert len({none_like_that("", one, None) for one in MEANS}) == len(MEANS)


def test_copies_and_exports_count_once() -> None:
    rows = [
        row("a", uid="u1"),
        row("b", uid="u1"),
        row("c", copy_of="u1", uid="u9"),
        row("d", uid="u2"),
        row("e", copy_of="u3"),
        row("f"),
        row("g"),
    ]
    assert count_recordings(rows) == 5
    both = (Path("x.json"), Path("x.h5"))
    words = in_words([row("a", paths=both), row("b", paths=both), row("c")])
    assert "3 recordings" in words and "4 files" in words and "2" in words, "the shared files count once"
    assert words.split("(")[1] == in_words([row("a", paths=both), row("c")]).split("(")[1]


def test_a_rows_cells_are_its_own_facts() -> None:
    zone = datetime.timezone(datetime.timedelta(hours=5))
    now = NOW.astimezone(zone)
    facts = {
        "env_index": 3,
        "control_mode": "pd_ee_delta_pose",
        "acted_by": "policy act.py",
        "total_reward": 2.5,
        "source_hash": "0123456789ab",
    }
    found = cells(row("a", **facts), None, now)
    assert (found["task"], found["total"], found["version"]) == ("Push-v1", "2.5", "0123456")
    for part in ("name-a", "env 3", "pd_ee_delta_pose", "act.py"):
        assert part in found["about"]
    assert found["when"].startswith("2026-11-21 17:00") and found["date"].startswith("17:00")
    assert not found["other_version"] and not found["remark"] and not found["outcome"]
    dates = [
        cells(row("a", written=(NOW - datetime.timedelta(days=days)).timestamp()), None, now)["date"]
        for days in (0, 1, 40, 400)
    ]
    assert "20 Nov" in dates[1] and ":" in dates[1] and "12 Oct" in dates[2] and "2025" in dates[3]
    assert cells(row("a", written=None), None, now)["date"] == ""
    broken = cells(row("a", task="", problem="it is broken"), None, now)
    assert (broken["task"], broken["total"]) == ("?", "") and "it is broken" in broken["about"]
    remarks = [
        cells(row("a", **given), None, now)["remark"]
        for given in (
            {"recovered": True},
            {"kind": "maniskill"},
            {"kind": "lerobot", "copy_of": "u1"},
            {"kind": "rrd only"},
            {"kind": "maniskill", "problem": "broken"},
        )
    ]
    assert len(set(remarks)) == 5 and not remarks[4] and "export" in remarks[2] and "export" not in remarks[1]


def test_a_jobs_text_is_its_state_its_rate_and_the_time_left() -> None:
    job = JobStatus("record", "push.py", 40, 100, rate=2.0, written_at=1000.0)

    def text(now: float = 1000.0, **changes: Any) -> str:
        return job_text(replace(job, **changes), now)

    assert "2.0 a second" in text() and "30 s" in text()
    failed = (JobFailure("3, 4", 20, "no", ""),)
    assert replace(job, failures=failed).failed == 20 and "20 s" in text(failures=failed)
    assert "a minute" in text(rate=0.05) and "3.0" in text(rate=0.05) and "20 min" in text(rate=0.05)
    assert "60 h" not in text(rate=0.0003) and " h" in text(rate=0.0003)
    assert "a second" not in text(rate=0) and "left" not in text(rate=0) and text(rate=0)
    states = [text(state=state) for state in ("done", "stopped", "failed")]
    assert len(set(states)) == 3 and not any("left" in one or "a second" in one for one in states)
    silent = 1000 + SILENT_SECONDS + 1
    assert text(silent) not in (text(), *states) and text(silent, state="done") == text(state="done")

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.drive.env_rows import rows_of
from workbench.live.history.env_table import KEPT_REWARDS, EnvRows
from workbench.live.panels.env_panel import FILTERS, columns, entry_names, make_rows, mask, moment_of, order


def cells_of(rows: EnvRows, envs: NDArray[np.int64]) -> list[SimpleNamespace]:
    return [SimpleNamespace(**row) for row in make_rows(rows, envs)]


@pytest.mark.parametrize(
    ("wanted", "envs"),
    [
        ("all", [0, 1, 2, 3, 4, 5]),
        ("unsolved", [2, 3, 4]),
        ("failed", [2, 4]),
        ("limit", [3]),
        ("running", [0, 4, 5]),
        ("flagged", [5]),
    ],
)
def test_filters(wanted: str, envs: list[int]) -> None:
    assert np.flatnonzero(mask(rows_of(), wanted)).tolist() == envs  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("column", "up", "down"),
    [
        ("env", [0, 1, 2, 3, 4, 5], [5, 4, 3, 2, 1, 0]),
        ("state", [2, 3, 0, 4, 5, 1], [1, 0, 4, 5, 3, 2]),
        ("return", [4, 0, 5, 2, 1, 3], [1, 2, 5, 0, 4, 3]),
        ("first near", [5, 0, 3, 1, 2, 4], [1, 3, 0, 5, 2, 4]),
        ("last", [4, 0, 1, 2, 3, 5], [0, 4, 1, 2, 3, 5]),
        ("flags", [5, 0, 1, 2, 3, 4], [5, 0, 1, 2, 3, 4]),
    ],
)
def test_sorting_keeps_ties_in_the_order_of_envs_and_puts_envs_without_a_value_last(
    column: str, up: list[int], down: list[int]
) -> None:
    assert order(rows_of(), column, False).tolist() == up
    assert order(rows_of(), column, True).tolist() == down


@given(
    st.lists(st.one_of(st.just(math.nan), st.floats(-1e6, 1e6)), min_size=6, max_size=6),
    st.booleans(),
    st.sampled_from(sorted(FILTERS)),
)
def test_any_returns_are_sorted_and_none_is_lost(totals: list[float], descending: bool, wanted: str) -> None:
    rows = rows_of(total=np.array(totals))
    for column in columns(rows):
        envs = order(rows, column, descending, wanted)  # type: ignore[arg-type]
        assert sorted(envs) == np.flatnonzero(mask(rows, wanted)).tolist()  # type: ignore[arg-type]
    shown = np.array(totals)[order(rows, "return", descending)]
    known = shown[~np.isnan(shown)]
    assert np.isnan(shown[len(known) :]).all()
    assert known.tolist() == sorted(known, reverse=descending)


def test_cells_show_the_state_of_an_env() -> None:
    rows = rows_of()
    assert entry_names(rows) == ("success", "near")
    running, solved, _, cut, after, odd = cells_of(rows, np.arange(6))
    assert (running.state, running.steps, running.total) == ("running", "3", "1")
    assert (running.last, running.last_steps) == ("success", "41")
    assert running.tally == "5 episodes ended: 3 success, 1 failed, 1 time limit"
    assert (solved.state, solved.first_true, solved.last) == ("success", ("33", "20"), "")
    assert (cut.state_word, cut.total) == ("time limit", "")
    assert (after.last, after.last_steps) == ("failed", "9") and after.first_true == ("", "")
    assert odd.flags == ("bodies-stay: cube dropped 0.90 m (step 12)",) and odd.first_true == ("", "0")


def test_what_was_odd_in_both_episodes_is_shown_once() -> None:
    rows = rows_of()
    again = rows_of(last=replace(rows.last, outliers={5: rows.outliers[5]}))
    (flag,) = cells_of(again, np.arange(6))[5].flags
    assert flag.count(rows.outliers[5][0].text) == 1
    only_before = rows_of(outliers={}, last=again.last)
    assert len(cells_of(only_before, np.arange(6))[5].flags) == 1


def test_the_moment_of_an_env_is_its_first_outlier_or_its_end() -> None:
    rows = rows_of()
    assert [moment_of(rows, env) for env in range(6)] == [None, 33, 20, 50, None, 12]


def test_sparklines_share_one_scale_and_stay_in_their_box() -> None:
    lowest, *_, highest = (row.curve for row in cells_of(rows_of(), np.arange(6)))
    points = [[float(n) for n in point.split(",")] for line in (*lowest, *highest) for point in line.split()]
    assert len(points) == 6
    assert points[0] == [0, 13] and points[-1] == [60, 1]
    assert all(0 <= x <= 60 and 1 <= y <= 13 for x, y in points)


def test_a_nan_reward_leaves_a_gap_and_no_reward_draws_no_curve() -> None:
    rewards = rows_of().rewards.copy()
    rewards[0, -2] = np.nan
    rewards[1, -1] = np.inf
    first, second, *_ = cells_of(rows_of(rewards=rewards), np.arange(6))
    # Single points at the ends, drawn as dots; and a line of the two points between.
    assert len(first.curve) == 2 and all(len(set(line.split())) == 1 for line in first.curve)
    assert len(second.curve) == 1 and len(set(second.curve[0].split())) == 2
    nothing = rows_of(rewards=np.full((6, KEPT_REWARDS), np.nan, np.float32))
    assert all(row.curve == [] for row in cells_of(nothing, np.arange(6)))

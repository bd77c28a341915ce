from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.entries import ENTRIES
from tests.drive.scenes import step_of, table_scene
from workbench.envs.evaluate_entries import split_entries
from workbench.envs.step_result import OtherEntry
from workbench.live.panels.reward_panel import MAX_ROWS, NumberRow, number_rows
from workbench.page.widgets.templates import render

_, POSES = table_scene(4)


def rows_of(selected_env: int = 1, **evaluate: object) -> dict[str, NumberRow]:
    return {row.name: row for row in number_rows(step_of(POSES, **evaluate), selected_env, 50)}


def test_bools_are_counted_and_numbers_averaged() -> None:
    rows = rows_of(success=[True, True, False, True], distance=np.array([0.0, 1.0, 2.0, 3.0]))
    assert (rows["success"].selected, rows["success"].batch) == ("yes", "3 of 4")
    assert (rows["distance"].selected, rows["distance"].batch) == ("1.000", "mean 1.500")
    assert rows["elapsed steps"].selected == "7 / 50"


def test_right_after_a_reset_there_is_no_reward_but_a_rescored_one_is_shown() -> None:
    def shown(env: int, action: bool, reward: list[float]) -> list[tuple[str, str]]:
        step = replace(
            step_of(POSES, **{"reward_terms/reach": np.array(reward, float)}),
            reward=np.array(reward, np.float32),
            elapsed_steps=np.array([0, 3, 4, 5]),
            action=np.zeros((4, 1), np.float32) if action else None,
        )
        rows = {row.name: row for row in number_rows(step, env, None)}
        return [(rows[name].selected, rows[name].batch) for name in ("reward", "reward_terms/reach")]

    nan = np.nan
    assert shown(0, True, [0, 1, 2, 3]) == [("—", "mean 2.000")] * 2
    assert shown(1, True, [0, 1, 2, nan]) == [("1.000", "mean 1.500, NaN in 1 of 3")] * 2
    assert shown(3, True, [0, 1, 2, nan]) == [("NaN", "mean 1.500, NaN in 1 of 3")] * 2
    assert shown(3, False, [0, 1, 2, nan]) == [("—", "mean 1.500")] * 2, "it was restored"
    assert shown(2, False, [nan] * 4) == [("—", "—")] * 2


def test_rows_are_of_the_selected_env_and_few() -> None:
    entries: dict[str, Any] = {"success": [True, False, False, False], "fail": [False, True, False, False]}
    assert [rows_of(env, **entries)["success"].tone for env in range(2)] == ["good", ""]
    assert [rows_of(env, **entries)["fail"].tone for env in range(2)] == ["", "bad"]
    rows = rows_of(2, far=np.array([0, 0, 12345.0, 0]), at=np.arange(24.0).reshape(4, 6), count=[1, 2, 3, 6])
    assert [rows[name].selected for name in ("far", "at", "count")] == [
        *("1.23e+04", "[12.000, 13.000, 14.000, 15.000, … 6]", "3")
    ]
    assert rows["count"].batch == "mean 3.0" and list(rows)[:2] == ["elapsed steps", "reward"]
    many = number_rows(
        step_of(POSES, success=[True] * 4, **{f"e{k:03}": [0.0] * 4 for k in range(300)}), 0, None, "none"
    )
    assert len(many) == MAX_ROWS + 2 and many[1].name == "success" and "101" in many[-1].name


def test_nan_is_shown() -> None:
    """NaN is shown for the selected env, counted over the batch, and left out of the mean."""
    rows = rows_of(
        0,
        distance=np.array([np.nan, 1.0, 2.0, np.nan]),
        all_lost=np.full(4, np.nan),
        far=np.array([np.inf, 1.0, np.nan, 2.0]),
        pose=np.array([[0.0, np.nan], [0, 0], [0, 0], [-np.inf, 0]]),
    )
    assert (rows["distance"].selected, rows["distance"].batch) == ("NaN", "mean 1.500, NaN in 2 of 4")
    assert rows["all_lost"].batch == "NaN in 4 of 4"
    assert (rows["far"].selected, rows["far"].batch) == (
        "infinite",
        "mean 1.500, NaN in 1, infinite in 1 of 4",
    )
    assert (rows["pose"].selected, rows["pose"].batch) == ("[0.000, NaN]", "NaN in 1, infinite in 1 of 4")


OTHERS = {
    "best": OtherEntry("None", ("None",)),
    "phase": OtherEntry("str", ("<b>reach</b>",)),
    "stage": OtherEntry("int", numbers=np.array(2)),
    "progress": OtherEntry("float32 tensor of shape ()", numbers=np.array(0.25, np.float32)),
    "goal": OtherEntry("float32 tensor of shape (5,)", numbers=np.arange(5, dtype=np.float32)),
    "map": OtherEntry("float32 tensor of shape (300, 300)", ("90,000 numbers",), whole=False),
    "stats/mean/away": OtherEntry("float", numbers=np.array(np.nan)),
    "words": OtherEntry("list", ("a", "b", "c", "d"), per_env=True),
    "long": OtherEntry("str", ("x" * 400,)),
}


def test_a_value_without_a_row_per_env_is_shown_unchanged_and_marked() -> None:
    rows = {
        row.name: row for row in number_rows(replace(step_of(POSES, away=[0.0] * 4), others=OTHERS), 1, None)
    }
    whole = {name: row.whole for name, row in rows.items() if row.whole}
    assert whole == {
        "best": "None",
        "phase": "<b>reach</b>",
        "stage": "2",
        "progress": "0.250",
        "goal": "[0.000, 1.000, 2.000, 3.000, … 5]",
        "map": "90,000 numbers",
        "stats/mean/away": rows["stats/mean/away"].whole,
        "long": "x" * 159 + "…",
    }
    assert (rows["words"].selected, rows["words"].whole) == ("b", "")
    assert rows["progress"].hint == "not per env: float32 tensor of shape ()"
    assert rows["map"].hint.endswith("only a part of it is shown, and recorded")
    assert rows["away"].batch == "mean 0.000" and rows["away"].hint == ""


@pytest.mark.parametrize("num_envs", [1, 4])
def test_the_mark_is_on_the_page(num_envs: int) -> None:
    rows = number_rows(replace(step_of(POSES[:num_envs]), others=OTHERS), 0, None)
    modes = ("sparse", "normalized_dense", "dense")
    assert [number_rows(step_of(POSES), 0, None, mode)[1].about for mode in modes] == [
        "sparse",
        "normalized",
        "",
    ]
    html = render("numbers", rows=rows, env=0, num_envs=num_envs, has_success=True)
    marked = sum(1 for row in rows if row.whole)
    assert html.count("not per env</span>") == marked == 8
    assert html.count('colspan="2"') == (marked if num_envs > 1 else 0)
    assert "&lt;b&gt;reach&lt;/b&gt; <span" in html and "<b>reach" not in html


@given(ENTRIES, st.integers(1, 4), st.integers(0, 5))
def test_any_evaluate_dict_is_shown(entries: dict[Any, Any], num_envs: int, env: int) -> None:
    columns, others = split_entries(entries, num_envs)
    rows = number_rows(replace(step_of(POSES[:num_envs]), evaluate=columns, others=others), env, None)
    html = render("numbers", rows=rows, env=env, num_envs=num_envs, has_success=False)
    html.encode()
    assert len(rows) == 2 + len(columns) + len(others)

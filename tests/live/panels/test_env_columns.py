"""Which columns the table of envs omits in a narrow panel."""

from __future__ import annotations

from workbench.live.panels.env_columns import EnvColumn, levels, wanted_width

COLUMNS = [
    EnvColumn("env", 3),
    EnvColumn("state", 9, 9),
    EnvColumn("is_obj_placed", 3, rank=1),
    EnvColumn("flags", 3, rank=0),
]


def test_columns_are_omitted_by_rank_and_those_without_a_rank_stay() -> None:
    found = levels(COLUMNS)
    assert [level.columns for level in found if level.columns] == [(4,), (3,)]
    assert found[-1].names == ("flags", "is_obj_placed")


def test_a_narrower_panel_omits_more_columns_and_a_wide_one_shows_all() -> None:
    limits = [level.below for level in levels(COLUMNS)]
    assert limits == sorted(limits, reverse=True) and len(set(limits)) == len(limits)
    assert limits[0] <= wanted_width(COLUMNS)


def test_a_name_with_underscores_takes_less_room_than_its_letters() -> None:
    assert EnvColumn("is_obj_placed", 3).least(words=True) < EnvColumn("isxobjxplaced", 3).least(words=True)

"""What an episode tells of itself: flags, success, means, entries, names of cameras and where its bodies are."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.drive.episodes import made
from workbench.envs.camera_data import CameraInfo, CameraKind
from workbench.episodes.episode import (
    MAX_DEPTH,
    BrokenFile,
    Episode,
    acted_by_text,
    camera_names,
    file_part,
    is_shallow,
    movable_bounds,
    parse_acted_by,
    read_whole,
)
from workbench.episodes.equal_numbers import gap, numbers_differ, too_far
from workbench.episodes.row import UnreadableRecording

NAN, INF = np.nan, np.inf


def with_entries(**entries: Any) -> Episode:
    return replace(made(3), evaluate={name: np.array(values) for name, values in entries.items()})


def test_flags_are_true_where_their_entry_is_a_number_other_than_zero() -> None:
    episode = with_entries(
        success=[NAN, 0, 2, 1], fail=[False, False, False, True], wide=[[1], [1], [1], [1]]
    )
    assert {name: flag.tolist() for name, flag in episode.flags.items()} == {
        "success": [False, False, True, True],
        "fail": [False, False, False, True],
    }
    assert episode.solved_at == 2 and episode.flag("wide") is None and episode.flag("none") is None
    assert with_entries(success=[True] * 4).solved_at == 0
    assert with_entries(success=[False] * 4).solved_at is None and with_entries().solved_at is None
    flag = episode.flag("fail")
    assert flag is not None
    flag[:] = True
    assert not episode.evaluate["fail"][0]


def test_means_are_those_of_the_states_after_the_reset_that_have_the_entry() -> None:
    episode = with_entries(
        success=[1, 1, 1, 1], fail=[0] * 4, distance=[100.0, 1, 2, 6], term=[NAN, NAN, 2, 4], none=[1.0, NAN, NAN, NAN],
        wide=[[1.0], [1], [1], [1]], flag=[False, True, False, False],
    )  # fmt: skip
    assert episode.means == {"distance": 3, "term": 3, "flag": pytest.approx(1 / 3)}


@pytest.mark.parametrize(
    ("cameras", "names"),
    [
        ([("human", "eye"), ("sensor", "eye")], ["eye_human", "eye"]),
        ([("sensor", ""), ("human", "a")], ["unnamed", "a"]),
        ([("human", "a"), ("human", "a"), ("sensor", "a_human")], ["a", "a_human_human", "a_human"]),
    ],
)
def test_each_camera_has_a_name_of_its_own(cameras: list[tuple[CameraKind, str]], names: list[str]) -> None:
    eye = np.eye(3, dtype=np.float32)
    infos = [CameraInfo(name, kind, 1, 1, 1.0, 0.1, 1.0, eye, None, ()) for kind, name in cameras]
    assert camera_names(infos) == names


def test_a_camera_name_in_a_file_name_leads_nowhere_else() -> None:
    assert file_part("../a b\\c:é.1") == ".._a b_c_é.1" and len(file_part("x" * 300)) == 100


def test_the_bounds_are_those_of_bodies_that_can_move() -> None:
    poses = np.zeros((2, 5, 7), np.float32)
    poses[0, :, :3] = [[-9, 0, 0], [-8, 0, 0], [1, 2, 3], [4, 0, 1], [NAN, 0, 9]]
    poses[1, :, :3] = [[-9, 0, 0], [-8, 0, 0], [1, -2, 3], [5, 0, 1], [NAN, 0, 9]]
    low, high = movable_bounds(poses, ("static", "kinematic", "link", "dynamic", "dynamic"))
    assert (low.tolist(), high.tolist()) == ([1, -2, 1], [5, 2, 3])
    low, high = movable_bounds(poses, ("static",) * 5)
    assert (low.tolist(), high.tolist()) == ([0, 0, 0], [0, 0, 0])


def test_sources_of_actions_name_the_step_from_which_they_acted() -> None:
    pairs = parse_acted_by([[0, "random"], (40, "sliders")])
    assert pairs == ((0, "random"), (40, "sliders")) and parse_acted_by(None) == ()
    assert acted_by_text(pairs) == "random; from step 41 on: sliders" and acted_by_text(()) == ""


def test_only_so_many_levels_of_lists_and_objects_are_shallow() -> None:
    deep: Any = []
    for _ in range(MAX_DEPTH - 1):
        deep = {"a": [1], "b": deep} if isinstance(deep, list) else [deep]
    assert is_shallow(deep) and is_shallow("text") and not is_shallow([deep])


def test_a_dataset_takes_no_episode_that_is_damaged_and_names_it() -> None:
    whole = made(2)
    assert read_whole("a", lambda: whole) is whole
    broken = replace(whole, broken_files=(BrokenFile("a.h5", "is gone."), BrokenFile("a.rrd", "is cut.")))
    with pytest.raises(UnreadableRecording, match=r"a\.h5 is gone\. a\.rrd is cut\."):
        read_whole("a", lambda: broken)

    def fails(error: Exception) -> Any:
        raise error

    cut = UnreadableRecording("name is cut.")
    for error, says in ((OSError("no disk"), "^name: no disk$"), (cut, "^name is cut")):
        with pytest.raises(UnreadableRecording, match=says):
            read_whole("name", lambda error=error: fails(error))


# --- equal numbers -----------------------------------------------------------------------------------


def test_numbers_are_apart_by_their_difference_and_the_same_nan_or_infinity_is_equal() -> None:
    old, new = [1.0, NAN, NAN, 1.0, INF, INF, -INF], [-1.5, NAN, 1.0, NAN, INF, -INF, 1.0]
    assert gap(np.array(old), np.array(new)).tolist() == [2.5, 0, INF, INF, 0, INF, INF]


def test_numbers_differ_from_a_share_of_the_largest_or_of_a_row_on() -> None:
    old = np.array([[0.0, 1000.0], [0.0, 1.0], [0.0, NAN]])
    new = old + [[0.005, 0], [0.005, 0], [0.005, 0]]
    assert numbers_differ(old, new).tolist() == [[False, False]] * 3
    apart = gap(old, new)
    assert too_far(old, apart, axis=1).tolist() == [[False, False], [True, False], [True, False]]
    assert not too_far(old, apart, least=0.01, axis=1).any()
    assert numbers_differ(np.zeros(2), np.array([1e-8, 1e-6])).tolist() == [False, True]
    assert not numbers_differ(old, old).any()

"""The outlier watch's verdicts on hand-made steps; `tests/live/history/test_outliers.py` checks real ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.drive.scenes import step_of, table_scene
from workbench.envs.outliers import Outlier, OutlierKind, OutlierWatch, lowest_still_point


def watched(num_envs: int, reward_mode: str = "dense") -> tuple[OutlierWatch, np.ndarray]:
    geometry, poses = table_scene(num_envs)
    return OutlierWatch(geometry, step_of(poses), 0.05, reward_mode), poses


def found(watch: OutlierWatch, poses: np.ndarray) -> dict[OutlierKind, list[int]]:
    return {sight.kind: np.flatnonzero(sight.envs).tolist() for sight in watch.check(step_of(poses))}


def lowered(poses: np.ndarray, by: float, envs: list[int]) -> np.ndarray:
    moved = poses.copy()
    moved[envs, 3, 2] -= by
    return moved


def test_a_drop_is_measured_from_the_episodes_start() -> None:
    watch, poses = watched(3)
    high = lowered(poses, -2.0, [0, 1, 2])
    watch.begin(np.array([True, True, True]), step_of(high))
    lower = lowered(high, 0.8, [1])
    watch.begin(np.array([False, True, False]), step_of(lower))
    assert found(watch, lower) == {}, "env 1 starts 0.8 m lower, which is not a drop"
    assert found(watch, lowered(high, 0.8, [0, 1, 2])) == {OutlierKind.DROPPED: [0, 2]}
    assert found(watch, lowered(lower, 0.51, [1])) == {OutlierKind.DROPPED: [1]}


def test_only_envs_that_begin_may_jump() -> None:
    watch, poses = watched(3)
    far = poses.copy()
    far[:, 3, 0] += 5.0
    watch.begin(np.array([False, True, False]), step_of(far))
    assert found(watch, far) == {OutlierKind.FAST: [0, 2]}
    assert found(watch, far) == {}, "the bodies stand still in the second step"


def test_the_worst_body_is_named_with_its_value() -> None:
    watch, poses = watched(2)
    moved = poses.copy()
    moved[1, 2, 1] += 1.5
    moved[1, 3, 0] -= 2.0
    moved[0, :2, 0] += 9.0  # the ground and a kinematic body are no outliers
    moved[0, 1, 2] = -9.0
    [sight] = watch.check(step_of(moved))
    assert (sight.kind, sight.reason(1)) == (OutlierKind.FAST, "cube moved at 40 m/s")
    assert sight.body is not None and sight.body(1) == "cube"
    told = Outlier(sight.kind, 3, sight.reason(1)).text
    assert told.startswith(str(sight.kind.rule)) and told.endswith(sight.reason(1))
    watch, poses = watched(2)
    high = lowered(poses, -3.0, [0, 1])
    watch.begin(np.ones(2, bool), step_of(high))
    [sight] = watch.check(step_of(lowered(high, 0.75, [0])))
    assert (sight.kind, sight.reason(0)) == (OutlierKind.DROPPED, "cube dropped 0.75 m")


def test_under_the_floor_is_measured_from_the_lowest_still_point() -> None:
    watch, poses = watched(2)
    geometry, _ = table_scene(2)
    floor = lowest_still_point(geometry, poses)
    moved = poses.copy()
    for z, expected in ((floor - 0.19, []), (floor - 0.21, [OutlierKind.UNDER_FLOOR])):
        moved[1, 2, 2] = z
        watch.begin(np.ones(2, bool), step_of(moved))
        assert list(found(watch, moved)) == expected
    assert [s.reason(1) for s in watch.check(step_of(moved))] == ["arm/hand is under the floor"]


@pytest.mark.parametrize(
    ("mode", "reward", "reason"),
    [
        ("sparse", 1.0, None),
        ("sparse", -1.0, None),
        ("sparse", 1.5, "the reward is 1.5, above 1"),
        ("normalized_dense", -1.25, "the reward is -1.25, below -1"),
        ("normalized_dense", 3.0000002 / 3, None),
        ("dense", 1e6, None),
        ("none", -1e6, None),
        ("dense", np.inf, "the reward is infinite"),
        ("dense", np.nan, "the reward is NaN"),
        ("sparse", np.inf, "the reward is infinite"),
    ],
)
def test_a_reward_outside_its_modes_range_or_not_finite_is_an_outlier(
    mode: str, reward: float, reason: str | None
) -> None:
    watch, poses = watched(3, mode)
    step = step_of(poses)
    rewards = step.reward.copy()
    rewards[1] = reward
    sights = watch.check(replace(step, reward=rewards))
    assert [sight.reason(1) for sight in sights] == ([] if reason is None else [reason])
    assert all(np.flatnonzero(sight.envs).tolist() == [1] for sight in sights)


def test_nan_and_infinite_numbers_of_evaluate_and_actions_are_named() -> None:
    watch, poses = watched(3)
    distance = np.zeros((3, 2), np.float32)
    distance[2, 1] = np.inf
    action = np.zeros((3, 4), np.float32)
    action[0, 3] = np.nan
    flags = {"success": np.zeros(3, bool), "distance": distance, "count": np.zeros(3, np.int64)}
    sights = watch.check(replace(step_of(poses), action=action, evaluate=flags))
    reasons = {int(np.flatnonzero(s.envs)[0]): s.reason(int(np.flatnonzero(s.envs)[0])) for s in sights}
    assert reasons == {0: "the action is NaN", 2: "distance is infinite"}
    none = replace(
        step_of(poses), action=np.zeros((3, 0), np.float32), sound_obs=np.array([True, False, True])
    )
    [sight] = watch.check(none)
    assert sight.envs.tolist() == [False, True, False]


def test_lost_poses_are_named_but_not_those_of_absent_bodies() -> None:
    geometry, poses = table_scene(2)
    poses[0, 2] = np.nan  # env 0 has no hand
    watch = OutlierWatch(geometry, step_of(poses), 0.05, "dense")
    assert watch.check(step_of(poses)) == []
    lost = poses.copy()
    lost[1, 3] = np.nan
    [sight] = watch.check(step_of(lost))
    assert sight.envs.tolist() == [False, True] and sight.reason(1) == "the pose of cube is NaN"


def test_the_lowest_still_point_is_the_ground_for_any_mesh_orientation() -> None:
    geometry, poses = table_scene(1)
    assert lowest_still_point(geometry, poses) == pytest.approx(-0.9205)
    poses[0, 0] = [0, 0, 0.5, 0, 1, 0, 0]  # half a turn about x
    assert lowest_still_point(geometry, poses) == pytest.approx(0.5 + 0.9195)
    loose = replace(geometry, body_kinds=("kinematic",) * 4)
    assert lowest_still_point(loose, poses) == -np.inf


def test_a_link_flies_off_a_body_without_a_shape_does_not_and_another_scene_is_left_out() -> None:
    geometry, poses = table_scene(2)
    moved = poses.copy()
    moved[1, 2:, 0] += 2.0
    bare = replace(geometry, visuals=tuple(v for v in geometry.visuals if not v.name.startswith("cube")))
    watch = OutlierWatch(bare, step_of(poses), 0.05, "dense")
    [sight] = watch.check(step_of(moved))
    assert sight.reason(1).startswith("arm/hand moved at 40") and sight.envs.tolist() == [False, True]
    fewer = step_of(poses[:, :3] + 100)
    watch.begin(np.array([True, True]), fewer)
    assert watch.check(fewer) == [], "a reset may rebuild the scene with other bodies"
    assert [s.kind for s in watch.check(step_of(poses))] == [OutlierKind.FAST], "the last known step stays"


def test_a_term_of_the_reward_breaks_the_rule_of_rewards() -> None:
    watch, poses = watched(2)
    entries = {"reward_terms/reach": np.array([0.0, np.nan]), "height": np.array([0.0, np.nan])}
    sights = {sight.kind: sight for sight in watch.check(step_of(poses, **entries))}
    assert sights.keys() == {OutlierKind.TERM_NOT_FINITE, OutlierKind.ENTRY_NOT_FINITE}
    assert "reach" in sights[OutlierKind.TERM_NOT_FINITE].reason(1)
    assert OutlierKind.TERM_NOT_FINITE.rule == OutlierKind.REWARD_NOT_FINITE.rule
    assert OutlierKind.ENTRY_NOT_FINITE.rule != OutlierKind.TERM_NOT_FINITE.rule
    nothing = Outlier(OutlierKind.ACTION_NOT_FINITE, 0, "the action is NaN")
    assert nothing.text == nothing.reason, "actions break no rule of the task"

"""The builder takes one env's row, and refuses what would make an episode a lie."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from workbench.core.geometry import SceneGeometry
from workbench.core.pictures import CameraInfo, Picture
from workbench.core.step import StepResult
from workbench.recording.columns import EpisodeBuilder
from workbench.recording.episode import EpisodeInfo

NUM_ENVS = 3
BODIES = 2
ENV = 1


def info() -> EpisodeInfo:
    return EpisodeInfo("Task-v1", ENV, 0, None, "", {}, 0.05, None, "cpu")


def camera(name: str = "eye", kind: Any = "sensor") -> CameraInfo:
    return CameraInfo(name, kind, 4, 3, 1.0, 0.01, 10.0, np.eye(3, dtype=np.float32), None, ("rgb",))


def builder(cameras: tuple[CameraInfo, ...] = ()) -> EpisodeBuilder:
    geometry = SceneGeometry(NUM_ENVS, ("a", "b"), ("dynamic", "dynamic"), (False, False), ())
    return EpisodeBuilder(info(), geometry, {1: "a"}, ["x", "y"], cameras)


def step(elapsed: int, **evaluate: Any) -> StepResult:
    """A batch in which every number says which env and which step it belongs to."""
    number = 100.0 * np.arange(NUM_ENVS) + elapsed
    return StepResult(
        elapsed_steps=np.array([99, elapsed, 99], dtype=np.int32),
        reward=number.astype(np.float32),
        terminated=number % 2 == 1,
        truncated=number % 3 == 0,
        evaluate={key: np.asarray(value) for key, value in evaluate.items()},
        poses=np.broadcast_to(number[:, None, None], (NUM_ENVS, BODIES, 7)).astype(np.float32),
        action=None if elapsed == 0 else np.stack([number, -number], axis=1).astype(np.float32),
    )


def picture(env: int = ENV, shade: int = 0, **modalities: Any) -> Picture:
    modalities = modalities or {"rgb": np.full((3, 4, 3), shade, dtype=np.uint8)}
    return Picture("eye", "sensor", env, np.arange(7, dtype=np.float32), **modalities)


def test_takes_the_row_of_its_env() -> None:
    made = builder()
    made.start(step(0), ENV)
    made.append(step(1), ENV)
    made.append(step(2), ENV)
    assert len(made) == 2
    episode = made.finish()
    np.testing.assert_array_equal(episode.poses[:, 0, 0], [100, 101, 102])
    np.testing.assert_array_equal(episode.reward, [101, 102])
    np.testing.assert_array_equal(episode.action, [[101, -101], [102, -102]])
    np.testing.assert_array_equal(episode.terminated, [True, False])
    np.testing.assert_array_equal(episode.truncated, [False, True])


def test_keeps_no_view_of_the_batch() -> None:
    first = step(0, height=np.array([1.0, 2.0, 3.0]))
    made = builder()
    made.start(first, ENV)
    first.poses[:] = -1
    first.evaluate["height"][:] = -1
    episode = made.finish()
    assert episode.poses[0, 0, 0] == 100
    assert episode.evaluate["height"][0] == 2
    assert episode.poses.base is None


def test_an_episode_of_no_steps_has_empty_columns_of_the_right_shape() -> None:
    made = builder()
    made.start(step(0), ENV)
    episode = made.finish()
    assert episode.poses.shape == (1, BODIES, 7)
    assert episode.action.shape == (0, 2)
    assert episode.reward.shape == episode.terminated.shape == (0,)


def test_evaluate_keeps_its_type_where_every_step_has_it() -> None:
    made = builder()
    flags, counts, vectors = [True, False, True], [4, 5, 6], np.arange(6.0).reshape(3, 2)
    for elapsed in range(3):
        take = made.start if elapsed == 0 else made.append
        take(step(elapsed, success=flags, contacts=counts, offset=vectors), ENV)
    evaluate = made.finish().evaluate
    assert evaluate["success"].dtype == np.bool_
    assert evaluate["contacts"].dtype.kind == "i"
    np.testing.assert_array_equal(evaluate["offset"], [[2, 3]] * 3)


def test_evaluate_entries_that_come_and_go_leave_nan() -> None:
    made = builder()
    made.start(step(0, early=[True] * 3), ENV)
    made.append(step(1, late=np.ones((3, 2))), ENV)
    made.append(step(2, late=np.ones((3, 2)), early=[False] * 3), ENV)
    evaluate = made.finish().evaluate
    np.testing.assert_array_equal(evaluate["early"], [1, np.nan, 0])
    np.testing.assert_array_equal(evaluate["late"], [[np.nan, np.nan], [1, 1], [1, 1]])


def test_evaluate_entries_that_change_their_shape_are_padded() -> None:
    made = builder()
    made.start(step(0, d=np.ones(3)), ENV)
    made.append(step(1, d=np.full((3, 2), 2.0)), ENV)
    np.testing.assert_array_equal(made.finish().evaluate["d"], [[1, np.nan], [2, 2]])


def test_evaluate_of_another_kind_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"evaluate\(\)\['phase'\].*dtype <U5"):
        builder().start(step(0, phase=["reach"] * 3), ENV)


def test_a_recording_begins_at_a_reset() -> None:
    with pytest.raises(ValueError, match="4 steps into its episode"):
        builder().start(step(4), ENV)
    with pytest.raises(RuntimeError, match="before start"):
        builder().append(step(1), ENV)
    with pytest.raises(RuntimeError, match="before start"):
        builder().finish()


def test_a_lost_step_is_noticed_and_what_came_before_it_kept() -> None:
    made = builder((camera(),))
    made.start(step(0), ENV, [picture()])
    made.append(step(1), ENV, [picture()])
    with pytest.raises(ValueError, match="step 2 was expected and step 3 came"):
        made.append(step(3), ENV, [picture()])
    with pytest.raises(ValueError, match="step 2 was expected and step 0 came"):
        made.append(step(0), ENV, [picture()])
    episode = made.finish()
    assert len(episode.action) == 1
    assert len(episode.poses) == len(episode.cameras[0].frame) == 2


def test_an_env_that_the_batch_lacks_is_refused() -> None:
    for env in (-1, NUM_ENVS):
        with pytest.raises(IndexError, match="choose 0 to 2"):
            builder().start(step(0), env)


def test_actions_without_a_name_are_refused() -> None:
    made = builder()
    made.start(step(0), ENV)
    wide = step(1)
    with pytest.raises(ValueError, match="3 numbers, but 2 action names"):
        made.append(StepResult(**{**vars(wide), "action": np.zeros((3, 3), dtype=np.float32)}), ENV)


def test_pictures_of_other_envs_are_passed_over() -> None:
    made = builder((camera(), camera("unused")))
    made.start(step(0), ENV, [picture(env=0, shade=9), picture(shade=5), picture(env=2, shade=9)])
    made.append(step(1), ENV)
    made.append(step(2), ENV, [picture(shade=7)])
    (track,) = made.finish().cameras
    np.testing.assert_array_equal(track.frame, [0, 2])
    assert track.rgb is not None
    np.testing.assert_array_equal(track.rgb[:, 0, 0, 0], [5, 7])
    assert track.depth is None


def test_pictures_that_do_not_fit_are_refused() -> None:
    stranger = Picture("nose", "sensor", ENV, np.zeros(7, dtype=np.float32))
    with pytest.raises(ValueError, match=r"unknown camera nose .*known: eye \(sensor\)"):
        builder((camera(),)).start(step(0), ENV, [stranger])
    with pytest.raises(ValueError, match="rgb of 5 x 5, but the camera is 4 x 3"):
        builder((camera(),)).start(step(0), ENV, [picture(rgb=np.zeros((5, 5, 3), dtype=np.uint8))])
    made = builder((camera(),))
    made.start(step(0), ENV, [picture()])
    with pytest.raises(ValueError, match="gave rgb first and now depth"):
        made.append(step(1), ENV, [picture(depth=np.zeros((3, 4), dtype=np.float32))])

"""Columns and pictures that differ for each moment and env, and what the episode of one env must hold of them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import Picture
from workbench.episodes.episode import Episode
from workbench.task.description import Stepped


def pictures_of(number: int, env_idx: Iterable[int]) -> tuple[Picture, ...]:
    """A picture of each env at the moment with this number."""
    pose = np.array([0, 0, 1, 1, 0, 0, 0], np.float32)
    return tuple(
        Picture(
            "base_camera",
            "sensor",
            env,
            pose + np.eye(7, dtype=np.float32)[0] * env,
            rgb=np.full((6, 8, 3), env + 10 * number, np.uint8),
        )
        for env in env_idx
    )


def columns_of(number: int, num_envs: int) -> dict[str, NDArray[np.float32]]:
    """The columns of all envs at the moment with this number."""
    rows = np.arange(num_envs, dtype=np.float32) + 10 * number
    return {
        "state/actors/cube": np.repeat(rows[:, None], 13, 1),
        "obs/agent/qpos": np.stack([rows, -rows], 1),
    }


def assert_rows(episode: Episode, env: int, taken: list[Stepped]) -> None:
    """The episode has the rows of this env of the steps, the first of which is its reset."""
    steps = taken[1:]
    assert episode.poses is not None
    assert (episode.info.env_index, episode.length) == (env, len(steps))
    np.testing.assert_array_equal(episode.poses, [one.step.poses[env] for one in taken])
    np.testing.assert_array_equal(episode.action, [one.step.action[env] for one in steps])  # type: ignore[index]
    np.testing.assert_array_equal(episode.reward, [one.step.reward[env] for one in steps])
    np.testing.assert_array_equal(episode.terminated, [one.step.terminated[env] for one in steps])
    np.testing.assert_array_equal(episode.truncated, [one.step.truncated[env] for one in steps])
    for name in taken[0].step.evaluate:
        np.testing.assert_array_equal(
            episode.evaluate[name], [one.step.evaluate[name][env] for one in taken], err_msg=name
        )
    for prefix, held in (("state/", episode.env_states), ("obs/", episode.obs)):
        for name, values in held.items():
            np.testing.assert_array_equal(values, [one.columns[prefix + name][env] for one in taken])
    assert set(episode.env_states) == {"actors/cube"} and set(episode.obs) == {"agent/qpos"}
    (track,) = episode.cameras
    assert track.rgb is not None
    assert [int(track.rgb[row].max()) for row in range(len(taken))] == [
        int(np.max(picture.rgb))
        for one in taken
        for picture in one.captured
        if picture.env == env and picture.rgb is not None
    ]
    np.testing.assert_array_equal(track.pose[:, 0], np.full(len(taken), env))

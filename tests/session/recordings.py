"""Small recordings with numbers that can be checked by hand, written and read by the real writer and reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.ui.scenes import camera, table_scene
from workbench.core.geometry import SceneGeometry
from workbench.core.pictures import Picture
from workbench.recording.episode import Episode, EpisodeInfo
from workbench.recording.episode_writer import EpisodeWriter
from workbench.recording.row import EpisodeRow

BODY = {"ground": 0, "table": 1, "arm/hand": 2, "cube": 3}


def made(
    steps: int = 10, success_from: int | None = None, seed: int = 3, speed: float = 0.01, **info: Any
) -> Episode:
    """An episode in which a cube moves along x, `speed` metres a step, and the reward is the number of the step."""
    geometry, poses = table_scene(1)
    track = np.repeat(poses, steps + 1, axis=0)
    track[:, BODY["cube"], 0] = np.arange(steps + 1) * speed
    states = np.arange(steps + 1)
    success = np.zeros(steps + 1, bool) if success_from is None else states >= success_from
    terms = np.concatenate([[np.nan], np.arange(1, steps + 1) / 2])
    return Episode(
        info=EpisodeInfo(
            **{
                "task": "Push-v1",
                "env_index": 0,
                "seed": seed,
                "source_file": "push.py",
                "source_hash": "0" * 12,
                "source": {"push.py": "reward = 1\n"},
                "control_dt": 0.05,
                "control_mode": "pd_joint_delta_pos",
                "backend": "cpu (batched)",
                **info,
            }
        ),
        geometry=geometry,
        segmentation={1: "table"},
        poses=track,
        action=np.full((steps, 2), 0.5, np.float32),
        action_names=("arm/joint1", "gripper"),
        reward=np.arange(1, steps + 1, dtype=np.float32),
        terminated=success[1:].copy(),
        truncated=states[1:] == 50,
        evaluate={"success": success, "distance": 1.0 - states / 100, "reward_terms/reach": terms},
        cameras=[],
    )


def poses_of(episode: Episode) -> NDArray[np.float32]:
    """Those of an episode that has some; to be written to."""
    assert episode.poses is not None
    return episode.poses


def geometry_of(episode: Episode) -> SceneGeometry:
    assert episode.geometry is not None
    return episode.geometry


def begin(folder: Path, episode: Episode) -> None:
    """All of it in a journal, as a writer leaves it that was killed before it made the files."""
    writer = appended(folder, episode, pictures=False)
    writer._journal.write()
    writer.close()


def write(folder: Path, episode: Episode, pictures: bool = True, every: int = 1) -> Path:
    """Its files in `folder`, with a camera whose picture at state k, of each of so many, is k * 20 bright; returns the .json."""
    return appended(folder, episode, pictures, every).finish().json


def appended(folder: Path, episode: Episode, pictures: bool, every: int = 1) -> EpisodeWriter:
    cameras = (camera(),) if pictures else ()
    writer = EpisodeWriter(
        folder, episode.info, geometry_of(episode), episode.segmentation, episode.action_names, cameras
    )
    for state in range(episode.length + 1):
        seen = Picture(
            "base_camera",
            "sensor",
            0,
            np.array([0, 0, 1, 1, 0, 0, 0], np.float32),
            rgb=np.full((6, 8, 3), state * 20 % 256, np.uint8),
            depth=np.full((6, 8), state / 10, np.float32),
            segmentation=np.ones((6, 8), np.int32),
        )
        writer.append(
            EpisodeRow(
                poses=poses_of(episode)[state],
                evaluate={name: values[state] for name, values in episode.evaluate.items()},
                action=episode.action[state - 1] if state else None,
                reward=float(episode.reward[state - 1]) if state else 0.0,
                terminated=bool(episode.terminated[state - 1]) if state else False,
                truncated=bool(episode.truncated[state - 1]) if state else False,
                pictures=(seen,) if pictures and state % every == 0 else (),
                others=episode.others_at(state),
            )
        )
    return writer

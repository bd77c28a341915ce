"""Episodes with numbers that can be checked by hand, and their files from the real writer."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.drive.rows import EpisodeRow, append
from tests.drive.scenes import camera, table_scene
from workbench.envs.camera_data import CameraInfo, Picture
from workbench.envs.scene.shapes import SceneGeometry
from workbench.envs.task_drawings import Drawing
from workbench.episodes.episode import Episode, EpisodeInfo
from workbench.episodes.writing.episode_writer import SCENE_SUFFIX, EpisodeFiles, EpisodeWriter
from workbench.episodes.writing.from_journal import Header, read_header
from workbench.episodes.writing.journal import Journal, JournalEntry, JournalReader, read_visuals

BODY = {"ground": 0, "table": 1, "arm/hand": 2, "cube": 3}


def made(
    steps: int = 10, success_from: int | None = None, seed: int = 3, speed: float = 0.01, **info: Any
) -> Episode:
    """An episode in which a cube moves along x by `speed` metres a step; the reward is the step number."""
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
    """The episode's pose array itself, so that a test can change it; fails if there is none."""
    assert episode.poses is not None
    return episode.poses


def geometry_of(episode: Episode) -> SceneGeometry:
    assert episode.geometry is not None
    return episode.geometry


def begin(folder: Path, episode: Episode) -> None:
    """Write the whole episode into a journal only, as a writer that is killed before the export leaves it."""
    writer = appended(folder, episode, pictures=False)
    journal_of(writer).write()
    writer.close()


def journal_of(writer: EpisodeWriter) -> Journal:
    """The writer's journal, for a test that flushes it itself; normally a thread does, periodically."""
    return writer._journal


def header_of(journal: Path) -> Header:
    """The journal's header as `recover` reads it; fails if there is none."""
    with contextlib.closing(JournalReader(journal)) as reader:
        header = read_header(reader, read_visuals(journal.with_suffix(SCENE_SUFFIX)))
    assert header is not None
    return header


def entries_of(journal: Path) -> list[JournalEntry]:
    """All readable entries of the journal."""
    with contextlib.closing(JournalReader(journal)) as reader:
        return [entry for _, entries in reader for entry in entries]


def write(folder: Path, episode: Episode, pictures: bool = True, every: int = 1) -> Path:
    """Write the episode's files; the picture at each `every`-th state k has brightness k * 20. Return the .json."""
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
        append(
            writer,
            row_at(
                episode,
                state,
                pictures=(seen,) if pictures and state % every == 0 else (),
                others=episode.other_entries_at(state),
                drawn=episode.drawings_at(state),
            ),
        )
    return writer


def row_at(episode: Episode | Made, state: int, **others: Any) -> EpisodeRow:
    """The row that a recorder gets for a state and the step that led to it."""
    assert episode.poses is not None
    return EpisodeRow(
        poses=episode.poses[state],
        evaluate={name: values[state] for name, values in episode.evaluate.items()},
        action=episode.action[state - 1] if state else None,
        reward=float(episode.reward[state - 1]) if state else 0.0,
        terminated=bool(episode.terminated[state - 1]) if state else False,
        truncated=bool(episode.truncated[state - 1]) if state else False,
        **others,
    )


@dataclass
class Track:
    info: CameraInfo
    frame: NDArray[np.int64]
    pose: NDArray[np.float32]
    rgb: NDArray[np.uint8] | None = None
    depth: NDArray[np.float32] | None = None
    segmentation: NDArray[np.int32] | None = None

    def picture(self, state: int) -> Iterator[Picture]:
        for index in np.flatnonzero(self.frame == state):
            held = {
                name: array[index]
                for name in ("rgb", "depth", "segmentation")
                if (array := getattr(self, name)) is not None
            }
            yield Picture(self.info.name, self.info.kind, 0, self.pose[index], **held)


@dataclass
class Made:
    info: EpisodeInfo
    geometry: SceneGeometry
    segmentation: dict[int, str]
    poses: NDArray[np.float32]
    action: NDArray[np.float32]
    action_names: tuple[str, ...]
    reward: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    evaluate: dict[str, NDArray]
    cameras: list[Track]
    env_states: dict[str, NDArray] = field(default_factory=dict)
    obs: dict[str, NDArray] = field(default_factory=dict)
    drawn: list[dict[str, Drawing]] = field(default_factory=list)
    """What is drawn in each state; empty if nothing is ever drawn."""

    def rows(self) -> Iterator[EpisodeRow]:
        for state in range(len(self.poses)):
            yield row_at(
                self,
                state,
                env_states={name: values[state] for name, values in self.env_states.items()},
                obs={name: values[state] for name, values in self.obs.items()},
                pictures=tuple(picture for track in self.cameras for picture in track.picture(state)),
                drawn=self.drawn[state] if self.drawn else {},
            )

    def writer(self, folder: Path) -> EpisodeWriter:
        cameras = [track.info for track in self.cameras]
        return EpisodeWriter(folder, self.info, self.geometry, self.segmentation, self.action_names, cameras)

    def write(self, folder: Path) -> EpisodeFiles:
        writer = self.writer(folder)
        for row in self.rows():
            append(writer, row)
        return writer.finish()

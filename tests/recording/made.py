"""An episode as plain arrays, and the rows that make it: what goes into a writer and has to come out of the files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from workbench.core.geometry import SceneGeometry
from workbench.core.pictures import CameraInfo, Picture
from workbench.recording.episode import EpisodeInfo
from workbench.recording.episode_writer import EpisodeFiles, EpisodeWriter
from workbench.recording.row import EpisodeRow


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

    def rows(self) -> Iterator[EpisodeRow]:
        for state in range(len(self.poses)):
            yield EpisodeRow(
                poses=self.poses[state],
                evaluate={name: values[state] for name, values in self.evaluate.items()},
                env_states={name: values[state] for name, values in self.env_states.items()},
                obs={name: values[state] for name, values in self.obs.items()},
                action=self.action[state - 1] if state else None,
                reward=float(self.reward[state - 1]) if state else 0.0,
                terminated=bool(self.terminated[state - 1]) if state else False,
                truncated=bool(self.truncated[state - 1]) if state else False,
                pictures=tuple(picture for track in self.cameras for picture in track.picture(state)),
            )

    def writer(self, folder: Path) -> EpisodeWriter:
        cameras = [track.info for track in self.cameras]
        return EpisodeWriter(folder, self.info, self.geometry, self.segmentation, self.action_names, cameras)

    def write(self, folder: Path) -> EpisodeFiles:
        writer = self.writer(folder)
        for row in self.rows():
            writer.append(row)
        return writer.finish()

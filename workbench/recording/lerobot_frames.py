"""One episode as LeRobot sees it: T frames, each with what was observed and the action that was taken then.

We have T actions and T + 1 states. LeRobot has a row a decision: the observation of state t, action t, and under
``next.`` what came of it. So row t is state t with action t and the reward of the step that followed; the last state,
in which nothing was decided, is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.recording.episode import Episode
from workbench.recording.episode_pictures import cameras_by_name, picture_index
from workbench.recording.lerobot_format import ACTION, DONE, ENVIRONMENT, IMAGES, REWARD, STATE, SUCCESS


@dataclass(frozen=True)
class Choice:
    """What of an episode goes into the dataset."""

    state: tuple[str, ...] = ()
    """Keys of the state observations that become ``observation.state``; ``agent`` takes all below it. Empty: what the
    robot knows of itself (``agent``), or all where nothing is called so."""
    environment: tuple[str, ...] = ()
    """Keys that become ``observation.environment_state``; empty leaves it out."""
    cameras: tuple[str, ...] | None = None
    """By name; None takes all that have colour pictures."""
    every: int = 1
    """Keep each so-manieth step, with the action of that step."""


@dataclass(frozen=True)
class Frames:
    """An episode's columns (T, D) by feature, the names of their parts, and its films."""

    columns: dict[str, NDArray]
    names: dict[str, list[str]]
    episode: Episode
    cameras: tuple[str, ...]
    states: NDArray[np.int64]
    """(T,) which states of the episode they are."""

    def pictures(self, camera: str) -> Iterator[NDArray[np.uint8]]:
        """One (H, W, 3) a frame."""
        track = cameras_by_name(self.episode)[camera]
        assert track.rgb is not None
        for state in self.states.tolist():
            yield track.rgb[picture_index(track, state)]

    def features(self) -> dict[str, dict]:
        """As ``meta/info.json`` says them, without those of every frame."""
        said: dict[str, dict] = {}
        for camera in self.cameras:
            info = cameras_by_name(self.episode)[camera].info
            said[IMAGES + feature_name(camera)] = {
                "dtype": "video",
                "shape": [info.height, info.width, 3],
                "names": ["height", "width", "channels"],
            }
        for key, values in self.columns.items():
            said[key] = {"dtype": str(values.dtype), "shape": [values.shape[1]], "names": self.names.get(key)}
        return said


def feature_name(name: str) -> str:
    """A camera's name as part of a feature's, where a slash is not allowed."""
    return name.replace("/", "_")


def frames_of(episode: Episode, choice: Choice = Choice()) -> Frames:
    """The episode as frames.

    Raises:
        ValueError: it has no step, or lacks what was chosen; the message says what there is.
    """
    if not episode.length:
        raise ValueError("has no step")
    states = np.arange(0, episode.length, choice.every)
    # Of a step that is left out, the reward counts and the end is not lost.
    rewards = np.add.reduceat(episode.reward.astype(np.float64), states).astype(np.float32)
    done = np.logical_or.reduceat(episode.terminated | episode.truncated, states)
    columns: dict[str, NDArray] = {}
    names: dict[str, list[str]] = {}
    sources = _numbers(episode)
    keys = {STATE: choice.state or _usual_state(sources), ENVIRONMENT: choice.environment}
    for feature, wanted in keys.items():
        chosen = [key for name in wanted for key in _below(sources, name)]
        if chosen:
            columns[feature] = np.concatenate([sources[key][states] for key in chosen], axis=1)
            names[feature] = [part for key in chosen for part in _parts(key, sources[key].shape[1])]
    columns[ACTION] = episode.action[states].astype(np.float32)
    names[ACTION] = [str(name).replace("/", ".") for name in episode.action_names]
    columns[REWARD] = rewards[:, None]
    columns[DONE] = done[:, None]
    if (succeeded := episode.flag("success")) is not None:
        columns[SUCCESS] = np.logical_or.reduceat(succeeded[1:], states)[:, None]
    there = tuple(cameras_by_name(episode))
    cameras = there if choice.cameras is None else choice.cameras
    for camera in cameras:
        if camera not in there:
            raise ValueError(f"has no camera {camera!r} with pictures; it has {', '.join(there) or 'none'}")
    return Frames(columns, names, episode, cameras, states)


def _numbers(episode: Episode) -> dict[str, NDArray[np.float32]]:
    """State observations (T + 1, D) by key; where there are none, the joints of the robots from the env states."""
    found = {
        key: values
        for key, values in episode.obs.items()
        if np.issubdtype(values.dtype, np.number) or values.dtype == bool
    }
    if not found:
        for name, values in episode.env_states.items():
            if name.startswith("articulations/"):
                # Pose of the root (7), its velocities (6), then positions and velocities of the joints.
                joints = (values.shape[1] - 13) // 2
                found[f"agent/{name.split('/', 1)[1]}/qpos"] = values[:, 13 : 13 + joints]
    return {
        key or "state": values.reshape(len(values), -1).astype(np.float32) for key, values in found.items()
    }


def _usual_state(sources: dict[str, NDArray[np.float32]]) -> tuple[str, ...]:
    return ("agent",) if any(key.split("/")[0] == "agent" for key in sources) else tuple(sources)


def _below(sources: dict[str, NDArray[np.float32]], name: str) -> Sequence[str]:
    chosen = [key for key in sources if key == name or key.startswith(name.rstrip("/") + "/")]
    if not chosen:
        raise ValueError(f"has no observation {name!r}; it has {', '.join(sources) or 'none'}")
    return chosen


def _parts(key: str, width: int) -> list[str]:
    name = key.replace("/", ".")
    return [name] if width == 1 else [f"{name}.{index}" for index in range(width)]

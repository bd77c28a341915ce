"""The 3-D scene of recordings that hold none: the env that they name is made again, and put into each recorded state.

ManiSkill's own recordings keep the states of actors and joints, but neither meshes nor the poses of links. Only the
env knows those. So it is made once more, in a process of its own (it is somebody's code, it may be missing or
broken, and this process is to know nothing of simulators), reset with the recorded seed so that what depends on it is
there, and set to one recorded state after the other; what comes back is a geometry and poses.

The process lives as long as there is something to make in one go: several episodes of one file share its env.
"""

from __future__ import annotations

import os
import socket
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.core.geometry import SceneGeometry
from workbench.machine.child_python import child_environment, python_command
from workbench.machine.family import end_family
from workbench.recording.episode import Episode
from workbench.session.clearance import files_named
from workbench.session.message_reader import MessageReader, Unreadable

_LOOK = 0.1
_NOT_PASSED_ON = (
    "num_envs", "obs_mode", "reward_mode", "render_mode", "sim_backend", "render_backend", "backend",
    "parallel_in_single_scene", "sensor_configs", "human_render_camera_configs", "viewer_camera_configs",
    "enable_shadow", "max_episode_steps",
)  # fmt: skip
"""Keywords of ``gym.make`` that change nothing about where bodies are."""


class SceneError(RuntimeError):
    """Why a recording's scene cannot be made, a sentence."""


@dataclass(frozen=True)
class SceneWanted:
    """What the process is asked for."""

    task: str
    """Registered id."""
    files: tuple[str, ...]
    """Task files in which it may be found before ManiSkill is asked."""
    env_kwargs: dict[str, Any]
    seed: int
    reset_options: dict[str, Any]
    env_states: dict[str, NDArray]
    """(T + 1, D) by name."""
    imports: tuple[str, ...] = ()
    """As `TaskOptions.imports`."""


@dataclass(frozen=True)
class Said:
    words: str


@dataclass(frozen=True)
class SceneMade:
    geometry: SceneGeometry
    poses: NDArray[np.float32]
    """(T + 1, B, 7)"""
    missed: tuple[str, ...]
    """What of the states could not be put into the env, each with its reason."""


@dataclass(frozen=True)
class SceneFailed:
    why: str


class SceneProcess:
    """Makes scenes; see `workbench.session.review.SceneMaker`."""

    def __init__(self, files: Sequence[Path] = (), imports: tuple[str, ...] = ()) -> None:
        """
        Args:
            files: Task files in which the envs of recordings may be found.
            imports: As `TaskOptions.imports`.
        """
        self._imports = imports
        self._files = tuple(str(Path(file).absolute()) for file in files)

    def __call__(
        self,
        episodes: Mapping[int, Episode],
        stop: Callable[[], bool],
        on_progress: Callable[[int, str], None],
        on_end: Callable[[int, Episode | SceneError, tuple[str, ...]], None],
    ) -> None:
        """Make the scenes of these, one after the other. Returns when all have one, or an error, or on `stop`.

        Args:
            stop: asked a few times a second.
            on_progress: called with the key of an episode and what is being done for it.
            on_end: called with its key, and the episode with a scene and what could not be put back, or why there is
                none.
        """
        ours, theirs = socket.socketpair()
        with ours, theirs:
            worker = ("workbench.session.recorded_scene_worker", str(theirs.fileno()))
            process = subprocess.Popen(
                python_command("-m", "workbench.machine.family", str(os.getpid()), *worker),
                env=child_environment(),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
            theirs.close()
            connection = Connection(os.dup(ours.fileno()))
            reader = MessageReader(ours, SceneMade | SceneFailed | Said)
            try:
                for key, episode in episodes.items():
                    on_progress(key, "making its scene")
                    try:
                        made = self._one(
                            process,
                            connection,
                            reader,
                            episode,
                            stop,
                            lambda words, k=key: on_progress(k, words),
                        )
                    except SceneError as error:
                        on_end(key, error, ())
                        continue
                    if made is None:
                        return
                    on_end(key, replace(episode, geometry=made.geometry, poses=made.poses), made.missed)
            finally:
                connection.close()
                end_family(process)

    def _one(
        self,
        process: subprocess.Popen[bytes],
        connection: Connection,
        reader: MessageReader,
        episode: Episode,
        stop: Callable[[], bool],
        on_progress: Callable[[str], None],
    ) -> SceneMade | None:
        """None if it was stopped."""
        info = episode.info
        if named := files_named(info):
            # This is done when a row is opened; an env would read them, and may do so in native code.
            raise SceneError(
                f"It names files for {info.task} to read ({', '.join(named[:3])}), which is not done for looking at it, so "
                "there are numbers and curves only."
            )
        kwargs = {name: value for name, value in info.env_kwargs.items() if name not in _NOT_PASSED_ON}
        wanted = SceneWanted(
            info.task,
            self._files,
            kwargs,
            info.seed,
            dict(info.reset_options),
            dict(episode.env_states),
            self._imports,
        )
        try:
            connection.send(wanted)
            while not stop():
                event = reader.receive(_LOOK)
                if event is None:
                    if process.poll() is not None and (event := reader.receive(0)) is None:
                        raise EOFError
                    if event is None:
                        continue
                if isinstance(event, SceneMade):
                    return event
                if isinstance(event, SceneFailed):
                    raise SceneError(event.why)
                on_progress(event.words)
        except Unreadable as error:
            process.terminate()
            raise SceneError(
                f"The process that makes the scene of {info.task} sent what cannot be read ({error}), so there are "
                "numbers and curves only."
            ) from error
        except (EOFError, OSError) as error:
            raise SceneError(
                f"The process that makes the scene of {info.task} ended in the middle of it, so there are numbers and "
                "curves only."
            ) from error
        return None

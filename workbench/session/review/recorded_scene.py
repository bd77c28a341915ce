"""The 3-D scene of recordings that hold none: the env that they name is made again, and put into each recorded state.

ManiSkill's own recordings keep the states of actors and joints, but neither meshes nor the poses of links. Only the
env knows those. So it is made once more, in a process of its own (it is somebody's code, it may be missing or
broken, and this process is to know nothing of simulators), reset with the recorded seed so that what depends on it is
there, and set to one recorded state after the other; what comes back is a geometry and poses.

The process lives as long as there is something to make in one go: several episodes of one file share its env.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from workbench.core.capture.recorded_run import HOW_IT_IS_RUN
from workbench.recording.episode.episode import Episode
from workbench.session.clearance import files_named
from workbench.session.process.askers import Background, OnProgress
from workbench.session.process.job_lane import JobFailed
from workbench.session.protocol.questions import MakeScene, SceneMade

_NOT_PASSED_ON = HOW_IT_IS_RUN | {
    "obs_mode", "reward_mode", "backend", "parallel_in_single_scene", "sensor_configs",
    "human_render_camera_configs", "viewer_camera_configs", "enable_shadow", "max_episode_steps",
}  # fmt: skip
"""Keywords of ``gym.make`` that change nothing about where bodies are."""


class SceneError(RuntimeError):
    """Why a recording's scene cannot be made, a sentence."""


class SceneProcess:
    """Makes the scenes of recordings that have none."""

    def __init__(self, files: Sequence[Path] = (), imports: tuple[str, ...] = ()) -> None:
        """
        Args:
            files: Task files in which the envs of recordings may be found.
            imports: As `TaskOptions.imports`.
        """
        self._imports = imports
        self._files = tuple(str(Path(file).absolute()) for file in files)

    def __call__(
        self, episodes: Sequence[Episode], check: Callable[[], None], say: Callable[[int, str], None]
    ) -> Iterator[tuple[Episode, tuple[str, ...]] | SceneError]:
        """Make the scenes of these, one after the other: each episode with its scene and what could not be put back, or
        why there is none.

        Args:
            check: called a few times a second; what it raises ends it.
            say: called with the place of an episode among `episodes` and what is being done for it.
        """
        process = Background(niceness=0)
        try:
            for number, episode in enumerate(episodes):
                say(number, "making its scene")
                try:
                    made = self._one(
                        process, episode, check, lambda done, total, words, number=number: say(number, words)
                    )
                except SceneError as error:
                    yield error
                else:
                    yield replace(episode, geometry=made.geometry, poses=made.poses), made.missed
        finally:
            process.end()

    def _one(
        self, process: Background, episode: Episode, check: Callable[[], None], on_progress: OnProgress
    ) -> SceneMade:
        info = episode.info
        if named := files_named(info):
            # This is done when a row is opened; an env would read them, and may do so in native code.
            raise SceneError(
                f"It names files for {info.task} to read ({', '.join(named[:3])}), which is not done for looking at it, so "
                "there are numbers and curves only."
            )
        kwargs = {name: value for name, value in info.env_kwargs.items() if name not in _NOT_PASSED_ON}
        wanted = MakeScene(
            info.task,
            self._files,
            kwargs,
            info.seed,
            dict(info.reset_options),
            dict(episode.env_states),
            self._imports,
        )
        try:
            process.start()
            return process.ask(check, wanted, on_progress)
        except JobFailed as failure:
            if process.pid is not None:
                raise SceneError(str(failure)) from failure
            why = f"The scene of {info.task} could not be made ({failure}), so there are numbers and curves only."
            raise SceneError(why) from failure

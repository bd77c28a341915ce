"""Makes 3-D scenes for recordings that contain none (those of ManiSkill), from the env that each names."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from workbench.envs.recorded_run import RUN_KEYWORDS
from workbench.episodes.episode import Episode
from workbench.live.process.ask import Background, OnProgress
from workbench.live.process.background_jobs import JobFailed, ProcessDied
from workbench.live.questions_without_task import MakeScene, SceneMade
from workbench.machine.loop import result_of
from workbench.trust.clearance import paths_in_arguments

_NOT_PASSED_ON = RUN_KEYWORDS | {
    "obs_mode", "reward_mode", "backend", "parallel_in_single_scene", "sensor_configs",
    "human_render_camera_configs", "viewer_camera_configs", "enable_shadow", "max_episode_steps",
}  # fmt: skip
"""Keywords of ``gym.make`` that do not change where bodies are."""


class SceneError(RuntimeError):
    """A recording's scene cannot be made; the text is the reason, as a sentence."""


class SceneProcess:
    """Makes scenes in a separate process, which ends with the call.

    ManiSkill's own recordings contain the states of actors and joints, but neither meshes nor poses of links.
    So the env is built, reset with the recorded seed, and set to each recorded state. A separate process is
    needed because the env's code may be missing or broken, and because the server imports no simulator.
    Several episodes of one file share an env.
    """

    def __init__(self, files: Sequence[Path] = (), imports: tuple[str, ...] = ()) -> None:
        """
        Args:
            files: Task files that may define the envs of recordings.
            imports: See `TaskOptions.imports`.
        """
        self._imports = imports
        self._files = tuple(str(Path(file).absolute()) for file in files)

    def __call__(
        self, episodes: Sequence[Episode], check: Callable[[], None], on_progress: Callable[[int, str], None]
    ) -> Iterator[tuple[Episode, tuple[str, ...]] | SceneError]:
        """Yield for each episode: a copy with its scene, and texts on what could not be restored; or the
        reason why there is no scene.

        Args:
            check: called a few times a second; an exception in it ends the work.
            on_progress: called with an index into `episodes` and the current work for that episode.
        """
        process = Background(niceness=0)
        try:
            for number, episode in enumerate(episodes):
                on_progress(number, "making its scene")
                try:
                    made = self._make(
                        process,
                        episode,
                        check,
                        lambda done, total, words, number=number: on_progress(number, words),
                    )
                except SceneError as error:
                    yield error
                else:
                    yield replace(episode, geometry=made.geometry, poses=made.poses), made.missed
        finally:
            process.close()

    def _make(
        self, process: Background, episode: Episode, check: Callable[[], None], on_progress: OnProgress
    ) -> SceneMade:
        info = episode.info
        if named := paths_in_arguments(info):
            # Opening a recording must not make an env read files that the recording names: native code may
            # parse them.
            raise SceneError(
                f"This recording names files for {info.task} to read ({', '.join(named[:3])}). They are not "
                "read for a review, so there are only numbers and curves."
            )
        kwargs = {name: value for name, value in info.env_kwargs.items() if name not in _NOT_PASSED_ON}
        question = MakeScene(
            info.task,
            self._files,
            kwargs,
            info.seed,
            dict(info.reset_options),
            dict(episode.env_states),
            self._imports,
        )
        try:
            return result_of(process.ask(question, on_progress), check)
        except ProcessDied as failure:
            why = f"The scene of {info.task} could not be made ({failure}), so there are only numbers and curves."
            raise SceneError(why) from failure
        except JobFailed as failure:
            raise SceneError(str(failure)) from failure

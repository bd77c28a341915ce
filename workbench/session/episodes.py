"""From the stream of steps of a batch to finished episodes, one env at a time.

The page's Record button and ``workbench record`` gather the same way: an env's episode begins with a
reset and ends when it terminates, is truncated, or is reset; whoever gathers gets it as columns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version

from workbench.core.pictures import CameraInfo, CameraKind, Picture
from workbench.core.step import StepResult
from workbench.recording.columns import EpisodeBuilder
from workbench.recording.episode import Episode, EpisodeInfo
from workbench.session.messages import Stepped, TaskDescription

_PACKAGES = ("maniskill-workbench", "mani_skill", "sapien", "torch", "rerun-sdk")


def recorded_pictures(cameras: Iterable[CameraInfo]) -> tuple[tuple[str, CameraKind, tuple[str, ...]], ...]:
    """What an episode keeps: of a sensor what a policy may see, of a human camera colour."""
    asked = []
    for camera in cameras:
        wanted = ("rgb", "depth", "segmentation") if camera.kind == "sensor" else ("rgb",)
        kept = tuple(modality for modality in wanted if modality in camera.modalities)
        asked.append((camera.name, camera.kind, kept))
    return tuple(asked)


class EpisodeGatherer:
    """Gathers the episodes of some envs of one task; `on_episode` gets each when it ends."""

    def __init__(
        self, task: TaskDescription, env_idx: Sequence[int], on_episode: Callable[[Episode], None]
    ) -> None:
        self._task = task
        self._on_episode = on_episode
        self._builders: dict[int, EpisodeBuilder | None] = {int(env): None for env in env_idx}

    @property
    def steps(self) -> int:
        """Steps gathered of the episodes under way, over all envs."""
        return sum(len(builder) for builder in self._builders.values() if builder is not None)

    def take(self, stepped: Stepped) -> None:
        """The next reset or step of the batch."""
        for env in self._builders:
            if stepped.reset_mask[env]:
                self.end(env)
                if stepped.step.elapsed_steps[env] != 0:
                    continue  # somebody went back into an episode: no seed starts one there
                seed = int(stepped.seeds[env]) if stepped.seeds is not None else -1
                self._begin(env, stepped.step, seed, stepped.captured)
            elif stepped.step.action is not None:
                self._append(env, stepped.step, stepped.captured)

    def finish(self) -> None:
        """End the episodes under way where they are."""
        for env in self._builders:
            self.end(env)

    def end(self, env: int) -> None:
        """End the episode of `env` where it is; it must have a step to be kept."""
        builder, self._builders[env] = self._builders[env], None
        if builder is not None and len(builder) > 0:
            self._on_episode(builder.finish())

    def _begin(self, env: int, step: StepResult, seed: int, pictures: Iterable[Picture]) -> None:
        task = self._task
        info = EpisodeInfo(
            task=task.env_id,
            env_index=env,
            seed=seed,
            source_file=task.file,
            source_hash=task.source_hash,
            source=task.source,
            control_dt=task.control_dt,
            control_mode=task.control_mode,
            backend=task.backend,
            versions=package_versions(),
        )
        names = [dimension.name for dimension in task.actions]
        builder = EpisodeBuilder(info, task.geometry, task.segmentation, names, task.cameras)
        builder.start(step, env, pictures)
        self._builders[env] = builder

    def _append(self, env: int, step: StepResult, pictures: Iterable[Picture]) -> None:
        builder = self._builders[env]
        if builder is None:
            return
        builder.append(step, env, pictures)
        if step.terminated[env] or step.truncated[env]:
            self.end(env)


def package_versions() -> dict[str, str]:
    """Versions of what an episode depends on, for its properties."""
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # a source checkout that was never installed
            continue
    return found

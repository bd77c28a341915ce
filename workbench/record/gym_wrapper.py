"""``workbench.Recorder``: a gymnasium wrapper that records the episodes of an env of `workbench.make`."""

from __future__ import annotations

import logging
import threading
import warnings
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.gym_utils import find_max_episode_steps_value

from workbench.envs import action_vector as actions
from workbench.envs.camera_data import Picture
from workbench.envs.maniskill_private import draws_its_own_seeds, last_observation, open_env, task_class
from workbench.envs.simulation.stepping import usable_cores
from workbench.envs.state_columns import StateReading, copy_states
from workbench.envs.step_result import StepResult
from workbench.envs.task_drawings import Drawing, drawings
from workbench.envs.task_env import TaskEnv
from workbench.episodes.episode import NO_SEED
from workbench.episodes.reader.reading import recovered_text
from workbench.episodes.writing.episode_writer import EpisodeFiles
from workbench.episodes.writing.finish_or_recover import recover
from workbench.episodes.writing.journal import before_writing
from workbench.episodes.writing.publish import RecordingError
from workbench.pictures.render import Request, recorded_pictures, step_pictures
from workbench.record.gather import EpisodeFinisher, EpisodeGatherer, GatheredEpisode
from workbench.task.description import Stepped, TaskDescription
from workbench.task.load import task_of_class
from workbench.task.open import describe

logger = logging.getLogger(__name__)
_MAX_PENDING_STEPS = 2048
"""Maximum number of pending steps, summed over the envs; together they take 3 MB. Steps are gathered earlier
when an episode begins, and before each write of the journals."""
_MAX_PENDING_PICTURE_BYTES = 1 << 25
"""Maximum size of the pictures that wait for the gatherer."""

_SUBPROCESS_ENVS = 4
"""Number of recorded envs from which on a subprocess makes the files. With fewer envs, starting it costs more
time than it saves."""


class _PendingStep(NamedTuple):
    """A step that waits for the gatherer."""

    step: StepResult
    reset_mask: np.ndarray
    pictures: list[Picture]
    seeds: np.ndarray | None
    states: StateReading

    def stepped(self) -> Stepped:
        columns = self.states.columns()
        return Stepped(self.step, self.reset_mask, tuple(self.pictures), self.seeds, columns=columns)


class Recorder(gym.Wrapper):
    """Records the episodes of an env of `workbench.make`::

        env = workbench.make("PickCube-v1", num_envs=16)
        env = workbench.Recorder(env, "recordings/")
        env = ManiSkillVectorEnv(env, auto_reset=True)  # other wrappers go around the Recorder
        env.reset(seed=0)
        for _ in range(200):
            env.step(policy(obs))
        env.close()  # waits for the files

    Writes the same files as the page and ``workbench record``, one set per episode: .rrd, .h5 and .json. An
    episode of an env lasts from one reset to the next, so you can use partial resets, auto-resets and
    wrappers that continue after success. The Recorder records the env's own state, observation and reward, so
    it must wrap the env of `make` directly, inside all wrappers that change actions. If at least four envs
    are recorded, a subprocess makes the files (on a machine with more than one core).

    A full disk must not end a training loop: if the files cannot be written, one warning is given, the
    recording ends, and `problem` has the reason.
    """

    def __init__(
        self,
        env: gym.Env,
        folder: str | Path,
        *,
        env_idx: Sequence[int] | None = None,
        pictures: bool | Sequence[str] = False,
        acted_by: str = "a program",
    ) -> None:
        """
        Args:
            env: an env of `workbench.make`.
            folder: created if it is missing. Unfinished files of an earlier recording in it are recovered.
            env_idx: the envs to record; None for all.
            pictures: cameras whose pictures are recorded at every step: True for all, a sequence of names for
                these cameras, False for none. Sensors that are part of the observation are rendered anyway;
                any other picture takes 25 to 50 ms without a GPU.
            acted_by: source of the actions, such as the name of a policy, for readers of the recordings.

        Raises:
            TypeError: `env` is not a ManiSkill env, or is already wrapped as a vector env.
            IndexError: `env_idx` has an env that does not exist.
            RecordingError: `folder` cannot be written to.
        """
        if not isinstance(env, gym.Env) or isinstance(env, gym.vector.VectorEnv):
            raise TypeError(
                "Recorder must wrap the env of workbench.make directly, inside a vector env: "
                f"not a {type(env).__name__}"
            )
        super().__init__(env)
        base: BaseEnv = open_env(env)
        chosen = list(range(base.num_envs)) if env_idx is None else [int(i) for i in env_idx]
        if any(not 0 <= i < base.num_envs for i in chosen):
            raise IndexError(f"env_idx {chosen} is out of range for {base.num_envs} envs")
        self._folder, self._envs, self._pictures = Path(folder).absolute(), chosen, pictures
        self._acted_by = acted_by
        if self._folder.is_dir():
            recovered = [str(files.rrd) for files in recover(self._folder)]
            if notice := recovered_text(recovered):
                logger.warning("%s", notice)
        self._task = TaskEnv(base)
        many = len(chosen) >= _SUBPROCESS_ENVS and usable_cores() > 1
        self._finisher = EpisodeFinisher(in_process=many)
        self._made: list[Future[EpisodeFiles | str]] = []
        """Files of finished episodes that are being written."""
        self._gatherer: EpisodeGatherer | None = None
        self._pending: deque[_PendingStep] = deque()
        """Steps that wait for the gatherer. Gathering each step at once, while the env waits and the CPU
        caches are full of physics, costs twice as much as gathering many together."""
        self._waiting_pictures = 0
        """Size of the waiting pictures in bytes; approximate, since another thread may gather at the same time."""
        self._gathering = threading.Lock()
        self._failure: Exception | None = None
        """Exception that gathering raised, perhaps on another thread."""
        before_writing(self._gather)
        self._drawn: dict[str, Drawing] = {}
        """What the env drew, by name."""
        self._scene: Any = None
        self._description: TaskDescription | None = None
        self._seeds = np.full(base.num_envs, NO_SEED, np.int64)
        self._elapsed = np.zeros(base.num_envs, np.int32)
        self._finished = False
        self.problem: str | None = None
        """The error that ended the recording; None if no error has ended it."""

    @property
    def episodes_written(self) -> int:
        return self._finisher.finished.count

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        with self._drawings():
            obs, info = self.env.reset(seed=seed, options=options)
        count = self._task.num_envs
        mask = np.zeros(count, bool)
        chosen = (options or {}).get("env_idx")
        mask[slice(None) if chosen is None else np.asarray([int(i) for i in chosen])] = True
        self._seeds[mask] = self._seeds_of_reset(seed)[mask]
        self._task.obs, none = last_observation(self._task.env), np.zeros(count, bool)
        with self._drawings():
            step = self._task.result(info, np.zeros(count), None, none, none, look=False)
        if self._scene is not self._task.env.scene and not self._finished:
            self._begin()
        if self._gatherer is not None:
            self._gather()  # before the options change
            other_options = {k: v for k, v in (options or {}).items() if k != "env_idx"}
            self._gatherer.reset_options = other_options
        self._add_step(step, mask)
        return obs, info

    def _drawings(self) -> AbstractContextManager[None]:
        return nullcontext() if self._finished else drawings.taken_into(self._drawn)

    def _seeds_of_reset(self, seed: Any) -> np.ndarray:
        """(N,) seeds of a reset; NO_SEED for an env that was reset without a seed.

        A reset without a seed, such as an auto-reset, continues the random generators, while ManiSkill still reports the seed
        of an earlier episode.
        """
        task = self._task
        if seed is None and not draws_its_own_seeds(task.env):
            return np.full(task.num_envs, NO_SEED, np.int64)
        # (N,); shorter after a partial reset: one seed for each env that was reset, from index 0 on.
        seeds = task.episode_seeds
        return np.concatenate([seeds, np.full(max(0, task.num_envs - len(seeds)), NO_SEED, np.int64)])

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        task = self._task
        made = actions.to_flat_action(task.env, task.parts, action) if task.parts else None
        with self._drawings():
            given = self.env.step(action)
        if self._gatherer is not None:
            obs, reward, terminated, truncated, info = given
            if made is None:
                made = np.zeros((task.num_envs, 0), np.float32)
            task.obs = last_observation(task.env)
            with self._drawings():
                step = task.result(info, reward, made, terminated, truncated, look=False)
            self._add_step(step, np.zeros(task.num_envs, bool))
        return given  # type: ignore[return-value]

    def finish(self) -> None:
        """End the recording and all running episodes, and wait for their files. The env stays usable."""
        if not self._finished:
            self._finished = True
            self._end()
            self._finisher.close()
            self._report_failures()

    def close(self) -> None:
        """`finish`, and close the env."""
        self.finish()
        super().close()

    def _begin(self) -> None:
        """Start gathering for a new scene."""
        self._end()
        base = self._task.env
        self._scene = base.scene
        spec = base.spec
        env_id = type(base).__name__ if spec is None else spec.id
        loaded = task_of_class(task_class(base), env_id)
        given = {} if spec is None else dict(spec.kwargs)
        self._description = describe(loaded, self._task, given, find_max_episode_steps_value(self.env))
        if self.problem is None:
            self._gatherer = EpisodeGatherer(
                self._description, self._envs, self._folder, self._on_episode_end, ends="reset"
            )
            self._gatherer.acted_by = self._acted_by

    def _add_step(self, step: StepResult, reset_mask: np.ndarray) -> None:
        gatherer, task = self._gatherer, self._task
        if gatherer is None or self._description is None:
            return
        requests = self._picture_requests()
        pictures = step_pictures(task, self._envs, requests)
        seeds = self._seeds.copy() if reset_mask.any() else None
        self._pending.append(_PendingStep(step, reset_mask, pictures, seeds, copy_states(task)))
        self._waiting_pictures += sum(picture.nbytes for picture in pictures)
        follows = np.array_equal(step.elapsed_steps, self._elapsed + 1)
        self._elapsed = step.elapsed_steps
        full = (
            len(self._pending) * len(reset_mask) > _MAX_PENDING_STEPS
            or self._waiting_pictures > _MAX_PENDING_PICTURE_BYTES
        )
        # If the step does not continue its episode, gather it now: an error is then reported at this step.
        if full or not follows:
            self._gather()
        self._report_failures()

    def _gather(self) -> None:
        with self._gathering:
            self._waiting_pictures = 0
            try:
                while self._pending and self._gatherer is not None:
                    self._gatherer.take(self._pending.popleft().stepped())
            except Exception as error:  # for `_report_failures`: this may be another thread
                self._pending.clear()
                self._failure = error

    def _picture_requests(self) -> Sequence[Request]:
        if not self._pictures or self._description is None:
            return ()
        cameras = self._description.cameras
        if self._pictures is not True:
            cameras = [camera for camera in cameras if camera.name in self._pictures]
        return recorded_pictures(cameras)

    def _stop_recording(self, error: Exception) -> None:
        self._end()
        self.problem = str(error)
        warnings.warn(f"The recording ended: {error}", stacklevel=4)

    def _on_episode_end(self, episode: GatheredEpisode) -> None:
        self._made.append(self._finisher.finish(episode))

    def _end(self) -> None:
        self._gather()
        gatherer, self._gatherer = self._gatherer, None
        if gatherer is not None:
            gatherer.finish()

    def _report_failures(self) -> None:
        failure, self._failure = self._failure, None
        if isinstance(failure, (RecordingError, ValueError)):
            self._stop_recording(failure)
        elif failure is not None:
            raise failure
        done = [future for future in self._made if future.done()]
        if not done:
            return
        self._made = [future for future in self._made if future not in done]
        problems = [result for future in done if isinstance(result := future.result(), str)]
        if problems and self.problem is None:
            self.problem = problems[0]
            self._gatherer = None
            warnings.warn(f"The recording ended: {self.problem}", stacklevel=4)

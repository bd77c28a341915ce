"""Splits the steps of a batch into episodes of each env, and writes their files."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraKey, CameraSettings, Picture
from workbench.envs.recorded_run import STATE, states_of
from workbench.envs.step_result import OtherEntry, StepResult
from workbench.envs.task_drawings import Drawing
from workbench.episodes.columns import BatchPacker
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.side_files import side_files
from workbench.episodes.writing.episode_writer import NO_DRAWINGS, NO_OTHERS, EpisodeFiles, EpisodeWriter
from workbench.episodes.writing.files_process import FilesProcess
from workbench.episodes.writing.publish import RecordingError
from workbench.jobs.pack_author_files import relocated
from workbench.machine.processes.watched_thread import report_failure
from workbench.machine.versions import package_versions
from workbench.task.description import Stepped, TaskDescription

NOWHERE: Mapping[str, str] = MappingProxyType({})


@dataclass
class GatheredEpisode:
    """An episode with its writer; only its journal is on disk so far."""

    writer: EpisodeWriter
    env: int
    seed: int
    """Seed of the reset that began the episode; negative if unknown."""
    steps: int = 0
    total_reward: float = 0.0
    success: bool | None = None
    """Success at its last state; None for a task without ``success``."""
    state_names: frozenset[str] = frozenset()
    """Names of the env states in its first row."""
    acted_by: str = ""
    """Source of its last action."""
    placed: Mapping[CameraKey, CameraSettings] = field(default_factory=dict)
    """Cameras that are placed by hand, at its last state."""
    begun: bool = False
    """Whether it already has its first state."""

    @classmethod
    def of(
        cls,
        folder: Path,
        task: TaskDescription,
        env: int,
        seed: int,
        reset_options: Mapping[str, Any] | None = None,
        acted_by: str = "",
        id: str = "",
        origin: Mapping[str, str] = NOWHERE,
        observed_by: str = "",
    ) -> GatheredEpisode:
        """A new episode with a writer into `folder`; an empty `id` is replaced by a random one, `origin` is as in
        `EpisodeGatherer`. Raises RecordingError."""
        info = relocated(episode_info(task, env, seed, reset_options, acted_by), origin)
        info = replace(info, observed_by=observed_by)
        writer = EpisodeWriter(
            folder,
            replace(info, id=id) if id else info,
            task.geometry,
            task.segmentation,
            [dimension.name for dimension in task.actions],
            task.cameras,
        )
        return cls(writer, env, seed, acted_by=acted_by)

    def set_source(self, what: str) -> None:
        """Set the source of the next action; empty for no change. Raises RecordingError."""
        if what and what != self.acted_by:
            self.writer.acted_by(what)
            self.acted_by = what

    def set_placed(
        self, placed: Mapping[CameraKey, CameraSettings], in_file: Mapping[CameraKey, CameraSettings] = {}
    ) -> None:
        """Record that these cameras are placed by hand from the next state on. Raises RecordingError.

        Args:
            in_file: settings in the recorded source, for cameras whose settings in the task's description differ.
        """
        for key in self.placed.keys() | placed.keys() | in_file.keys():
            if key in in_file or self.placed.get(key) != placed.get(key):
                self.writer.placed(key, placed.get(key), in_file.get(key))
        self.placed = placed

    def take(
        self,
        packer: BatchPacker,
        step: StepResult,
        row: int,
        columns: Mapping[str, NDArray],
        pictures: Sequence[Picture],
    ) -> None:
        """Append row `row` of a batch as the next state; the first state must be the one after a reset.
        Raises as `EpisodeWriter.append` does."""
        if not self.begun:
            self.state_names = frozenset(states_of(columns, row))
            count = len(step.reward)
            no, nothing = np.zeros(count, np.bool_), np.zeros((count, self.writer.actions), np.float32)
            step = replace(
                step, action=nothing, reward=np.zeros(count, np.float32), terminated=no, truncated=no
            )
        batch = batch_columns(step, columns, self.state_names)
        layout, (packed,) = packer.pack([(name, values[row : row + 1]) for name, values in batch])
        others, drawn = others_of(step.others, row), _drawn_in(step.drawn, row)
        self.writer.append(layout, packed, _of_env(pictures, row), others, drawn)
        self.steps += self.begun
        self.begun = True


class EpisodeGatherer:
    """Gathers the episodes of some envs of one task, for the page, ``workbench record`` and `workbench.Recorder`.

    An episode begins with a reset and ends when its env terminates, is truncated or is reset. `on_episode`
    then decides whether its files are made (`EpisodeWriter.finish` takes a fraction of a second, and may run
    on another thread).

    The gatherer checks that `elapsed_steps` counts 0, 1, 2 ...: after a lost step or an unseen reset, the
    recording would be wrong without any sign.
    """

    def __init__(
        self,
        task: TaskDescription,
        env_idx: Sequence[int],
        folder: Path,
        on_episode: Callable[[GatheredEpisode], object],
        *,
        ends: Literal["over", "reset"] = "over",
        one_each: bool = False,
        reset_options: Mapping[str, Any] | None = None,
        origin: Mapping[str, str] = NOWHERE,
    ) -> None:
        """
        Args:
            on_episode: called with each finished episode, including its writer.
            ends: with ``reset``, an episode ends only when its env is reset, for callers that continue after
                termination; with ``over``, it also ends when it terminates or is truncated.
            one_each: gather only the next episode of each env.
            origin: as in `jobs.scheduler.ItemQueue.origin`, so that episodes name the original paths of the
                author's files.
        """
        self._task, self._folder, self._on_episode = task, folder, on_episode
        self._ends, self._one_each, self._origin = ends, one_each, origin
        self.reset_options: Mapping[str, Any] = reset_options or {}
        """Options of the next resets."""
        self.acted_by = ""
        """Source of the actions of the next episodes, if the steps do not name it."""
        self.next_id = ""
        """Id of the next episode; empty for a random one."""
        self._episodes: dict[int, GatheredEpisode | None] = {int(env): None for env in env_idx}
        self._packer = BatchPacker()

    @property
    def env_idx(self) -> tuple[int, ...]:
        """The envs whose episodes are still gathered."""
        return tuple(self._episodes)

    @property
    def under_way(self) -> tuple[GatheredEpisode, ...]:
        """Episodes that have begun and not ended."""
        return tuple(episode for episode in list(self._episodes.values()) if episode is not None)

    def take(self, stepped: Stepped) -> None:
        """Append the next reset or step of the batch.

        Raises:
            ValueError: the step does not follow the previous one, or has values that files cannot represent;
                `finish` can still write the states before that step.
            RecordingError: the step cannot be written.
        """
        step = stepped.step
        reset = stepped.reset_mask.tolist()
        if step.action is not None:
            going_on = [e for e in self._episodes.values() if e is not None and not reset[e.env]]
            for names in {episode.state_names for episode in going_on}:
                self._append([e for e in going_on if e.state_names == names], names, stepped)
        for env in [env for env in self._episodes if reset[env]]:
            self.end(env)
            # A jump into the middle of an episode begins no episode: no seed could start a replay there.
            if env in self._episodes and step.elapsed_steps[env] == 0:
                self._begin(env, stepped)

    def finish(self) -> None:
        """End all running episodes."""
        for env in list(self._episodes):
            self.end(env)

    def end(self, env: int) -> None:
        """End the episode of `env`; an episode without a step is dropped."""
        episode = self._episodes.get(env)
        if episode is None:
            return
        self._episodes[env] = None
        if episode.steps == 0:
            episode.writer.discard()
            return
        if self._one_each:
            del self._episodes[env]
        self._on_episode(episode)

    def drop(self, env: int) -> None:
        """Drop the episode of `env`, if it has one."""
        episode = self._episodes.get(env)
        if episode is not None:
            self._episodes[env] = None
            episode.writer.discard()

    def _begin(self, env: int, stepped: Stepped) -> None:
        seed = int(stepped.seeds[env]) if stepped.seeds is not None else -1
        id, self.next_id = self.next_id, ""
        begun = GatheredEpisode.of(
            self._folder, self._task, env, seed, self.reset_options, self.acted_by, id, self._origin
        )
        try:
            begun.set_placed(stepped.placed)
            begun.take(self._packer, stepped.step, env, stepped.columns, stepped.captured)
        except BaseException:
            begun.writer.discard()
            raise
        self._episodes[env] = begun

    def _append(self, episodes: list[GatheredEpisode], state_names: frozenset[str], stepped: Stepped) -> None:
        """Append the rows of envs with the same state names."""
        step = stepped.step
        elapsed, reward = step.elapsed_steps.tolist(), step.reward.tolist()
        over = (step.terminated | step.truncated).tolist()
        successes = step.evaluate.get("success")
        success: list[bool] | None = None
        if successes is not None:
            # `success` may have several values for each env.
            success = np.any(successes.reshape(len(successes), -1), axis=1).tolist()
        captured, others, acted_by = stepped.captured, step.others, stepped.acted_by
        layout, rows = self._packer.pack(batch_columns(step, stepped.columns, state_names))
        for episode in episodes:
            env = episode.env
            if elapsed[env] != episode.steps + 1:
                raise _lost_step(env, episode.steps + 1, elapsed[env])
            if acted_by != episode.acted_by:
                episode.set_source(acted_by)
            if stepped.placed != episode.placed:
                episode.set_placed(stepped.placed)
            drawn = _drawn_in(step.drawn, env)
            episode.writer.append(layout, rows[env], _of_env(captured, env), others_of(others, env), drawn)
            episode.steps += 1
            episode.total_reward += reward[env]
            episode.success = None if success is None else success[env]
            if over[env] and self._ends == "over":
                self.end(env)


def _lost_step(env: int, expected: int, arrived: int) -> ValueError:
    return ValueError(
        f"env {env}: step {expected} was expected, but step {arrived} arrived; a step was lost, or a reset "
        "bypassed the recorder"
    )


def batch_columns(
    step: StepResult, columns: Mapping[str, NDArray], state_names: frozenset[str]
) -> list[tuple[str, NDArray]]:
    """A control step of the batch as columns for `BatchPacker`; of the env states only those in
    `state_names`."""
    assert step.action is not None
    count = len(step.reward)
    rows = [
        ("poses", step.poses),
        ("action", step.action.reshape(count, -1)),
        ("reward", step.reward),
        ("terminated", step.terminated),
        ("truncated", step.truncated),
    ]
    rows += [("evaluate/" + name, values) for name, values in step.evaluate.items()]
    rows += [
        ("batch/" + name, np.broadcast_to(entry.numbers, (count, *entry.numbers.shape)))
        for name, entry in step.others.items()
        if entry.numbers is not None
    ]
    rows += [
        (name, values)
        for name, values in columns.items()
        if name[: len(STATE)] != STATE or name[len(STATE) :] in state_names
    ]
    return rows


def _of_env(pictures: Sequence[Picture], env: int) -> Sequence[Picture]:
    return [picture for picture in pictures if picture.env == env] if pictures else ()


def others_of(others: Mapping[str, OtherEntry], env: int) -> Mapping[str, OtherEntry]:
    """`StepResult.others` of one env."""
    return {name: entry.of_env(env) for name, entry in others.items()} if others else NO_OTHERS


def _drawn_in(drawn: Mapping[str, Drawing], env: int) -> Mapping[str, Drawing]:
    return {name: drawing.of_env(env) for name, drawing in drawn.items()} if drawn else NO_DRAWINGS


def episode_info(
    task: TaskDescription,
    env: int,
    seed: int,
    reset_options: Mapping[str, Any] | None = None,
    acted_by: str = "",
) -> EpisodeInfo:
    """The info that is needed to repeat an episode of this task."""
    return EpisodeInfo(
        task=task.env_id,
        env_index=env,
        seed=seed,
        source_file=task.file,
        source_hash=task.source_hash,
        source=task.source,
        control_dt=task.control_dt,
        control_mode=task.control_mode,
        backend=task.backend,
        versions=dict(package_versions()),
        env_kwargs=dict(task.env_kwargs),
        reset_options=dict(reset_options or {}),
        max_episode_steps=task.max_episode_steps,
        side_files=side_files(task.file, task.source),
        acted_by=((0, acted_by),) if acted_by else (),
        pictures=task.pictures,
    )


@dataclass(frozen=True)
class Finished:
    """Episodes written so far."""

    count: int = 0
    bytes_written: int = 0
    last: EpisodeFiles | None = None
    problem: str | None = None
    """Reason why the last episode could not be written; None if it was written."""


class EpisodeFinisher:
    """Writes the files of finished episodes one by one on a thread. Thread-safe.

    There is only one thread, because two would compete for the GIL: even at the end, when nothing else needs
    the GIL, two threads take a quarter longer than one (measured). A subprocess does not compete for the GIL.
    If there is a subprocess, `close` also makes files, on the thread that calls it.
    """

    def __init__(
        self,
        on_change: Callable[[], None] = lambda: None,
        first: Callable[[], None] | None = None,
        then: Callable[[EpisodeFiles], None] | None = None,
        in_process: bool = False,
    ) -> None:
        """
        Args:
            on_change: called when an episode's files are written or could not be written, on the finisher's
                thread or by `close`.
            first: called once at the start of the thread.
            then: called with the files of each episode, before the episode counts as finished.
            in_process: make the files in a subprocess, for a caller that needs the GIL. Starting the
                subprocess keeps one core busy for a second.
        """
        self._on_change, self._then = on_change, then
        self._lock = threading.Lock()
        self._finished = Finished()
        self._waiting: deque[tuple[GatheredEpisode, Future[EpisodeFiles | str]]] = deque()
        self._at_work = 0
        self._process: FilesProcess | None = None
        if in_process:
            with suppress(OSError):  # out of memory, or too many processes: the thread makes the files
                self._process = FilesProcess()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="episode-files")
        if first is not None:
            self._pool.submit(first)

    @property
    def finished(self) -> Finished:
        with self._lock:
            return self._finished

    @property
    def waiting(self) -> int:
        """Episodes whose files are not written yet."""
        with self._lock:
            return len(self._waiting) + self._at_work

    def finish(self, episode: GatheredEpisode) -> Future[EpisodeFiles | str]:
        """Queue the episode; returns the future of its files. If they cannot be written, the result is the
        reason as text; `finished.problem` is this reason too, until another episode is written."""
        made: Future[EpisodeFiles | str] = Future()
        with self._lock:
            self._waiting.append((episode, made))
        self._pool.submit(self._finish_next)
        return made

    def close(self) -> None:
        """Wait until all files are written."""
        while self._process is not None and self._process.is_ready and self._finish_one(None):
            pass
        self._pool.shutdown(wait=True)
        if self._process is not None:
            self._process.close()

    def _finish_next(self) -> None:
        self._finish_one(self._process if self._process is not None and self._process.is_ready else None)

    def _finish_one(self, process: FilesProcess | None) -> bool:
        """Write the files of one waiting episode; returns False if none was waiting."""
        with self._lock:
            if not self._waiting:
                return False
            episode, made = self._waiting.popleft()
            self._at_work += 1
        try:
            files, size = self._finish(episode, process)
        except BaseException as error:
            made.set_exception(error)
            raise
        finally:
            with self._lock:
                self._at_work -= 1
        with self._lock:
            before = self._finished
            if isinstance(files, str):
                self._finished = replace(before, problem=files)
            else:
                self._finished = Finished(before.count + 1, before.bytes_written + size, files, None)
        self._on_change()
        made.set_result(files)
        return True

    def _finish(
        self, episode: GatheredEpisode, process: FilesProcess | None
    ) -> tuple[EpisodeFiles | str, int]:
        """(files, or the reason why writing failed; number of bytes)."""
        try:
            made = episode.writer.finish(process)
            size = sum(path.stat().st_size for path in (made.rrd, made.h5, made.json))
            if self._then is not None:
                self._then(made)
        except BaseException as error:
            if isinstance(error, (KeyboardInterrupt, SystemExit)):
                raise
            # A panic of rerun's Rust code is not an Exception. The journal stays, for `recover`.
            if not isinstance(error, (RecordingError, OSError, ValueError)):
                report_failure(f"An episode of env {episode.env} could not be written", error)
            return f"An episode of env {episode.env} could not be written: {error}", 0
        return made, size

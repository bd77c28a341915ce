"""Runs and records episodes on a batch of envs: the work of one worker of `record`."""

from __future__ import annotations

import math
import os
import platform
import tempfile
import time
import uuid
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from workbench.actions.choose import (
    SOLVE,
    STEPS_WITHOUT_LIMIT,
    PlannedActions,
    RecordActionChooser,
    find_actions,
    plain_chooser,
)
from workbench.envs.cpu_scene import BatchedCpuMixin
from workbench.envs.gpu_rules import Finding
from workbench.envs.recorded_run import RecordedRun, states_of
from workbench.envs.state_columns import read_state_columns
from workbench.envs.step_result import StepResult
from workbench.envs.task_drawings import Drawing, drawings
from workbench.episodes.recorded_state import state_distance
from workbench.episodes.replay import restore_recorded
from workbench.episodes.writing.episode_writer import EpisodeFiles
from workbench.episodes.writing.finish_or_recover import remove_episode
from workbench.episodes.writing.publish import RecordingError
from workbench.episodes.writing.upload import remove_uploaded_id, upload_episode
from workbench.jobs.scheduler import Chunk, ItemQueue
from workbench.machine.folders import CurrentFolder
from workbench.pictures.render import findings_of_shaders, recorded_pictures, step_pictures
from workbench.planning.options import PlanOptions
from workbench.planning.planned_episodes import PlannedEpisode
from workbench.planning.rollouts import control_mode_to_plan
from workbench.record.gather import EpisodeFinisher, EpisodeGatherer, GatheredEpisode
from workbench.task.blame import blamed
from workbench.task.description import RecordArguments, Stepped, TaskOptions
from workbench.task.load import undo_load
from workbench.task.open import OpenedTask, open_task

_TRIES_PER_SUCCESS = 100
"""Default for the maximum number of episodes that are tried for each requested success."""
_START_TOLERANCE = 1e-4
"""Maximum distance, in metres or radians, from the demonstration's start state that counts as the same start."""


@dataclass(frozen=True)
class RecordOptions(RecordArguments):
    """Options of a recording, and of its task."""

    options: TaskOptions = field(default_factory=lambda: TaskOptions(num_envs=4))
    plan: PlanOptions = PlanOptions()
    """Options of planned actions."""
    after_success: int = 0
    """Number of control steps that an episode continues after its success."""
    workers: int = 1
    """Number of processes that record, if no executor is given. This number does not change the episodes."""
    source: dict[str, str] = field(default_factory=dict)
    """Texts that are used instead of the task's files on disk, by path."""


@dataclass(frozen=True)
class RecordSetup:
    """Work of one worker of a job that records."""

    wanted: tuple[RecordOptions, ...]
    """Options of each recording of the job, as completed by `with_given_actions`."""
    folders: tuple[bytes, ...]
    """Absolute path of each recording's folder. In bytes, so that the path is not relocated on another
    machine; see `Work.files`."""
    stride: int
    """Item k is episode ``k % stride`` of recording ``k // stride``."""
    run: str
    """Name of the job. The ids of its episodes derive from this name, so that an episode that is recorded
    again replaces its first recording."""
    mark: str = ""
    """Name of a file in the folders, by which a worker on another machine checks that it sees the same folders."""


def episode_id(run: str, number: int) -> str:
    """Id of the episode that is item `number` of a job."""
    return uuid.uuid5(uuid.NAMESPACE_OID, f"{run} {number}").hex


@dataclass(frozen=True)
class BatchProgress:
    """Progress of the episodes that one process is running."""

    steps: tuple[tuple[int, int], ...]
    """(number of the episode, its control steps so far) for each episode."""
    limit: int
    """Maximum number of control steps of an episode."""
    made: int
    """Control steps since the previous message, summed over all envs that run an episode."""


@dataclass(frozen=True)
class RecordUpdate:
    """Progress message of a worker."""

    activity: str = ""
    """Current work before the first episode, for a status line."""
    underway: BatchProgress | None = None
    finding: Finding | None = None
    notice: str = ""
    """Notice about the task, as a sentence."""


@dataclass(frozen=True)
class Written:
    """An episode on disk."""

    index: int
    """Number of the episode in the recording."""
    path: Path
    """Path of its .rrd file; the .h5 and .json files have the same name."""
    seed: int
    steps: int
    total_reward: float | None
    """Return of the episode; None for a task without a reward."""
    success: bool | None
    """Success at its last state; None for a task without ``success``."""
    start_corrected: bool = False
    """Whether the seed gave a different start state than the demonstration has, so that the demonstration's
    first state was restored."""
    planned: PlannedEpisode | None = None
    """Data about the planning, if the actions were planned."""
    address: str = ""
    """Address that its .rrd file was uploaded to, in which case `path` does not exist; empty if it was not
    uploaded."""
    solved_at: int | None = None
    """Control steps until its first state with success; None if no state has success."""
    means: dict[str, float] = field(default_factory=dict)
    """Mean over the episode of each entry of ``evaluate()``, by name; see `episodes.episode.Episode.means`."""

    @property
    def shown(self) -> str:
        """Path or address to print for the episode."""
        return self.address or str(self.path)


def with_given_actions(what: RecordOptions) -> tuple[RecordOptions, Sequence[RecordedRun]]:
    """(options, runs). The options are completed with the number of episodes and the control mode from the
    file of actions. The runs are those of the file: one for each episode, or one for all; none if there is no
    file.

    Raises:
        FileNotFoundError, ValueError: as `find_actions` does; or the requested numbers are invalid.
    """
    given, env_kwargs = find_actions(what.actions, what.task)
    options = replace(what.options, env_kwargs={**env_kwargs, **what.options.env_kwargs})
    if what.fast_pictures:
        options = replace(options, pictures="fast")
    what = replace(what, options=options)
    if what.use_env_states and not (given and all(run.env_states for run in given)):
        raise ValueError("--use-env-states needs --actions FILE.h5 with env states in it")
    if what.episodes is not None and what.successes is not None:
        raise ValueError("give --episodes or --successes, not both")
    for name, number in (
        ("episodes", what.episodes),
        ("successes", what.successes),
        ("tries", what.tries),
        ("workers", what.workers),
        ("max-steps", what.max_steps),
    ):
        if number is not None and number < 1:
            raise ValueError(f"--{name} must be at least 1, not {number}")
    if what.seconds_per_seed is not None and not 0 < what.seconds_per_seed < math.inf:
        raise ValueError(f"--seconds-per-seed must be greater than 0, not {what.seconds_per_seed:g}")
    several = len(given) if len(given) > 1 else 0
    if what.successes is None:
        episodes = what.episodes or len(given) or 4
        if several and episodes > several:
            raise ValueError(
                f"--episodes asks for {episodes} episodes, but {what.actions} has only {several}"
            )
        return replace(what, episodes=episodes), given
    most = what.tries or _TRIES_PER_SUCCESS * what.successes
    return replace(what, tries=min(most, several) if several else most), given


def record_items(setup: RecordSetup, queue: ItemQueue, given: Sequence[RecordedRun] | None = None) -> None:
    """Record the chunks of one worker. Raises as `record.job.record` does.

    Args:
        given: the runs of `with_given_actions`, if they were read already.
    """
    torch.set_num_threads(1)  # see workbench.app.worker.main_loop.work
    here = CurrentFolder()  # the task may change it
    chunk = None
    # If there is only one recording, open it before its first chunk is requested: an error while opening it
    # must not count as the chunk's failure.
    at = 0 if len(setup.wanted) == 1 else _recording_of(chunk := queue.next(), setup)
    while at is not None:
        what = setup.wanted[at]
        runs = with_given_actions(what)[1] if given is None else given
        with here.again():
            folder = Path(os.fsdecode(setup.folders[at]))
            if setup.mark and not what.upload and not (folder / setup.mark).exists():
                raise RecordingError(
                    f"{platform.node()}, a machine of the cluster, does not share the folder {folder}: give a folder that "
                    "all machines of the cluster share, or an address such as s3://bucket/folder"
                )
            drawn: dict[str, Drawing] = {}
            with drawings.taken_into(drawn):
                opened = _opened(what, queue)
            try:
                with _scratch(folder, what) as into:
                    first = at * setup.stride
                    episodes = _Episodes(opened, drawn, what, here, into, runs, queue, setup.run, first)
                    chunk = episodes.run(chunk or queue.next(), (at + 1) * setup.stride)
            finally:
                opened.env.close()
                undo_load(opened.loaded)
        at = _recording_of(chunk, setup)


@contextmanager
def _scratch(folder: Path, what: RecordOptions) -> Iterator[Path]:
    """Folder for the files: the recording's folder, or a temporary one if the files are uploaded."""
    if not what.upload:
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="workbench-upload-") as own:
        yield Path(own)


def _recording_of(chunk: Chunk | None, setup: RecordSetup) -> int | None:
    return None if chunk is None else chunk.numbers[0] // setup.stride


def _opened(what: RecordOptions, queue: ItemQueue) -> OpenedTask:
    opened = _open(what, what.options, queue)
    given = {**opened.loaded.default_kwargs, **what.options.env_kwargs}
    if what.actions != SOLVE or not (mode := control_mode_to_plan(opened.env.env, given)):
        return opened
    opened.env.close()
    undo_load(opened.loaded)
    return _open(what, replace(what.options, env_kwargs={**what.options.env_kwargs, **mode}), queue)


def _open(what: RecordOptions, options: TaskOptions, queue: ItemQueue) -> OpenedTask:
    opened = open_task(
        what.task,
        options,
        source=what.source,
        on_activity=lambda activity: queue.send_update(RecordUpdate(activity)),
        on_finding=lambda finding: queue.send_update(RecordUpdate(finding=finding)),
    )
    for notice in opened.loaded.notices if opened.loaded.followed else ():
        queue.send_update(RecordUpdate(notice=notice))
    if what.pictures:
        for finding in findings_of_shaders(opened.description.cameras):
            queue.send_update(RecordUpdate(finding=finding))
    if isinstance(opened.env.env, BatchedCpuMixin):
        # Without this, the last bits of an episode's numbers depend on earlier episodes of the same process.
        opened.env.env.begins_anew = True
    return opened


class _Episodes:
    """Runs the episodes of one recording: a free env begins the next episode of the chunk, and all envs step
    together."""

    def __init__(
        self,
        opened: OpenedTask,
        drawn: dict[str, Drawing],
        what: RecordOptions,
        here: CurrentFolder,
        folder: Path,
        given: Sequence[RecordedRun],
        queue: ItemQueue,
        run: str,
        first: int,
    ) -> None:
        """
        Args:
            drawn: what the task drew while it was opened.
            run: as in `RecordSetup`.
            first: the item number of this recording's episode 0.
        """
        self._opened, self._what, self._given, self._queue = opened, what, given, queue
        self._drawn = drawn
        self._run, self._first, self._folder = run, first, folder
        limit = what.max_steps or opened.description.max_episode_steps or STEPS_WITHOUT_LIMIT
        if not (given or what.max_steps or opened.description.max_episode_steps):
            text = f"{opened.loaded.env_id} has no time limit: each episode has {limit} steps. --max-steps sets another number."
            queue.send_update(RecordUpdate(notice=text))
        if given:
            limit = min(max(run.length for run in given), what.max_steps or 10**9)
        self._limit = limit
        """Maximum number of control steps of an episode."""
        upload = partial(upload_episode, address=what.upload) if what.upload else None
        self._finisher = EpisodeFinisher(then=upload)
        self._envs = list(range(opened.env.num_envs))
        self._gatherer = EpisodeGatherer(
            opened.description, self._envs, folder, self._over, ends="reset", origin=queue.origin
        )
        self._planned: PlannedActions | None = None
        if what.actions == SOLVE:
            queue.send_update(RecordUpdate("building the envs of the rollouts"))
            self._planned = PlannedActions(opened.loaded, opened.env, what.options.env_kwargs, what.plan)
        self._acts_on_batch = not given and what.actions not in ("random", SOLVE)
        """Whether the action source sees the whole batch: an episode's actions may then depend on its row and on
        the number of envs."""
        self._chooser = RecordActionChooser(
            plain_chooser(what.actions, what.task, what.options.seed, here) if self._acts_on_batch else None,
            self._planned,
        )
        self._wanted = recorded_pictures(opened.description.cameras) if what.pictures else ()
        self._waiting: deque[int] = deque()
        """Items of the chunk that wait for an env."""
        self._chunk = Chunk((), frozenset())
        self._running: dict[int, int] = {}
        """Item of each env that runs an episode."""
        self._steps: dict[int, int] = {}
        self._began: dict[int, float] = {}
        """``time.monotonic()`` at the start of each env's episode."""
        self._start_corrected: set[int] = set()
        """Items with `Written.start_corrected`."""
        self._succeeded: dict[int, int] = {}
        """Control steps since the success of each env's episode."""
        self._plans: dict[int, PlannedEpisode] = {}
        """Planning data of finished episodes with planned actions, by item."""
        self._made: dict[int, tuple[GatheredEpisode, Future[EpisodeFiles | str]]] = {}

    def run(self, chunk: Chunk | None, end: int) -> Chunk | None:
        """Run chunks, starting with this one. After a failure the running episodes are dropped.

        Args:
            end: the first item beyond this recording.

        Returns:
            the first chunk beyond this recording; None if none is left.
        """
        try:
            while chunk is not None and self._first <= chunk.numbers[0] < end:
                self._run_chunk(chunk)
                chunk = self._queue.next()
            return chunk
        finally:
            self._drop_from(0)
            self._finisher.close()
            if self._planned is not None:
                self._planned.close()
            self._collect()

    def _run_chunk(self, chunk: Chunk) -> None:
        self._chunk = chunk
        self._waiting.extend(n for n in chunk.numbers if self._acts_on_batch or n in chunk.wanted)
        if self._acts_on_batch and (idle := self._envs[len(self._waiting) :]):
            # The action source also sees the idle envs: reset them, so that they are in the same state in
            # every run.
            with blamed("reset", self._opened.loaded, self._opened.env):
                self._opened.env.reset(self._seed_of(chunk.numbers[0]), idle)
        while self._begin_free():
            self._step()
            self._collect()
        self._waiting.clear()

    def _begin_free(self) -> bool:
        """Begin episodes in free envs. Returns whether any env runs an episode."""
        limit = self._queue.limit()
        self._drop_from(limit)
        begun = False
        for env in self._envs:
            if env not in self._running and self._waiting and self._waiting[0] < limit:
                self._begin(env, self._waiting.popleft())
                begun = True
        if begun:
            self._send_progress(0)
        return bool(self._running)

    def _send_progress(self, made: int) -> None:
        """Send the progress of the episodes after `made` more control steps."""
        at = tuple((number, self._steps[env]) for env, number in self._running.items())
        self._queue.send_update(RecordUpdate(underway=BatchProgress(at, self._limit, made)))

    def _drop_from(self, limit: int) -> None:
        for env in [env for env, number in self._running.items() if number >= limit]:
            self._gatherer.drop(env)
            self._free(env)

    def _free(self, env: int) -> None:
        del self._running[env]
        self._chooser.end(env)

    def _collect(self) -> None:
        """Report the episodes whose files are written.

        Raises:
            RecordingError: the files of an episode could not be written.
        """
        for number in [number for number, (_, future) in self._made.items() if future.done()]:
            episode, future = self._made.pop(number)
            files = future.result()
            if isinstance(files, str):
                raise RecordingError(files)
            upload = self._what.upload
            start_corrected = number in self._start_corrected
            self._queue.send_result(
                number,
                Written(
                    number - self._first,
                    files.rrd,
                    episode.seed,
                    episode.steps,
                    episode.total_reward if self._opened.env.env.reward_mode != "none" else None,
                    episode.success,
                    start_corrected,
                    self._plans.pop(number, None),
                    f"{upload}/{files.rrd.name}" if upload else "",
                    files.solved_at,
                    dict(files.means),
                ),
            )

    # --- one episode -----------------------------------------------------------------------------------

    def _given_of(self, number: int) -> RecordedRun | None:
        return self._given[(number - self._first) % len(self._given)] if self._given else None

    def _seed_of(self, number: int) -> int:
        given = self._given_of(number)
        own = self._what.options.seed + number - self._first
        return given.seed if given is not None and given.seed >= 0 else own

    def _begin(self, env: int, number: int) -> None:
        task, given, seed = self._opened.env, self._given_of(number), self._seed_of(number)
        id = episode_id(self._run, number)
        if self._chunk.again and number in self._chunk.wanted:
            env_id = self._opened.description.env_id
            if self._what.upload:
                remove_uploaded_id(self._what.upload, env_id, seed, id)
            else:
                remove_episode(self._folder, env_id, seed, id)
        with drawings.taken_into(self._drawn):  # without what the envs of rollouts draw
            with blamed("reset", self._opened.loaded, task):
                step = task.reset(seed, [env])
            self._running[env], self._steps[env], self._succeeded[env] = number, 0, 0
            self._began[env] = time.monotonic()
            if given is not None and given.env_states:
                step = self._correct_start(env, given, step)
        self._gatherer.acted_by = self._chooser.begin(env, seed, given)
        self._gatherer.next_id = id
        mask = np.zeros(task.num_envs, bool)
        mask[env] = True
        self._gatherer.take(self._stepped(step, mask, [env]))

    def _correct_start(self, env: int, given: RecordedRun, step: StepResult) -> StepResult:
        first, task = given.state(0), self._opened.env
        if max(state_distance(states_of(read_state_columns(task), env), first)) <= _START_TOLERANCE:
            return step
        self._start_corrected.add(self._running[env])
        return restore_recorded(self._opened, {env: first})

    def _step(self) -> None:
        """Take a control step in all envs, and end the finished episodes."""
        task, loaded = self._opened.env, self._opened.loaded
        action = self._chooser.next_action(task, {env: self._steps[env] for env in self._running})
        with drawings.taken_into(self._drawn):
            with blamed("step", loaded, task):
                step = task.step(action)
            if self._what.use_env_states:
                states = {
                    env: given.state(self._steps[env] + 1)
                    for env, number in self._running.items()
                    if (given := self._given_of(number)) is not None
                }
                step = restore_recorded(self._opened, states, action)
        none = np.zeros(task.num_envs, bool)
        self._gatherer.take(self._stepped(step, none, sorted(self._running)))
        if self._planned is not None:
            self._planned.add_step(step, sorted(self._running))
        for env in self._running:
            self._steps[env] += 1
        self._send_progress(len(self._running))
        for env in list(self._running):
            over = self._is_over(env, step)
            if not over and self._out_of_time(env):
                over = True
                if self._planned is not None:
                    self._planned.cut_off(env)
            if over:
                self._gatherer.end(env)
                self._free(env)

    def _out_of_time(self, env: int) -> bool:
        most = self._what.seconds_per_seed
        return most is not None and time.monotonic() - self._began[env] > most

    def _is_over(self, env: int, step: StepResult) -> bool:
        given = self._given_of(self._running[env])
        if given is not None:
            return self._steps[env] >= min(given.length, self._what.max_steps or 10**9)
        if step.truncated[env] or self._steps[env] >= self._limit:
            return True
        success = "success" in step.evaluate and bool(step.evaluate["success"][env])
        failed = "fail" in step.evaluate and bool(step.evaluate["fail"][env])
        self._succeeded[env] += success or self._succeeded[env] > 0
        if self._what.after_success and not failed:
            return self._succeeded[env] > self._what.after_success
        return bool(step.terminated[env])

    def _stepped(self, step: StepResult, reset_mask: np.ndarray, pictured: list[int]) -> Stepped:
        task = self._opened.env
        with blamed("pictures", self._opened.loaded, task):
            pictures = tuple(step_pictures(task, pictured, self._wanted))
        with blamed("step", self._opened.loaded, task):
            columns = read_state_columns(task)
        return Stepped(step, reset_mask, pictures, task.episode_seeds, columns=columns)

    def _over(self, episode: GatheredEpisode) -> None:
        number = self._running[episode.env]
        if self._planned is not None:
            self._plans[number] = self._planned.episode(episode.env)
        wanted = number in self._chunk.wanted
        if wanted and (self._what.successes is None or episode.success):
            self._made[number] = episode, self._finisher.finish(episode)
            return
        episode.writer.discard()
        self._plans.pop(number, None)
        if wanted:
            self._queue.send_result(number, None)

"""Records episodes without a page, on a batch of envs in one process or several."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from workbench.authoring.loading.blamed import blamed
from workbench.authoring.loading.load import undo_load
from workbench.core.broken_rule import warn_of
from workbench.core.cameras.render import recorded_pictures, step_pictures
from workbench.core.capture.recorded_run import RecordedRun, states_of
from workbench.core.capture.recorded_state import state_distance
from workbench.core.capture.state_columns import read_state_columns
from workbench.core.env.cpu_scene import BatchedCpuMixin
from workbench.core.env.step_result import StepResult
from workbench.core.rules import Finding
from workbench.jobs.actions import (
    SOLVE,
    STEPS_WITHOUT_LIMIT,
    PlannedActions,
    RecordActionChooser,
    find_actions,
    plain_chooser,
)
from workbench.jobs.gather import EpisodeFinisher, EpisodeGatherer, GatheredEpisode
from workbench.jobs.open_task import OpenedTask, open_task
from workbench.jobs.pool import Deal, Executor, ItemQueue, Processes, ThisProcess, Work, envs_per_process
from workbench.jobs.replay import restore_recorded
from workbench.jobs.task import RecordArguments, Stepped, TaskOptions
from workbench.machine.folders import CurrentFolder
from workbench.planning.episodes import PlannedEpisode
from workbench.planning.options import PlanOptions
from workbench.planning.rollouts import control_mode_to_plan
from workbench.recording.writing.episode_writer import EpisodeFiles
from workbench.recording.writing.publish import RecordingError

_TRIES = 100
"""For each requested success."""
_SAME_START = 1e-4
"""Metres or radians: a start further from the demonstration's is a different one."""


@dataclass(frozen=True)
class RecordOptions(RecordArguments):
    """What to record, and the options of its task."""

    options: TaskOptions = field(default_factory=lambda: TaskOptions(num_envs=4))
    plan: PlanOptions = PlanOptions()
    """Of actions that are planned."""
    after_success: int = 0
    """Control steps that an episode goes on after its success."""


@dataclass(frozen=True)
class Underway:
    """The episodes that one process runs at the moment."""

    steps: tuple[tuple[int, int], ...]
    """Number and control steps so far, of each."""
    limit: int
    """Control steps after which an episode ends at the latest."""
    made: int
    """Control steps since the last of these messages, over all envs with an episode."""


@dataclass(frozen=True)
class RecordUpdate:
    """One thing that a process which records has to say."""

    activity: str = ""
    """What it does before its first episode."""
    underway: Underway | None = None
    finding: Finding | None = None


@dataclass(frozen=True)
class Written:
    """An episode on disk."""

    index: int
    """Its number in the recording."""
    path: Path
    """Its .rrd; the .h5 and .json have the same name."""
    seed: int
    steps: int
    total_reward: float
    success: bool | None
    start_corrected: bool = False
    """Its seed gave another start than the demonstration's, and the demonstration's first state was restored."""
    planned: PlannedEpisode | None = None
    """What is known of it where its actions were planned."""


@dataclass(frozen=True)
class RecordProgress:
    """How far a recording is."""

    kept: int
    """Episodes kept so far."""
    steps: int
    """Control steps so far, over all envs with an episode."""
    over: tuple[int, Written | None] | None = None
    """The episode that has just ended: its number, and what was kept of it; None where none has."""
    running: Mapping[int, int] = field(default_factory=dict)
    """Control steps so far of the episodes under way, by number, in all processes."""
    limit: int = 0
    """Control steps after which one of them ends at the latest."""
    done: float = 0.0
    """As `kept`; where every episode is kept, those under way count in part."""

    def by_seed(self, first: int) -> dict[int, int]:
        """`running` by seed, where episode 0 has seed `first`."""
        return {first + number: steps for number, steps in self.running.items()}


@dataclass(frozen=True)
class Recorded:
    """The result of a recording."""

    written: tuple[Written, ...]
    """By number."""
    tried: int
    """Episodes that were run."""
    stopped: bool
    """It was stopped early."""
    start_corrected: int = 0
    """Episodes with `Written.start_corrected`."""


def with_given_actions(what: RecordOptions) -> tuple[RecordOptions, Sequence[RecordedRun]]:
    """The options, completed from the file of actions (number of episodes, control mode), and the file's runs: one for
    each episode or one for all; empty without a file.

    Raises:
        FileNotFoundError, ValueError: as `find_actions`; or the requested numbers are invalid.
    """
    given, env_kwargs = find_actions(what.actions, what.task)
    options = replace(what.options, env_kwargs={**env_kwargs, **what.options.env_kwargs})
    if what.fast_pictures:
        options = replace(options, pictures="fast")
    what = replace(what, options=options)
    if what.use_env_states and not (given and all(run.env_states for run in given)):
        raise ValueError("--use-env-states needs --actions FILE.h5 with env states in it")
    if what.episodes is not None and what.successes is not None:
        raise ValueError("--episodes and --successes: name one of them")
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
        raise ValueError(f"--seconds-per-seed must be above 0, not {what.seconds_per_seed:g}")
    several = len(given) if len(given) > 1 else 0
    if what.successes is None:
        episodes = what.episodes or len(given) or 4
        if several and episodes > several:
            raise ValueError(f"{what.actions} has {several} episodes, and --episodes asks for {episodes}")
        return replace(what, episodes=episodes), given
    most = what.tries or _TRIES * what.successes
    return replace(what, tries=min(most, several) if several else most), given


def record(
    what: RecordOptions,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_progress: Callable[[RecordProgress], None] = lambda progress: None,
    stop: Callable[[], bool] = lambda: False,
    on_finding: Callable[[Finding], None] = warn_of,
    executor: Executor | None = None,
) -> Recorded:
    """Record into ``what.out``.

    Each episode starts with a reset of its env alone with a seed of its own, and has actions of its own
    (`RecordActionChooser`): episode k is the one that ``gym.make(...).reset(seed=seed + k)`` starts, for any number of envs and
    processes.

    Args:
        on_finding: called once for each place where the task breaks a rule without being stopped.
        stop: called between steps; after True the finished episodes are kept, and the others dropped.
        executor: None for this process, or for spawned processes with several workers.

    Raises:
        TaskError: the task cannot be opened, or fails while it runs.
        RecordingError: a file cannot be written.
        PoolError: a process that records failed or died.
        FileNotFoundError, ValueError: the request is invalid.
    """
    what, given = with_given_actions(what)
    envs = envs_per_process(what.options.num_envs, what.workers)
    setups = [replace(what, options=replace(what.options, num_envs=count)) for count in envs]
    recording = _Recording(what, on_activity, on_progress, stop, on_finding)
    run = _record_items
    if executor is None and len(setups) == 1:
        executor, run = ThisProcess(), partial(_record_items, given=given)
    work = Work(run, setups, result=Written | None, update=RecordUpdate, name="that records")
    (executor or Processes()).run(work, recording.deal)
    return recording.so_far(stop())


class _Recording:
    """Collects the results of all processes.

    Of the successes the K with the lowest numbers are kept. With many envs or processes a later episode may succeed before
    an earlier one has ended; its files are removed when K others come before it.
    """

    def __init__(
        self,
        what: RecordOptions,
        on_activity: Callable[[str], None],
        on_progress: Callable[[RecordProgress], None],
        stop: Callable[[], bool],
        on_finding: Callable[[Finding], None],
    ) -> None:
        self._folder, self._wanted = what.out.absolute(), what.successes
        self._on_activity, self._on_progress, self._on_finding = on_activity, on_progress, on_finding
        self._kept: dict[int, Written] = {}
        self._ended = self._steps = self._step_limit = 0
        self._running: dict[int, int] = {}
        self._found: set[object] = set()
        """Findings of all processes, to report each once."""
        most = what.episodes if what.successes is None else what.tries
        assert most is not None
        self.deal: Deal[Written | None, RecordUpdate] = Deal(range(most), self._over, self._on_update, stop)

    def so_far(self, stopped: bool) -> Recorded:
        enough = self._wanted is not None and len(self._kept) == self._wanted
        written = tuple(self._kept[number] for number in sorted(self._kept))
        start_corrected = sum(episode.start_corrected for episode in written)
        return Recorded(written, written[-1].index + 1 if enough else self._ended, stopped, start_corrected)

    def _over(self, number: int, written: Written | None) -> None:
        self._ended += 1
        self._running.pop(number, None)
        if written is not None:
            self._kept[number] = written
        if self._wanted is not None and len(self._kept) >= self._wanted:
            last = sorted(self._kept)[self._wanted - 1]
            self.deal.lower(last + 1)
            for surplus in [number for number in self._kept if number > last]:
                self._remove(self._kept.pop(surplus))
        self._tell((number, self._kept.get(number)))

    def _on_update(self, update: RecordUpdate) -> None:
        if update.activity:
            self._on_activity(update.activity)
        if (underway := update.underway) is not None:
            self._steps, self._step_limit = self._steps + underway.made, underway.limit
            self._running.update(underway.steps)
            self._tell()
        if (finding := update.finding) is not None and finding.key not in self._found:
            self._found.add(finding.key)
            self._on_finding(finding)

    def _tell(self, over: tuple[int, Written | None] | None = None) -> None:
        limit = self.deal.limit()
        running = {number: steps for number, steps in self._running.items() if number < limit}
        part = sum(min(steps / max(self._step_limit, 1), 1.0) for steps in running.values())
        kept = len(self._kept)
        done = kept + (part if self._wanted is None else 0.0)
        self._on_progress(RecordProgress(kept, self._steps, over, running, self._step_limit, done))

    def _remove(self, episode: Written) -> None:
        for suffix in (".json", ".h5", ".rrd"):  # the .json first: without it there is no episode
            (self._folder / episode.path.name).with_suffix(suffix).unlink(missing_ok=True)


def _record_items(what: RecordOptions, queue: ItemQueue, given: Sequence[RecordedRun] | None = None) -> None:
    """Record the items that one process gets. Raises as `record`.

    Args:
        given: as of `with_given_actions`, if it was read already.
    """
    torch.set_num_threads(1)  # see workbench.session.worker.loop.work
    if given is None:
        what, given = with_given_actions(what)
    here = CurrentFolder()  # the task may change it
    with here.again():
        folder = what.out.absolute()
        opened = _opened(what, queue)
        try:
            _Episodes(opened, what, here, folder, given, queue).run()
        finally:
            opened.env.close()


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
        on_activity=lambda activity: queue.send_update(RecordUpdate(activity)),
        on_finding=lambda finding: queue.send_update(RecordUpdate(finding=finding)),
    )
    if isinstance(opened.env.env, BatchedCpuMixin):
        # Else an episode depends, by its last bits, on those that the same process made before.
        opened.env.env.begins_anew = True
    return opened


class _Episodes:
    """The episodes of one process: a free env takes the next one, and all step together."""

    def __init__(
        self,
        opened: OpenedTask,
        what: RecordOptions,
        here: CurrentFolder,
        folder: Path,
        given: Sequence[RecordedRun],
        queue: ItemQueue,
    ) -> None:
        self._opened, self._what, self._given, self._queue = opened, what, given, queue
        limit = what.max_steps or opened.description.max_episode_steps or STEPS_WITHOUT_LIMIT
        if given:
            limit = min(max(run.length for run in given), what.max_steps or 10**9)
        self._limit = limit
        """Control steps after which an episode ends at the latest."""
        self._finisher = EpisodeFinisher()
        self._envs = list(range(opened.env.num_envs))
        self._gatherer = EpisodeGatherer(opened.description, self._envs, folder, self._over, ends="reset")
        self._planned: PlannedActions | None = None
        if what.actions == SOLVE:
            queue.send_update(RecordUpdate("building the envs of the rollouts"))
            self._planned = PlannedActions(opened.loaded, opened.env, what.options.env_kwargs, what.plan)
        plain = not given and what.actions not in ("random", SOLVE)
        self._chooser = RecordActionChooser(
            plain_chooser(what.actions, what.task, what.options.seed, here) if plain else None, self._planned
        )
        self._wanted = recorded_pictures(opened.description.cameras) if what.pictures else ()
        self._running: dict[int, int] = {}
        """Number of the episode in each env that has one."""
        self._steps: dict[int, int] = {}
        self._began: dict[int, float] = {}
        """Of each env with an episode, ``time.monotonic()`` at its begin."""
        self._start_corrected: set[int] = set()
        """Numbers of the episodes with `Written.start_corrected`."""
        self._succeeded: dict[int, int] = {}
        """Of each env with an episode, the steps since its success."""
        self._plans: dict[int, PlannedEpisode] = {}
        """Of the episodes that are over, by number, where actions are planned."""
        self._made: dict[int, tuple[GatheredEpisode, Future[EpisodeFiles | str]]] = {}

    def run(self) -> None:
        """Run until no episode is left; after a failure those under way are dropped."""
        try:
            while self._begin_free():
                self._step()
                self._collect()
        finally:
            self._drop_from(0)
            self._finisher.close()
            if self._planned is not None:
                self._planned.close()
            self._collect()

    def _begin_free(self) -> bool:
        """Begin episodes in free envs. Returns whether any env has one."""
        self._drop_from(self._queue.limit())
        begun = False
        for env in self._envs:
            if env not in self._running and (index := self._queue.next()) is not None:
                self._begin(env, index)
                begun = True
        if begun:
            self._tell(0)
        return bool(self._running)

    def _tell(self, made: int) -> None:
        """Send how far the episodes are, after so many control steps more."""
        at = tuple((index, self._steps[env]) for env, index in self._running.items())
        self._queue.send_update(RecordUpdate(underway=Underway(at, self._limit, made)))

    def _drop_from(self, limit: int) -> None:
        for env in [env for env, index in self._running.items() if index >= limit]:
            self._gatherer.drop(env)
            self._free(env)

    def _free(self, env: int) -> None:
        del self._running[env]
        self._chooser.end(env)

    def _collect(self) -> None:
        """Report the episodes whose files are written.

        Raises:
            RecordingError: the files of one cannot be written.
        """
        for index in [index for index, (_, future) in self._made.items() if future.done()]:
            episode, future = self._made.pop(index)
            files = future.result()
            if isinstance(files, str):
                raise RecordingError(files)
            shown = self._what.out / files.rrd.name  # as the person named the folder
            start_corrected = index in self._start_corrected
            self._queue.send_result(
                index,
                Written(
                    index,
                    shown,
                    episode.seed,
                    episode.steps,
                    episode.total_reward,
                    episode.success,
                    start_corrected,
                    self._plans.pop(index, None),
                ),
            )

    # --- one episode -----------------------------------------------------------------------------------

    def _given_of(self, index: int) -> RecordedRun | None:
        return self._given[index % len(self._given)] if self._given else None

    def _begin(self, env: int, index: int) -> None:
        task, given = self._opened.env, self._given_of(index)
        seed = self._what.options.seed + index
        if given is not None and given.seed >= 0:
            seed = given.seed
        with blamed("reset", self._opened.loaded, task):
            step = task.reset(seed, [env])
        self._running[env], self._steps[env], self._succeeded[env] = index, 0, 0
        self._began[env] = time.monotonic()
        if given is not None and given.env_states:
            step = self._correct_start(env, given, step)
        self._gatherer.acted_by = self._chooser.begin(env, seed, given)
        mask = np.zeros(task.num_envs, bool)
        mask[env] = True
        self._gatherer.take(self._stepped(step, mask, [env]))

    def _correct_start(self, env: int, given: RecordedRun, step: StepResult) -> StepResult:
        first, task = given.state(0), self._opened.env
        if max(state_distance(states_of(read_state_columns(task), env), first)) <= _SAME_START:
            return step
        self._start_corrected.add(self._running[env])
        return restore_recorded(self._opened, {env: first})

    def _step(self) -> None:
        """Make a control step of all envs, and end the episodes that are over."""
        task, loaded = self._opened.env, self._opened.loaded
        action = self._chooser.next_action(task, {env: self._steps[env] for env in self._running})
        with blamed("step", loaded, task):
            step = task.step(action)
        if self._what.use_env_states:
            states = {
                env: given.state(self._steps[env] + 1)
                for env, index in self._running.items()
                if (given := self._given_of(index)) is not None
            }
            step = restore_recorded(self._opened, states, action)
        none = np.zeros(task.num_envs, bool)
        self._gatherer.take(self._stepped(step, none, sorted(self._running)))
        if self._planned is not None:
            self._planned.add_step(step, sorted(self._running))
        for env in self._running:
            self._steps[env] += 1
        self._tell(len(self._running))
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
        pictures = tuple(step_pictures(task, pictured, self._wanted))
        with blamed("step", self._opened.loaded, task):
            columns = read_state_columns(task)
        return Stepped(step, reset_mask, pictures, task.episode_seeds, columns=columns)

    def _over(self, episode: GatheredEpisode) -> None:
        index = self._running[episode.env]
        if self._planned is not None:
            self._plans[index] = self._planned.episode(episode.env)
        if self._what.successes is not None and not episode.success:
            episode.writer.discard()
            self._plans.pop(index, None)
            self._queue.send_result(index, None)
        else:
            self._made[index] = episode, self._finisher.finish(episode)

"""Rescores recorded episodes on a batch of envs, one episode per env at a time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from workbench.envs import action_vector as actions
from workbench.envs.cpu_scene import BatchedCpuMixin
from workbench.envs.gpu_rules import Finding
from workbench.envs.recorded_run import RecordedRun
from workbench.envs.snapshots.snapshot import step_only
from workbench.envs.step_result import StepResult
from workbench.episodes.episode import Episode, EpisodeInfo
from workbench.episodes.reader.reading import read_recording
from workbench.episodes.recorded_source import recorded_source, run_of
from workbench.episodes.recorded_state import read_states, state_distance
from workbench.episodes.replay import begin_run, restore_recorded, why_not_replayable
from workbench.episodes.row import Source, UnreadableRecording
from workbench.machine.folders import CurrentFolder
from workbench.rescore.verdict import Rescore, Rescored, Scores, Verdict, compare, scalar_entries
from workbench.task.blame import blamed
from workbench.task.description import TaskOptions
from workbench.task.load import undo_load
from workbench.task.open import OpenedTask, open_task
from workbench.task.problem import TaskError
from workbench.task.reference import TaskName

_PROGRESS_SECONDS = 0.2
"""Interval between progress messages."""


@dataclass(frozen=True)
class RescoredBy:
    """Code and options that rescore some recordings."""

    task: TaskName
    """The task. Its code may run, because the submitting side has obtained consent."""
    options: TaskOptions
    or_else: TaskOptions
    """Options to use if the task cannot be opened with `options`."""
    recorded: EpisodeInfo | None = None
    """Recording whose text is opened instead of the current code."""


@dataclass
class _Rescoring:
    """An episode that is being rescored in an env, with its new scores."""

    file: Source
    task: str
    run: RecordedRun
    missed: dict[str, str]
    """Name and reason of each entry that cannot be read or restored into the env."""
    damaged: bool = False
    start_differs: bool = False
    has_reward: bool = True
    """Whether the current code has a reward."""
    reward: list[float] = field(default_factory=list)
    """(T,) new rewards."""
    evaluate: dict[str, list[float]] = field(default_factory=dict)
    """(T + 1,) new values of each entry of evaluate."""
    drift: list[tuple[float, float]] = field(default_factory=list)
    """(T + 1,) metres and radians from the recorded state; zero where no state is recorded."""

    @property
    def at(self) -> int:
        """Index of the recorded state that corresponds to the env's current state."""
        return len(self.reward)

    def verdict(self) -> Verdict[Source]:
        run = self.run
        # A recording of another program may lack rewards: then there is nothing to compare with.
        had_reward = not np.isnan(run.reward).all()
        old = run.reward if had_reward else np.zeros(0)
        now = {name: np.array(rows) for name, rows in self.evaluate.items()}
        return compare(
            self.file,
            Scores(old, scalar_entries(run.evaluate), had_reward),
            Scores(np.array(self.reward), now, self.has_reward),
            np.array(self.drift) if run.env_states else None,
            task=self.task,
            seed=run.seed,
            start_differs=self.start_differs,
            missed=self.missed,
            damaged=self.damaged,
        )


def rescore(
    opened: OpenedTask,
    files: Iterable[Source],
    *,
    use_env_states: bool = False,
    read: Callable[[Source], Episode] = read_recording,
) -> Iterator[Rescored]:
    """Rescore these episodes with the open task's code; yields the verdicts in the order in which the episodes end, and the
    progress a few times a second.

    Each env begins an episode (`replay.begin_run`), applies its actions, and then continues with the next
    episode, without waiting for the other envs. Envs without an episode do not move.

    Args:
        use_env_states: after every step, restore the recorded state, so that nothing drifts.
        read: reads a file's episode; raises as `read_recording` does.

    Raises:
        TaskError: the task's code raised.
    """
    waiting, more = iter(files), True
    rescorings: dict[int, _Rescoring] = {}
    reported, steps = time.monotonic(), 0
    while more or rescorings:
        begun: dict[int, _Rescoring] = {}
        free = [i for i in range(opened.env.num_envs) if i not in rescorings]
        while more and len(begun) < len(free):
            if (file := next(waiting, None)) is None:
                more = False
                break
            episode = _open_episode(opened, file, use_env_states, read)
            if isinstance(episode, Verdict):
                yield Rescored((episode,), 0)
            else:
                begun[free[len(begun)]] = episode
        if begun:
            _begin(opened, begun)
            rescorings |= begun
        if rescorings:
            _one_step(opened, rescorings, use_env_states)
            steps += len(rescorings)
        ended = [env for env, rescoring in rescorings.items() if rescoring.at == rescoring.run.length]
        verdicts = tuple(rescorings.pop(env).verdict() for env in ended)
        if verdicts or time.monotonic() - reported > _PROGRESS_SECONDS:
            yield Rescored(verdicts, steps)
            reported, steps = time.monotonic(), 0


@contextmanager
def opened_code(
    code: RescoredBy,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_finding: Callable[[Finding], None] = lambda finding: None,
) -> Iterator[OpenedTask]:
    """Context manager that opens the task of `code` with `code.options`, or with `code.or_else` if that
    fails.

    Raises:
        TaskError: the task cannot be opened with either of these options.
        CannotEnterRecording: the recorded source cannot be used.
    """
    text = nullcontext(code.task) if code.recorded is None else recorded_source(code.recorded)
    with text as task:
        try:
            opened = open_task(task, code.options, on_activity=on_activity, on_finding=on_finding)
        except TaskError:
            opened = open_task(task, code.or_else, on_activity=on_activity, on_finding=on_finding)
        if isinstance(opened.env.env, BatchedCpuMixin):
            # Without this, the last bits of an episode depend on the earlier episodes of the same process.
            opened.env.env.begins_anew = True
        try:
            yield opened
        finally:
            opened.env.close()
            undo_load(opened.loaded)


def answer(request: Rescore, on_progress: Callable[[int, int, Rescored], None]) -> Rescored:
    """Carry out `request` in a worker. All results go to `on_progress`; the returned answer contains none,
    only the exception if the task's code raised."""
    try:
        code = RescoredBy(request.task, request.options, request.or_else)
        with CurrentFolder().again(), opened_code(code) as opened:
            on_progress(0, 0, Rescored((), 0))
            for part in rescore(opened, request.files, use_env_states=request.use_env_states):
                on_progress(0, 0, part)
    except TaskError as error:
        return Rescored((), 0, error.problem)
    return Rescored((), 0)


def _open_episode(
    opened: OpenedTask, file: Source, use_env_states: bool, read: Callable[[Source], Episode]
) -> _Rescoring | Verdict[Source]:
    try:
        episode = read(file)
    except (UnreadableRecording, OSError) as error:
        return Verdict(file, why_not=str(error), damaged=True)
    run, info = run_of(episode), episode.info
    why_not = why_not_replayable(opened, run)
    if run.length == 0:
        why_not = "it has no step"
    elif use_env_states and not run.env_states:
        why_not = "it has no recorded env states"
    damaged = bool(episode.broken_files)
    if why_not:
        why_not = ". ".join((why_not, *(broken.sentence for broken in episode.broken_files)))
        return Verdict(
            file, task=info.task, seed=info.seed, length=run.length, why_not=why_not, damaged=damaged
        )
    missed = {broken.file: broken.what for broken in episode.broken_files}
    return _Rescoring(file, info.task, run, missed, damaged)


def _begin(opened: OpenedTask, rescorings: dict[int, _Rescoring]) -> None:
    task = opened.env
    runs = {env: rescoring.run for env, rescoring in rescorings.items()}
    beginnings = begin_run(opened.loaded, task, runs)
    with blamed("restore", opened.loaded, task):
        first = task.rescore()
    now = read_states(task.env)
    for env, rescoring in rescorings.items():
        rescoring.has_reward = task.env.reward_mode != "none"
        rescoring.start_differs = beginnings[env].differs
        rescoring.missed = beginnings[env].missed | rescoring.missed
        _add_scores(rescoring, first, env, now)


def _one_step(opened: OpenedTask, rescorings: dict[int, _Rescoring], use_env_states: bool) -> None:
    task = opened.env
    rows = {env: rescoring.run.action[rescoring.at] for env, rescoring in rescorings.items()}
    action = actions.action_of(task.parts, task.num_envs, rows)
    others = step_only(task.env, [*rescorings], None) if len(rescorings) < task.num_envs else nullcontext()
    with others, blamed("step", opened.loaded, task):
        step = task.step(action)
    now = read_states(task.env)
    if use_env_states:
        step = restore_recorded(
            opened,
            {env: rescoring.run.state(rescoring.at + 1) for env, rescoring in rescorings.items()},
            action,
        )
        now = read_states(task.env)
    for env, rescoring in rescorings.items():
        rescoring.reward.append(float(step.reward[env]))
        _add_scores(rescoring, step, env, now)


def _add_scores(
    rescoring: _Rescoring, step: StepResult, env: int, now: dict[str, NDArray[np.float32]]
) -> None:
    for name, values in scalar_entries(step.evaluate).items():
        rows = rescoring.evaluate.setdefault(name, [])
        # Pad with NaN: some entries, such as the terms of a reward, exist only after the first step.
        rows += [np.nan] * (rescoring.at - len(rows))
        rows.append(float(values[env]))
    recorded = rescoring.run.state(rescoring.at)
    far = (
        state_distance({name: rows[env] for name, rows in now.items()}, recorded) if recorded else (0.0, 0.0)
    )
    rescoring.drift.append(far)

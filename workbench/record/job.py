"""Records episodes without a page, on batches of envs in one or several processes."""

from __future__ import annotations

import os
import sys
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from workbench.actions.choose import needed_by
from workbench.envs.broken_rule import warn_of
from workbench.envs.gpu_rules import Finding
from workbench.episodes.writing.upload import remove_uploaded
from workbench.jobs.local_processes import Processes
from workbench.jobs.scheduler import Executor, Failure, ItemQueue, Scheduler, ThisProcess, Work
from workbench.record.job_worker import (
    RecordOptions,
    RecordSetup,
    RecordUpdate,
    Written,
    record_items,
    with_given_actions,
)

MAX_CHUNK_STARTS = 2
"""Maximum number of times that a chunk is started, if its workers die; after that, its episodes are tried one
by one."""
_LONG_JOB_BATCHES = 256
"""From this number of batches on, the chunks of a job hold `_CHUNK_BATCHES` batches instead of one. Envs that
finish early are idle only at the end of a chunk."""
_CHUNK_BATCHES = 4


@dataclass(frozen=True)
class RecordProgress:
    """Progress of a recording."""

    kept: int
    """Episodes kept so far."""
    steps: int
    """Control steps so far, summed over all envs that run an episode."""
    over: tuple[int, Written | None] | None = None
    """Number of the episode that has just ended, and its files (None if they were not kept); None if no episode has
    just ended."""
    running: Mapping[int, int] = field(default_factory=dict)
    """Control steps so far of the running episodes, by number, in all processes."""
    limit: int = 0
    """Maximum number of control steps of an episode."""
    done: float = 0.0
    """Number of episodes kept so far. If all episodes are kept, not only the successes, each running episode
    adds the fraction of it that is done."""
    failures: tuple[Failure, ...] = ()
    """The failures so far, each with the numbers of its episodes, which have no result."""
    was_there: bool = False
    """Whether the episode that has ended comes from an earlier run of the job."""

    def by_seed(self, first: int) -> dict[int, int]:
        """`running` by seed, where episode 0 has seed `first`."""
        return {first + number: steps for number, steps in self.running.items()}


@dataclass(frozen=True)
class Recorded:
    """The result of a recording."""

    written: tuple[Written, ...]
    """The kept episodes, ordered by number."""
    tried: int
    """Number of episodes that were run."""
    stopped: bool
    """Whether it was stopped early."""
    start_corrected: int = 0
    """Number of episodes with `Written.start_corrected`."""
    failures: tuple[Failure, ...] = ()
    """The failures, each with the numbers of the episodes in which the author's code failed or whose workers
    died."""
    missing: int = 0
    """Number of requested episodes that were not finished."""


def chunk_of(episodes: int, num_envs: int) -> int:
    """Number of episodes in a chunk of a job with `episodes` episodes, for workers with `num_envs` envs."""
    return num_envs * (_CHUNK_BATCHES if episodes >= _LONG_JOB_BATCHES * num_envs else 1)


def record(
    what: RecordOptions,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_progress: Callable[[RecordProgress], None] = lambda progress: None,
    stop: Callable[[], bool] = lambda: False,
    on_finding: Callable[[Finding], None] = warn_of,
    executor: Executor | None = None,
    run: str = "",
    on_notice: Callable[[str], None] = lambda notice: None,
) -> Recorded:
    """Record into ``what.out``.

    For each episode, one env is reset alone, with the seed of the episode. Random actions have a generator
    for each episode (`RecordActionChooser`). So for any number of envs and processes, episode k is the
    episode that ``gym.make(...).reset(seed=seed + k)`` starts.

    Args:
        on_finding: called once for each place where the task breaks a rule but can continue.
        stop: called between steps; once it returns True, finished episodes are kept and the others dropped.
        executor: None to run in this process, or in spawned processes if ``what.workers`` is above 1.
        run: as in `RecordSetup`; a resumed job passes the name that it began with.
        on_notice: called once with each notice about the task.

    Raises:
        TaskError: the task cannot be opened; or it fails in every chunk of episodes; or it fails in the same
            way in several consecutive chunks.
        RecordingError: a file cannot be written.
        PoolError: a process that records failed, or processes die repeatedly.
        FileNotFoundError, ValueError: the request is invalid.
    """
    what, given = with_given_actions(what)
    recording = _Recording(what, on_activity, on_progress, stop, on_finding, on_notice)
    run_items = record_items
    if executor is None:
        executor = ThisProcess() if what.workers == 1 else Processes(what.workers)
    if isinstance(executor, ThisProcess):
        run_items = partial(record_items, given=given)
    do_record([what], sys.maxsize, run, executor, recording.scheduler, run_items)
    recording.scheduler.require_results()
    return recording.so_far(stop())


def collect(what: RecordOptions, known: Mapping[int, Written | None]) -> Recorded:
    """Combine the results of these episodes into one result. Runs nothing.

    Args:
        what: options as completed by `with_given_actions`.
        known: result of each episode by number; None if the episode was not kept.
    """
    recording = _Recording(
        what,
        lambda activity: None,
        lambda progress: None,
        lambda: False,
        lambda finding: None,
        lambda _: None,
    )
    recording.scheduler.go_on(known, lambda number, written: None)
    return recording.so_far(stopped=False)


def do_record(
    wanted: Sequence[RecordOptions],
    stride: int,
    run: str,
    executor: Executor,
    scheduler: Scheduler[Written | None, RecordUpdate],
    run_items: Callable[[RecordSetup, ItemQueue], None] = record_items,
) -> None:
    """Record the items of a scheduler, for one or several recordings. Arguments as in `RecordSetup`; raises as `record`
    does."""
    run = run or uuid.uuid4().hex
    needed = [needed_by(what.task, what.actions, what.options.imports) for what in wanted]
    folders = [what.out.absolute() for what in wanted]
    mark = f".{run}" if executor.is_remote else ""
    work = Work(
        run_items,
        RecordSetup(tuple(wanted), tuple(map(os.fsencode, folders)), stride, run, mark),
        result=Written | None,
        update=RecordUpdate,
        name="that records",
        folders=[folder for one in needed for folder in one.folders],
        files=[file for one in needed for file in one.files],
    )
    marks = [folder / mark for folder, what in zip(folders, wanted, strict=True) if mark and not what.upload]
    for file in marks:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    try:
        executor.run(work, scheduler)
    finally:
        for file in marks:
            file.unlink(missing_ok=True)


class WorkerUpdates:
    """Collects the workers' progress messages, and computes the progress of the job."""

    def __init__(
        self,
        on_activity: Callable[[str], None],
        on_finding: Callable[[Finding], None],
        on_notice: Callable[[str], None],
    ) -> None:
        self._on_activity, self._on_finding, self._on_notice = on_activity, on_finding, on_notice
        self._running: dict[int, int] = {}
        """Control steps so far of each running item."""
        self._steps = self._limit = 0
        self._found: set[object] = set()
        """Findings and notices of all workers, to report each once."""
        self._failures: tuple[Failure, ...] = ()

    def take(self, update: RecordUpdate) -> bool:
        """Handle a message of a worker; returns whether the progress has changed."""
        if update.activity:
            self._on_activity(update.activity)
        if (finding := update.finding) is not None and finding.key not in self._found:
            self._found.add(finding.key)
            self._on_finding(finding)
        if update.notice and update.notice not in self._found:
            self._found.add(update.notice)
            self._on_notice(update.notice)
        if (underway := update.underway) is None:
            return False
        self._steps, self._limit = self._steps + underway.made, underway.limit
        self._running.update(underway.steps)
        return True

    def over(self, number: int) -> None:
        """Handle the end of an item."""
        self._running.pop(number, None)

    def failed(self, failure: Failure) -> None:
        """Handle items without a result."""
        self._failures += (failure,)
        for number in failure.numbers:
            self._running.pop(number, None)

    def progress(
        self,
        kept: int,
        over: tuple[int, Written | None] | None,
        scheduler: Scheduler[Written | None, RecordUpdate],
        counts_parts: bool,
    ) -> RecordProgress:
        """
        Args:
            counts_parts: whether running episodes count as fractions.
        """
        limit = scheduler.limit()
        running = {number: steps for number, steps in self._running.items() if number < limit}
        part = sum(min(steps / max(self._limit, 1), 1.0) for steps in running.values())
        done = kept + (part if counts_parts else 0.0)
        return RecordProgress(
            kept, self._steps, over, running, self._limit, done, self._failures, scheduler.is_going_on
        )


class _Recording:
    """Collects the results of all processes.

    If K successes are wanted, it keeps those with the lowest numbers. With many envs or processes, a later
    episode may succeed before an earlier one has ended. The files of the later episode are removed once K
    successes have lower numbers.
    """

    def __init__(
        self,
        what: RecordOptions,
        on_activity: Callable[[str], None],
        on_progress: Callable[[RecordProgress], None],
        stop: Callable[[], bool],
        on_finding: Callable[[Finding], None],
        on_notice: Callable[[str], None],
    ) -> None:
        self._out, self._folder, self._wanted = what.out, what.out.absolute(), what.successes
        self._upload = what.upload
        self._on_progress = on_progress
        self._updates = WorkerUpdates(on_activity, on_finding, on_notice)
        self._kept: dict[int, Written] = {}
        self._ended = 0
        most = what.episodes if what.successes is None else what.tries
        assert most is not None
        self._most = most
        self.scheduler: Scheduler[Written | None, RecordUpdate] = Scheduler(
            range(most),
            self._over,
            self._on_update,
            stop,
            chunk=chunk_of(most, what.options.num_envs),
            tries=MAX_CHUNK_STARTS,
            on_failure=self._failed,
        )

    def so_far(self, stopped: bool) -> Recorded:
        enough = self._wanted is not None and len(self._kept) == self._wanted
        written = tuple(self._kept[number] for number in sorted(self._kept))
        start_corrected = sum(episode.start_corrected for episode in written)
        tried = written[-1].index + 1 if enough else self._ended
        missing = 0 if enough else self._most - self._ended
        return Recorded(written, tried, stopped, start_corrected, tuple(self.scheduler.failures), missing)

    def _over(self, number: int, written: Written | None) -> None:
        self._ended += 1
        self._updates.over(number)
        if written is not None:
            # Use the folder's path as the person wrote it.
            self._kept[number] = replace(written, path=self._out / written.path.name)
        if self._wanted is not None and len(self._kept) >= self._wanted:
            last = sorted(self._kept)[self._wanted - 1]
            self.scheduler.lower(last + 1)
            for surplus in [number for number in self._kept if number > last]:
                self._remove(self._kept.pop(surplus))
        self._report_progress((number, self._kept.get(number)))

    def _failed(self, failure: Failure) -> None:
        self._ended += len(failure.numbers)
        self._updates.failed(failure)
        self._report_progress()

    def _on_update(self, update: RecordUpdate) -> None:
        if self._updates.take(update):
            self._report_progress()

    def _report_progress(self, over: tuple[int, Written | None] | None = None) -> None:
        kept = len(self._kept)
        self._on_progress(self._updates.progress(kept, over, self.scheduler, self._wanted is None))

    def _remove(self, episode: Written) -> None:
        if self._upload:
            remove_uploaded(self._upload, episode.path.stem)
            return
        for suffix in (".json", ".h5", ".rrd"):  # the .json first: without it there is no episode
            (self._folder / episode.path.name).with_suffix(suffix).unlink(missing_ok=True)

"""Chooses the executor of a command (this process, worker processes or a cluster) and its job file."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.markup import escape

from workbench.cli.arguments import JobArguments
from workbench.cli.output import Exit, err, interrupted, print_problem, refuse, warn
from workbench.jobs.local_processes import Processes
from workbench.jobs.ray_cluster import Cluster
from workbench.jobs.results_file import JobFile, JobKey, Kept
from workbench.jobs.scheduler import Executor, PoolError, Shard, ThisProcess, by_kind, parse_shard
from workbench.library.job_status import JobFailure, JobState, JobStatus, StatusFile
from workbench.machine.text import listed
from workbench.record.job import RecordProgress
from workbench.record.job_worker import Written
from workbench.task.problem import Problem, TaskError

EPISODES_KEPT = "finished episodes were kept"
JOB_ENDS = (TaskError, OSError, ValueError, PoolError, KeyboardInterrupt)
"""Exceptions that end a command early: see `exit_after`."""


def exit_after(error: BaseException, kept: str = EPISODES_KEPT) -> int:
    """Print why a command ended early; returns the exit code.

    Args:
        error: one of `JOB_ENDS`.
        kept: text about the results that were kept, for the message after Ctrl-C.
    """
    if isinstance(error, TaskError):
        print_problem(error.problem)
        return Exit.FAILED
    if isinstance(error, KeyboardInterrupt):
        return interrupted(kept)
    refused = refuse(str(error))
    return Exit.FAILED if isinstance(error, PoolError) else refused


def require_job(arguments: JobArguments) -> None:
    """Raise ValueError for an invalid argument, with a message that names it."""
    if arguments.workers is not None and arguments.workers < 1:
        raise ValueError(f"--workers must be at least 1, not {arguments.workers}")
    for name, number, least in (
        ("cpus-per-worker", arguments.cpus_per_worker, "above 0"),
        ("gpus-per-worker", arguments.gpus_per_worker, "0 or more"),
    ):
        if number < 0 or (number == 0 and least == "above 0"):
            raise ValueError(f"--{name} must be {least}, not {number:g}")
    shard_of(arguments)


def shard_of(arguments: JobArguments) -> Shard:
    """Part of the job to run. Raises ValueError."""
    return Shard() if arguments.shard is None else parse_shard(arguments.shard)


def items_of(arguments: JobArguments, count: int, chunk: int) -> int:
    """Number of items in the part to run, out of `count` items in chunks of size `chunk`."""
    part = shard_of(arguments).part(-(-count // chunk))
    return min(part.stop * chunk, count) - min(part.start * chunk, count)


def job_path(arguments: JobArguments, command: str) -> Path | None:
    """Path of the job file; None if there is none."""
    if arguments.job is not None or arguments.shard is None:
        return arguments.job
    shard = shard_of(arguments)
    return Path(f"{command}-{shard.index}-of-{shard.count}.job")


def is_recorded(folder: Path) -> Callable[[Written | None], bool]:
    """A function that returns False for a result whose episode is missing from the folder. Uploaded episodes
    are not in the folder, so it returns True for them."""
    return lambda one: one is None or bool(one.address) or (folder / f"{one.path.stem}.json").exists()


@contextmanager
def run_by(
    arguments: JobArguments,
    command: str,
    chunks: int,
    job: Callable[[], JobKey],
    is_there: Callable[[Any], bool] = lambda result: True,
) -> Iterator[tuple[Executor, str]]:
    """Yield the executor of a command, and the name of the run (`episodes.RecordSetup.run`).

    Args:
        chunks: number of chunks of the whole job.
        job: returns the key of the job file; called only if there is one.
        is_there: as in `Kept`.

    Raises:
        ValueError, OSError: as `JobFile` does.
    """
    shard, path = shard_of(arguments), job_path(arguments, command)
    mine = len(shard.part(chunks))
    if not mine:
        notice = f"part {shard} has nothing to do: the job has {chunks} batch{'' if chunks == 1 else 'es'}"
        err.print(escape(notice), soft_wrap=True)
    here = min(arguments.workers or len(os.sched_getaffinity(0)), mine)
    executor: Executor = ThisProcess() if here <= 1 else Processes(here, warn)
    if arguments.cluster is not None:
        how = arguments.cluster, arguments.workers, arguments.cpus_per_worker, arguments.gpus_per_worker
        executor = Cluster(*how, warn)
    if path is None:
        yield executor, ""
        return
    file = JobFile(path, job())
    try:
        if file.count:
            err.print(escape(f"resuming after {file.count} results in {path}"), soft_wrap=True)
        yield Kept(executor, file, shard, is_there), file.run
    finally:
        file.close()


class StatusWriter:
    """Writes the progress of a job into its folder of recordings; see `status_in_folder`."""

    def __init__(self, file: StatusFile | None, status: JobStatus, names: Callable[[int], str]) -> None:
        self._file, self._status, self._names = file, status, names
        self._began: float | None = None
        self._first = 0
        """Number of episodes that existed when the job began."""
        self._last: RecordProgress | None = None

    def with_status(self, show: Callable[[RecordProgress], None]) -> Callable[[RecordProgress], None]:
        """Progress callback that writes the status and also calls `show`."""

        def both(now: RecordProgress) -> None:
            show(now)
            if self._began is None or now.was_there:
                self._began, self._first = time.monotonic(), now.kept
            self._last = now
            # Progress arrives with every control step of every worker: limit the writes.
            if self._file is not None and self._file.is_due():
                self._write("running")

        return both

    def end(self, state: JobState) -> None:
        """Write the final status, unless the job failed before it made any progress."""
        if self._file is not None and (self._last is not None or state != "failed"):
            self._write(state)

    def _write(self, state: JobState) -> None:
        assert self._file is not None
        status = replace(self._status, state=state)
        if (now := self._last) is not None and self._began is not None:
            seconds = time.monotonic() - self._began
            rate = (now.done - self._first) / seconds if seconds > 1 else 0.0
            failures = tuple(self._failure(*kind) for kind in by_kind(now.failures))
            status = replace(status, done=now.kept, rate=rate, failures=failures)
        self._file.write(status)

    def _failure(self, problem: Problem, numbers: Sequence[int]) -> JobFailure:
        items = listed([self._names(number) for number in numbers])
        return JobFailure(items, len(numbers), str(TaskError(problem)), problem.traceback)


@contextmanager
def status_in_folder(
    arguments: JobArguments,
    command: str,
    task: str,
    out: Path | None,
    total: int,
    names: Callable[[int], str],
) -> Iterator[StatusWriter]:
    """Write the progress of a job into its folder of recordings, for a page that shows it.

    Args:
        out: folder of the recordings; None to write nothing.
        names: returns the name of an item.
    """
    part = "" if arguments.shard is None else str(shard_of(arguments))
    file = None if out is None else StatusFile(out)
    status = JobStatus(command, task, 0, total, part=part)
    if file is not None:
        file.remove_old(status)
    writer = StatusWriter(file, status, names)
    try:
        yield writer
    except BaseException:
        writer.end("failed")
        raise


def print_part(arguments: JobArguments, command: str, stopped: bool) -> None:
    """Print how to resume a stopped job, or how to merge a finished part."""
    path = job_path(arguments, command)
    if stopped:
        how = (
            "with --job FILE a stopped job can be resumed"
            if path is None
            else "run the same command again to resume"
        )
        err.print(escape(how), soft_wrap=True)
    elif arguments.shard is not None:
        text = f"Part {arguments.shard} is in {path}. Merge all parts with: workbench merge FILE ..."
        err.print(escape(text), soft_wrap=True)

"""Rescores recordings in one or several processes, in fixed chunks of recordings of one task."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import torch

from workbench.actions.choose import needed_by
from workbench.envs.broken_rule import warn_of
from workbench.envs.gpu_rules import Finding
from workbench.episodes.recorded_source import CannotEnterRecording
from workbench.episodes.row import Source
from workbench.jobs.pack_author_files import MAX_BYTES
from workbench.jobs.scheduler import Chunk, Executor, Failure, ItemQueue, Scheduler, Work
from workbench.machine.folders import CurrentFolder
from workbench.rescore.replay_recordings import RescoredBy, opened_code, rescore
from workbench.rescore.verdict import Verdict
from workbench.task.open import OpenedTask
from workbench.task.problem import Problem, TaskError
from workbench.task.reference import RecordedTask, named_file

_MAX_CHUNK_STARTS = 3
"""Maximum number of times that a chunk is started if its workers die."""
_SUFFIXES = (".rrd", ".h5", ".json")
"""Suffixes of the files of one recording."""


@dataclass(frozen=True)
class Recording:
    """A recording to rescore."""

    place: int
    """Index in the order of the files."""
    path: bytes
    """Path as bytes, so that it is not relocated to a worker's folder (see `Work.files`): a recording that is
    not sent to the workers has the same path on all machines."""
    travels: Path | None
    """The path, if the recording is sent to the workers; else None."""
    part: str | None
    id: str
    name: str
    task: str = ""
    note: str = ""
    """Note on options that differ from the recorded ones on purpose."""
    why_not: str = ""
    """Reason why it cannot be rescored, if known before the job."""
    refused: bool = False
    """Whether it is skipped because its code may not run."""
    damaged: bool = False
    """Whether it is skipped because it cannot be read."""

    def source(self) -> Source:
        """Source of the recording on the submitting side."""
        return Source(Path(os.fsdecode(self.path)), self.part, self.id, self.name)

    def verdict(self, why_not: str) -> Verdict[Source]:
        return Verdict(self.source(), task=self.task, why_not=why_not, damaged=self.damaged)


@dataclass(frozen=True)
class RescoredRecording:
    """Result of one recording."""

    place: int
    verdict: Verdict[Source]
    note: str = ""
    failed: bool = False
    """Whether its code could not be opened, may not run, or raised."""
    problem: Problem | None = None
    """Exception that the code raised."""


@dataclass(frozen=True)
class RescoreUpdate:
    """Progress of a worker."""

    activity: str = ""
    steps: int = 0
    """Control steps since the previous message, over all episodes."""
    finding: Finding | None = None


@dataclass(frozen=True)
class RescoreSetup:
    """Recordings of a job, and the codes that rescore them."""

    codes: tuple[RescoredBy | None, ...]
    """Code of each group of recordings; None for a group that is skipped."""
    of_chunk: tuple[int, ...]
    """Index in `codes` for each chunk."""
    items: Mapping[int, Recording]
    """Recordings by number; the numbers of chunk k begin at ``k * chunk``."""
    chunk: int
    use_env_states: bool = False
    is_remote: bool = False
    """Whether workers on other machines read the recordings from a shared folder, because the recordings are
    too large to send."""

    def code_of(self, chunk: Chunk) -> int:
        return self.of_chunk[chunk.numbers[0] // self.chunk]


def setup_of(
    groups: Sequence[tuple[RescoredBy | None, Sequence[Recording]]], chunk: int, use_env_states: bool
) -> RescoreSetup:
    """Number the recordings so that each chunk has recordings of one group only."""
    items: dict[int, Recording] = {}
    of_chunk: list[int] = []
    for at, (_, recordings) in enumerate(groups):
        waiting = iter(recordings)
        while some := list(islice(waiting, chunk)):
            items |= dict(enumerate(some, len(of_chunk) * chunk))
            of_chunk.append(at)
    return RescoreSetup(tuple(code for code, _ in groups), tuple(of_chunk), items, chunk, use_env_states)


def rescore_recordings(
    setup: RescoreSetup,
    executor: Executor,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_progress: Callable[[int, int, int], None] = lambda episodes, total, steps: None,
    on_finding: Callable[[Finding], None] = warn_of,
) -> list[RescoredRecording]:
    """Verdicts of the recordings, in the order of the files.

    Args:
        on_progress: called with three numbers: rescored episodes, all episodes, and control steps so far.
        on_finding: called once for each line at which a rule is broken without stopping the task.

    Raises:
        PoolError: a process that rescores failed, or processes die repeatedly.
        TooMuch: the files in the tasks' folders are too large to send to other machines.
    """
    results: dict[int, RescoredRecording] = {}
    found: set[object] = set()
    steps = 0

    def take(number: int, result: RescoredRecording) -> None:
        results[number] = result
        on_progress(len(results), len(setup.items), steps)

    def failed(failure: Failure) -> None:
        for number in failure.numbers:
            of = setup.items[number]
            verdict = of.verdict(failure.problem.message)
            take(number, RescoredRecording(of.place, verdict, of.note, failed=True, problem=failure.problem))

    def take_update(update: RescoreUpdate) -> None:
        nonlocal steps
        if update.activity:
            on_activity(update.activity)
        if update.finding is not None and update.finding.key not in found:
            found.add(update.finding.key)
            on_finding(update.finding)
        if update.steps:
            steps += update.steps
            on_progress(len(results), len(setup.items), steps)

    scheduler: Scheduler[RescoredRecording, RescoreUpdate] = Scheduler(
        sorted(setup.items), take, take_update, chunk=setup.chunk, tries=_MAX_CHUNK_STARTS, on_failure=failed
    )
    folders, files = _needed(setup)
    if executor.is_remote:
        setup, recordings = _travelling(setup)
        files = [*files, *recordings]
    work = Work(
        rescore_items,
        setup,
        result=RescoredRecording,
        update=RescoreUpdate,
        name="that rescores",
        folders=folders,
        files=files,
    )
    executor.run(work, scheduler)
    return sorted(results.values(), key=lambda result: result.place)


def _needed(setup: RescoreSetup) -> tuple[list[Path], list[Path]]:
    """Folders and files that the codes need."""
    folders: list[Path] = []
    files: list[Path] = []
    for code in filter(None, setup.codes):
        named = code.task if isinstance(code.task, str) else ""
        needed = needed_by(named, imports=code.options.imports)
        folders += needed.folders
        files += needed.files
        file = named_file(code.task) if isinstance(code.task, RecordedTask) else None
        if code.recorded is not None and code.recorded.source_file is not None:
            file = Path(code.recorded.source_file)
        if file is not None and file.is_absolute() and file.is_file():
            folders.append(file.parent)
    return folders, files


def _travelling(setup: RescoreSetup) -> tuple[RescoreSetup, list[Path]]:
    """The setup for other machines, and the files of the recordings to send there: all files, or none if they
    are too large together."""
    files = {
        file
        for of in setup.items.values()
        if not of.why_not
        for suffix in _SUFFIXES
        if (file := of.source().path.with_suffix(suffix)).is_file()
    }
    if sum(file.stat().st_size for file in files) > MAX_BYTES // 2:
        return replace(setup, is_remote=True), []
    items = {number: replace(of, travels=of.source().path.resolve()) for number, of in setup.items.items()}
    return replace(setup, items=items), sorted(files)


# --- one worker --------------------------------------------------------------------------------------------


class _Stopped(Exception):
    """Raised when no more results are needed."""


def rescore_items(setup: RescoreSetup, queue: ItemQueue) -> None:
    """Rescore the chunks of one worker. If the author's code raises, the exception becomes the verdict of
    those recordings of the chunk that have no verdict yet."""
    torch.set_num_threads(1)  # see workbench.app.worker.main_loop.work
    here = CurrentFolder()  # a task may change the working directory
    chunk = queue.next()
    with suppress(_Stopped):
        while chunk is not None:
            at = setup.code_of(chunk)
            code = setup.codes[at]
            if code is not None:
                with here.again():
                    chunk = _Rescorer(setup, at, queue).run(code, chunk)
                continue
            for number in sorted(chunk.wanted):
                of = setup.items[number]
                verdict = of.verdict(of.why_not)
                queue.send_result(number, RescoredRecording(of.place, verdict, of.note, failed=of.refused))
            chunk = queue.next()


@dataclass(frozen=True)
class _Rescorer:
    """Rescores the chunks of one code."""

    setup: RescoreSetup
    at: int
    """Index of the code."""
    queue: ItemQueue

    def run(self, code: RescoredBy, chunk: Chunk | None) -> Chunk | None:
        """Rescore this chunk and the following chunks of the same code. Stops when the code raises, because
        its envs may then be in any state. Returns the next chunk to rescore."""
        try:
            with opened_code(
                code,
                on_activity=lambda activity: self.queue.send_update(RescoreUpdate(activity)),
                on_finding=lambda finding: self.queue.send_update(RescoreUpdate(finding=finding)),
            ) as opened:
                while chunk is not None and self.setup.code_of(chunk) == self.at:
                    if not self._rescore(opened, chunk):
                        return self.queue.next()
                    chunk = self.queue.next()
                return chunk
        except (TaskError, CannotEnterRecording) as error:
            # The code cannot be opened for the following chunks either.
            while chunk is not None and self.setup.code_of(chunk) == self.at:
                self._fail(chunk.wanted, error)
                chunk = self.queue.next()
            return chunk

    def _rescore(self, opened: OpenedTask, chunk: Chunk) -> bool:
        """Rescore the whole chunk, including recordings with a known result, because an episode may differ in the last bits
        in another batch. Returns False if the task raised."""
        sources = [self._source(number) for number in chunk.numbers]
        missing = set(chunk.wanted)
        try:
            for part in rescore(opened, sources, use_env_states=self.setup.use_env_states):
                self.queue.send_update(RescoreUpdate(steps=part.steps))
                for verdict in part.verdicts:
                    number = int(verdict.of.id)
                    if number in missing:
                        missing.remove(number)
                        of = self.setup.items[number]
                        verdict = replace(verdict, of=of.source())
                        self.queue.send_result(number, RescoredRecording(of.place, verdict, of.note))
                if missing and self.queue.limit() <= chunk.numbers[0]:
                    raise _Stopped
        except TaskError as error:
            self._fail(missing, error)
            return False
        return True

    def _source(self, number: int) -> Source:
        """Source of a recording on this machine, with `number` as its id."""
        of = self.setup.items[number]
        path = of.travels or of.source().path
        if self.setup.is_remote and not path.parent.is_dir():
            raise FileNotFoundError(
                f"{platform.node()} does not see the recordings in {path.parent}, which are too large to send: put them "
                "into a folder that all machines of the cluster share"
            )
        return Source(path, of.part, str(number), of.name)

    def _fail(self, numbers: set[int] | frozenset[int], error: TaskError | CannotEnterRecording) -> None:
        problem = error.problem if isinstance(error, TaskError) else None
        for number in sorted(numbers):
            of = self.setup.items[number]
            result = RescoredRecording(of.place, of.verdict(str(error)), of.note, True, problem)
            self.queue.send_result(number, result)

"""Records episodes of a task with each of several values of its constants and constructor arguments."""

from __future__ import annotations

import difflib
import itertools
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from workbench.actions.choose import SOLVE
from workbench.envs.broken_rule import warn_of
from workbench.envs.gpu_rules import Finding
from workbench.episodes.sweep_results import MAX_POINTS, SweepEpisode, SweepResults, value_text
from workbench.jobs.local_processes import Processes
from workbench.jobs.scheduler import Executor, Failure, Scheduler, ThisProcess
from workbench.planning.options import PlanOptions
from workbench.record.job import MAX_CHUNK_STARTS, RecordProgress, WorkerUpdates, chunk_of, do_record
from workbench.record.job_worker import RecordOptions, RecordUpdate, Written, with_given_actions
from workbench.task import registry
from workbench.task.constructor_arguments import class_arguments
from workbench.task.description import TaskOptions
from workbench.task.modules import read_source
from workbench.task.problem import TaskError
from workbench.task.reference import file_and_class, find_module, named_file, split_reference
from workbench.task.settings_in_text import Argument, Constant, SettingError, TaskText

_MIN_CHUNKS = 64
"""A long sweep gets larger chunks, so that there are only about this many of them: each chunk opens the task
once in its worker."""
_STEPS_AFTER_SUCCESS = 5
"""Number of control steps that a planned episode continues after its success, as in `solve.job`."""
_MAX_NAME_CHARACTERS = 80
"""Maximum length of a folder's name."""


@dataclass(frozen=True)
class Setting:
    """Name of a constant or argument, and its values (JSON types)."""

    name: str
    values: tuple[Any, ...]


@dataclass(frozen=True)
class SweepOptions:
    """Options of a sweep."""

    task: str
    """Reference of the task; see `RecordArguments.task`."""
    settings: tuple[Setting, ...]
    out: Path = Path("sweeps")
    seeds: int = 100
    """Number of seeds for each point, from ``options.seed`` on."""
    actions: str = "random"
    """Source of the actions; see `RecordArguments.actions`. A file is not allowed."""
    pictures: bool = False
    max_steps: int | None = None
    """Maximum number of control steps of an episode; see `RecordArguments.max_steps`."""
    plan: PlanOptions = PlanOptions()
    """Options of planned actions."""
    options: TaskOptions = field(default_factory=lambda: TaskOptions(num_envs=4))
    workers: int = 1
    """Number of processes, if no executor is given; the result is the same with any number."""
    upload: str = ""
    """Address that episodes are uploaded to, with a folder for each point; see `RecordArguments.upload`."""

    @property
    def points(self) -> tuple[Point, ...]:
        """All combinations of the values; the last setting varies fastest."""
        values = itertools.product(*(one.values for one in self.settings))
        names = [one.name for one in self.settings]
        count = math.prod(len(one.values) for one in self.settings)
        return tuple(_point(k, dict(zip(names, one, strict=True)), count) for k, one in enumerate(values))

    @property
    def chunk(self) -> int:
        """Number of episodes that a worker runs together. It is the same for any number of workers."""
        envs = self.options.num_envs
        points = math.prod(len(one.values) for one in self.settings)
        enough = -(-self.seeds * points // (_MIN_CHUNKS * envs)) * envs
        return min(max(chunk_of(self.seeds, envs), enough), -(-self.seeds // envs) * envs)

    @property
    def stride(self) -> int:
        """Number of items per point: episode k of point p is item ``p * stride + k`` of the job."""
        return -(-self.seeds // self.chunk) * self.chunk

    @property
    def items(self) -> list[int]:
        return [point.index * self.stride + k for point in self.points for k in range(self.seeds)]


@dataclass(frozen=True)
class Point:
    """One value of each setting."""

    index: int
    values: dict[str, Any]
    folder: str
    """Folder of the point's recordings, relative to the sweep's folder."""

    @property
    def json(self) -> dict[str, str]:
        """The values in JSON."""
        return {name: json.dumps(value) for name, value in self.values.items()}


def _point(index: int, values: dict[str, Any], count: int) -> Point:
    texts = ((name.rpartition(".")[2], value_text(json.dumps(value))) for name, value in values.items())
    named = "_".join(f"{name}={text}" for name, text in texts)
    plain = re.sub(r"[^A-Za-z0-9._=+-]+", "-", named)[:_MAX_NAME_CHARACTERS].strip("-.")
    return Point(index, values, f"{index:0{len(str(count - 1))}d}_{plain}")


@dataclass(frozen=True)
class SweepReport:
    """The result of a sweep."""

    results: SweepResults
    """Results of the episodes, each seed at most once for each point."""
    stopped: bool
    failures: tuple[Failure, ...] = ()
    missing: int = 0
    """Number of requested episodes that neither ended nor failed."""


def recordings_of(what: SweepOptions) -> tuple[RecordOptions, ...]:
    """The options for recording each point, with the modified text of the task's file. Does not run the file.

    Raises:
        SettingError: a name is neither a constant of the file nor an argument of the constructor, or a value
            has the wrong type.
        FileNotFoundError, ValueError: the request is invalid for another reason.
        OSError: the file cannot be read.
    """
    if what.seeds < 1:
        raise ValueError(f"--seeds must be at least 1, not {what.seeds}")
    if (count := math.prod(len(one.values) for one in what.settings)) > MAX_POINTS:
        raise ValueError(f"--set gives {count} combinations, and a sweep has at most {MAX_POINTS}")
    file, text, arguments = None, None, None
    if (file := _own_file(what.task)) is not None:
        try:
            text = TaskText(file, read_source(file), _class_name(what.task))
        except SyntaxError as error:
            raise SettingError(f"{file} cannot be read as text: {error}") from error
    elif (spec := registry.environment(what.task)) is not None:
        arguments = class_arguments(spec.cls)
    found = {one.name: _found(text, arguments, what.task, one.name) for one in what.settings}
    for one in what.settings:
        place = found[one.name]
        if isinstance(place, Argument) and place.name in what.options.env_kwargs:
            raise SettingError(f"--env and --set both give {place.name}: leave one of them out")
    made = []
    for point in what.points:
        constants = [(one, point.values[name]) for name, one in found.items() if isinstance(one, Constant)]
        given = {one.name: point.values[name] for name, one in found.items() if isinstance(one, Argument)}
        # Store the current text even without a constant, since the file may be edited while the sweep runs.
        source = {} if text is None else {str(file): text.replaced(constants)}
        options = replace(what.options, env_kwargs={**what.options.env_kwargs, **given})
        planned = what.actions == SOLVE
        recording = RecordOptions(
            what.task,
            what.out / point.folder,
            what.seeds,
            actions=what.actions,
            pictures=what.pictures,
            max_steps=what.max_steps,
            options=options,
            plan=what.plan,
            after_success=_STEPS_AFTER_SUCCESS if planned else 0,
            source=source,
            upload=f"{what.upload.rstrip('/')}/{point.folder}" if what.upload else "",
        )
        recording, runs = with_given_actions(recording)
        if runs:
            raise ValueError(f"--actions {what.actions}: a sweep does not take a file of actions")
        made.append(recording)
    return tuple(made)


def _own_file(task: str) -> Path | None:
    """The task's file; None if it is not the author's own."""
    if registry.environment(task) is not None:
        return None
    if (named := split_reference(task)) is not None:
        module = find_module(named[0])
        return None if module is None or module.own_folder is None else module.file
    return named_file(task)


def _class_name(task: str) -> str | None:
    named = split_reference(task)
    return named[1] if named is not None else file_and_class(task)[1]


def _found(
    text: TaskText | None, arguments: Sequence[str] | None, task: str, name: str
) -> Constant | Argument:
    if text is not None:
        return text.find(name)
    if arguments is None or name in arguments:
        # An id that a module of --import registers: its arguments are known only after running the module.
        return Argument(name)
    close = difflib.get_close_matches(name, arguments, n=3)
    hint = f"did you mean {' or '.join(close)}?" if close else f"it has {', '.join(arguments)}."
    raise SettingError(
        f"{task} has no constructor argument {name}; {hint} Its constants can be set in a copy of its file: "
        f"workbench new NAME --from {task}"
    )


def sweep(
    what: SweepOptions,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_progress: Callable[[RecordProgress], None] = lambda progress: None,
    stop: Callable[[], bool] = lambda: False,
    on_finding: Callable[[Finding], None] = warn_of,
    executor: Executor | None = None,
    run: str = "",
    on_notice: Callable[[str], None] = lambda notice: None,
) -> SweepReport:
    """Record every point of a sweep. The rows of a point that fails hold the failure.

    The arguments after `what` are as in `record`.

    Raises:
        SettingError: as `recordings_of` does.
        TaskError: every point fails.
        RecordingError, PoolError, FileNotFoundError, ValueError: as `record` does.
    """
    recordings = recordings_of(what)
    if executor is None:
        executor = ThisProcess() if what.workers == 1 else Processes(what.workers)
    collected = _Sweep(what, on_activity, on_progress, stop, on_finding, on_notice)
    do_record(recordings, what.stride, run, executor, collected.scheduler)
    collected.scheduler.require_results()
    return collected.report(stop())


def collect_sweep(what: SweepOptions, known: Mapping[int, Written | None]) -> SweepReport:
    """Combine the results of these episodes into the report of a sweep. Runs nothing."""
    collected = _Sweep(what, lambda _: None, lambda _: None, lambda: False, lambda _: None, lambda _: None)
    collected.scheduler.go_on(known, lambda number, written: None)
    return collected.report(stopped=False)


class _Sweep:
    """Collects the results of all processes."""

    def __init__(
        self,
        what: SweepOptions,
        on_activity: Callable[[str], None],
        on_progress: Callable[[RecordProgress], None],
        stop: Callable[[], bool],
        on_finding: Callable[[Finding], None],
        on_notice: Callable[[str], None],
    ) -> None:
        self._what, self._points, self._stride = what, what.points, what.stride
        self._on_progress = on_progress
        self._updates = WorkerUpdates(on_activity, on_finding, on_notice)
        self._rows: dict[int, SweepEpisode] = {}
        self._kept = 0
        """Number of rows without a failure."""
        self.scheduler: Scheduler[Written | None, RecordUpdate] = Scheduler(
            what.items,
            self._over,
            self._on_update,
            stop,
            chunk=what.chunk,
            tries=MAX_CHUNK_STARTS,
            on_failure=self._failed,
            group=what.stride if len(self._points) > 1 else None,
        )

    def report(self, stopped: bool) -> SweepReport:
        what, rows = self._what, tuple(self._rows[number] for number in sorted(self._rows))
        points = tuple(point.json for point in self._points)
        results = SweepResults(what.task, what.actions, what.seeds, points, rows)
        missing = len(points) * what.seeds - len(rows)
        return SweepReport(results, stopped, tuple(self.scheduler.failures), missing)

    def _row(self, number: int, written: Written | None, failure: str = "") -> SweepEpisode:
        point, episode = divmod(number, self._stride)
        seed = self._what.options.seed + episode
        if written is None:
            return SweepEpisode(point, seed, failure=failure)
        judged = written.success is not None
        return SweepEpisode(
            point,
            seed,
            written.solved_at is not None if judged else None,
            written.success,
            written.solved_at,
            written.steps,
            written.total_reward,
            written.means,
            f"{self._points[point].folder}/{written.path.name}",
        )

    def _over(self, number: int, written: Written | None) -> None:
        self._updates.over(number)
        self._rows[number] = self._row(number, written)
        self._kept += 1
        self._report_progress((number, written))

    def _failed(self, failure: Failure) -> None:
        self._updates.failed(failure)
        for number in failure.numbers:
            self._rows[number] = self._row(number, None, str(TaskError(failure.problem)))
        self._report_progress()

    def _on_update(self, update: RecordUpdate) -> None:
        if self._updates.take(update):
            self._report_progress()

    def _report_progress(self, over: tuple[int, Written | None] | None = None) -> None:
        self._on_progress(self._updates.progress(self._kept, over, self.scheduler, counts_parts=True))

"""Runs ``workbench rescore``: progress bar, then a table of results."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.padding import Padding
from rich.progress import MofNCompleteColumn, TimeElapsedColumn
from rich.table import Table

from workbench.cli.arguments import ONE_WORKER, JobArguments
from workbench.cli.output import (
    Exit,
    TerminalPrompt,
    can_ask,
    not_trusted_lines,
    out,
    print_finding,
    progress_bar,
    refuse,
    stdout_to_stderr,
    warn,
)
from workbench.cli.run_by import JOB_ENDS, exit_after, print_part, run_by
from workbench.envs.backends import unused_gpu_text
from workbench.envs.broken_rule import warn_of
from workbench.envs.gpu_rules import Finding
from workbench.episodes.reader.reading import find_all_sources
from workbench.episodes.recorded_source import CannotEnterRecording, recorded_version
from workbench.episodes.row import Source, UnreadableRecording
from workbench.jobs.results_file import JobKey, job_of
from workbench.machine.files import replace_file
from workbench.machine.folders import CurrentFolder
from workbench.machine.text import plain_text
from workbench.record.job import chunk_of
from workbench.rescore import verdict_text
from workbench.rescore.job import Recording, RescoredRecording, RescoreSetup, rescore_recordings, setup_of
from workbench.rescore.recording_jobs import RescoreGroup, group_episodes, hidden_modules_text, with_renderer
from workbench.rescore.replay_recordings import RescoredBy
from workbench.rescore.verdict import Verdict
from workbench.task.content import read_content
from workbench.task.description import TaskOptions
from workbench.task.problem import TaskError
from workbench.task.reference import RecordedTask, TaskName, named_file
from workbench.trust.clearance import Clearances, NotCleared, NotTrusted

_MAX_LISTED = 30
"""If there are more recordings than this, the table omits the unchanged ones."""


@dataclass(frozen=True)
class RescoreOptions:
    places: tuple[Path, ...]
    """Files and folders."""
    task: str | None = None
    """Reference of the task for all recordings, instead of the task that each recording names."""
    recorded_source: bool = False
    use_env_states: bool = False
    num_envs: int = 16
    base: TaskOptions = field(default_factory=TaskOptions)
    """Options that are the same for all recordings, such as the backend."""


@dataclass(frozen=True)
class RescoreOutput:
    """Files that the command writes, and what it prints: text, CSV or JSON."""

    csv: bool = False
    """Print CSV instead of text."""
    csv_file: Path | None = None
    json: bool = False
    """Print JSON instead of text."""
    json_file: Path | None = None


@dataclass(frozen=True)
class RescoreRequest:
    """Key of a rescoring: everything that its verdicts depend on."""

    recordings: int
    """Number of recordings."""
    recorded: str
    """Hash of the names and sizes of the recordings."""
    code: str
    """Hash of the source code that rescores them."""
    use_env_states: bool
    recorded_source: bool
    num_envs: int
    options: TaskOptions


def rescore_all(
    what: RescoreOptions,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_progress: Callable[[int, int, int], None] = lambda episodes, total, steps: None,
    on_finding: Callable[[Finding], None] = warn_of,
    clearances: Clearances | None = None,
    on_notice: Callable[[str], None] = lambda notice: None,
    run: JobArguments = ONE_WORKER,
) -> tuple[list[Verdict[Source]], tuple[str, ...]]:
    """Rescore; returns the verdicts in the order of the files, and notes about intended differences from the recording.

    Args:
        on_progress: called with the number of rescored episodes, the number of all episodes, and the number
            of control steps so far.
        clearances: decides whether the code named in recordings may run; None refuses all code for which the
            user would have to be asked.
        on_notice: called before the tasks are opened, with a sentence for each module next to a task's file
            that cannot be imported because a library has the same name.
        run: where the work runs; the verdicts do not depend on it.

    Raises:
        NotTrusted: a recording names code that is not trusted, and asking is impossible or every answer was no.
        FileNotFoundError, UnreadableRecording: there is nothing to rescore.
        TaskError: no task could be opened and run without an exception. If only some tasks fail, their
            verdicts contain the errors.
        CannotEnterRecording: like TaskError, for recorded source code that cannot be opened.
        PoolError: as `rescore_recordings` does.
        OSError, ValueError: as `run_by` does.
    """
    files = [s for s in find_all_sources([place.absolute() for place in what.places]) if s.kind != "lerobot"]
    if not files:
        raise UnreadableRecording(
            f"A LeRobot dataset cannot be rescored: {', '.join(map(str, what.places))}."
        )
    groups, verdicts = group_episodes(
        files, what.num_envs, what.base, task=what.task, recorded_source=what.recorded_source
    )
    cleared = _cleared(groups, clearances or Clearances())
    notices = [hidden_modules_text(one) for one in cleared if not isinstance(one, NotCleared)]
    for notice in dict.fromkeys(notice for some in notices for notice in some):
        on_notice(notice)
    setup = _setup_of(what, files, groups, cleared, verdicts)

    def job() -> JobKey:
        request = _request_of(what, files, groups, cleared)
        return job_of("rescore", what.task or "as recorded", request, ())

    with run_by(run, "rescore", len(setup.of_chunk), job) as (executor, _):
        results = rescore_recordings(setup, executor, on_activity, on_progress, on_finding)
    place = {file.id: number for number, file in enumerate(files)}
    _require_success(groups, place, results)
    # The path in a worker's verdict may be another machine's: replace it with the local file.
    found = [replace(result.verdict, of=files[result.place]) for result in results]
    return found, tuple(dict.fromkeys(group.note for group in groups if group.note))


def _setup_of(
    what: RescoreOptions,
    files: Sequence[Source],
    groups: Sequence[RescoreGroup],
    cleared: Sequence[TaskName | NotCleared],
    unreadable: Sequence[Verdict[Source]],
) -> RescoreSetup:
    place = {file.id: number for number, file in enumerate(files)}

    def recording(
        file: Source,
        task: str,
        note: str = "",
        why_not: str = "",
        refused: bool = False,
        damaged: bool = False,
    ) -> Recording:
        where = os.fsencode(file.path), None, file.part, file.id, file.name
        return Recording(place[file.id], *where, task, note, why_not, refused, damaged)

    found: list[tuple[RescoredBy | None, list[Recording]]] = []
    for group, task in zip(groups, cleared, strict=True):
        why_not, code = "", None
        if isinstance(task, NotCleared):
            why_not = str(task)
        else:
            info = group.info if group.recorded_source else None
            code = RescoredBy(task, group.options, with_renderer(group.options), info)
        of = [recording(file, group.info.task, group.note, why_not, code is None) for file in group.files]
        found.append((code, of))
    if unreadable:
        of = [recording(one.of, one.task, why_not=one.why_not, damaged=one.damaged) for one in unreadable]
        found.append((None, of))
    return setup_of(found, chunk_of(len(files), what.num_envs), what.use_env_states)


def _request_of(
    what: RescoreOptions,
    files: Sequence[Source],
    groups: Sequence[RescoreGroup],
    cleared: Sequence[TaskName | NotCleared],
) -> RescoreRequest:
    recorded = [(file.name, file.path.stat().st_size) for file in files]
    code: list[str] = []
    for group, task in zip(groups, cleared, strict=True):
        file = None if isinstance(task, NotCleared) else named_file(task)
        if group.recorded_source:
            code.append(recorded_version(group.info))
        elif isinstance(task, RecordedTask) and task.approved is not None:
            code += sorted(task.approved.values())
        else:
            # Hash the text instead of the path: the folder may differ between machines.
            code.append(str(task) if file is None or not file.is_file() else read_content(file).hash)
    return RescoreRequest(
        len(files),
        _sum(recorded),
        _sum(code),
        what.use_env_states,
        what.recorded_source,
        what.num_envs,
        what.base,
    )


def _sum(value: Any) -> str:
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()[:12]


def _require_success(
    groups: Sequence[RescoreGroup], place: Mapping[str, int], results: Sequence[RescoredRecording]
) -> None:
    """Raise the error of the first group if all groups failed. One missing task must not hide the results of
    the other tasks."""
    by_place = {result.place: result for result in results}
    first: RescoredRecording | None = None
    for group in groups:
        of_group = [by_place[place[file.id]] for file in group.files if place[file.id] in by_place]
        failed = [result for result in of_group if result.failed]
        if not failed or any(not result.verdict.why_not for result in of_group):
            return
        first = first or failed[0]
    if first is not None and first.problem is not None:
        raise TaskError(first.problem)
    if first is not None:
        raise CannotEnterRecording(first.verdict.why_not)


def _cleared(groups: list[RescoreGroup], clearances: Clearances) -> list[TaskName | NotCleared]:
    """Decide which task to open for each group, before any task runs. Raises NotTrusted if no task may run,
    or if the user would have to be asked and cannot be."""
    cleared = clearances.clear_all([group.code for group in groups])
    not_cleared = [one for one in cleared if isinstance(one, NotCleared)]
    refused = [one.question for one in not_cleared if one.question is not None]
    reasons = [str(one) for one in not_cleared if one.trust_helps]
    all_of_them = len(refused) + len(reasons) == len(groups) > 0
    if all_of_them or (refused and not clearances.asks):
        raise NotTrusted(list(dict.fromkeys(refused)), list(dict.fromkeys(reasons)))
    return cleared


def rescore_in_terminal(what: RescoreOptions, output: RescoreOutput, trust: bool, run: JobArguments) -> int:
    """Rescore, print, and write the requested tables; returns the exit code."""
    try:
        return _rescore(what, output, trust, run)
    except NotTrusted as error:
        for line in not_trusted_lines(error):
            refuse(line)
        return Exit.NOT_TRUSTED
    except JOB_ENDS as error:
        if isinstance(error, KeyboardInterrupt):
            print_part(run, "rescore", stopped=True)
        return exit_after(error, kept="")


def _rescore(what: RescoreOptions, output: RescoreOutput, trust: bool, run: JobArguments) -> int:
    """Rescore and print; returns the exit code. Raises the errors of `rescore_all`, and OSError for a table."""
    here = CurrentFolder()  # a task may change the current folder
    if (left_alone := unused_gpu_text(what.base.backend)) is not None:
        warn(left_alone)
    asks = can_ask()  # before the bar takes the terminal
    for_programs = output.csv or output.json
    quiet = stdout_to_stderr() if for_programs else nullcontext()
    with quiet, progress_bar(MofNCompleteColumn(), TimeElapsedColumn()) as bar:
        row = bar.add_task("reading the recordings", total=None)

        def report(episodes: int, total: int, steps: int) -> None:
            bar.update(row, total=total, completed=episodes, description=f"rescoring, {steps} steps")

        @contextmanager
        def without_bar() -> Iterator[None]:
            bar.stop()
            yield
            bar.start()

        ask = TerminalPrompt(out, without_bar).ask if asks else None
        verdicts, notes = rescore_all(
            what,
            lambda activity: bar.update(row, description=activity),
            report,
            print_finding,
            Clearances(ask=ask, all_trusted=trust),
            warn,
            run,
        )
        bar.update(row, total=len(verdicts), completed=len(verdicts), description="rescored")
    with here.again():
        write_tables(verdicts, output)
    if for_programs:
        print((verdict_text.as_csv if output.csv else verdict_text.as_json)(verdicts), end="", flush=True)
    else:
        print_verdicts(verdicts, out)
        print_part(run, "rescore", stopped=False)
    warn_of_verdicts(verdicts, notes)
    return code_of(verdicts)


def code_of(verdicts: Iterable[Verdict[Source]]) -> Exit:
    """The exit code of a rescoring."""
    return Exit.FAILED if any(verdict.damaged for verdict in verdicts) else Exit.DONE


def write_tables(verdicts: list[Verdict[Source]], output: RescoreOutput) -> None:
    """Write the requested files. Raises OSError."""
    for path, text in ((output.csv_file, verdict_text.as_csv), (output.json_file, verdict_text.as_json)):
        if path is not None:
            # A file name may contain bytes that are not UTF-8.
            replace_file(path, text(verdicts).encode(errors="backslashreplace"))


def warn_of_verdicts(verdicts: list[Verdict[Source]], notes: Iterable[str]) -> None:
    """Warn of limits of the comparison that the table does not show."""
    for note in (*notes, *verdict_text.not_carried(verdicts)):
        warn(note)
    if verdict_text.count_drifted(verdicts):
        warn(verdict_text.drift_summary(verdicts, verdict_text.PUT_IN))


def print_verdicts(verdicts: list[Verdict[Source]], out: Console) -> None:
    """Print the table and a summary.

    Names of recordings take 55 characters. In a narrow terminal (80 columns), each name has its own unbroken line, so that
    it can be copied.
    """
    table = Table(box=None, pad_edge=False)
    for name in ("episode", "seed", "steps", "return", "what changed", "drift"):
        table.add_column(name, justify="right" if name in ("seed", "steps") else "left", overflow="fold")
    shown = verdicts
    if len(verdicts) > _MAX_LISTED:
        shown = [one for one in verdicts if one.differs or one.others or one.drifted or one.why_not]
    for verdict in shown:
        table.add_row(*map(escape, _cells(verdict)), style=_style(verdict))
    if Measurement.get(out, out.options.update(max_width=10**6), table).maximum <= out.width:
        out.print(table)
    else:
        for verdict in shown:
            _print_lines(verdict, out)
    if alike := len(verdicts) - len(shown):
        out.print(f"{alike} unchanged episodes are not listed; --csv-file lists all", soft_wrap=True)
    out.print(escape(verdict_text.summary(verdicts)), soft_wrap=True)


def _cells(verdict: Verdict[Source]) -> list[str]:
    rescored = not verdict.why_not
    cells = [
        verdict.of.name,
        str(verdict.seed) if verdict.seed >= 0 else "",
        str(verdict.length) if rescored else "",
        verdict_text.returns_text(verdict) if rescored else "",
        verdict_text.change_text(verdict),
        verdict_text.drift_text(verdict) if rescored else "",
    ]
    return [plain_text(cell) for cell in cells]


def _print_lines(verdict: Verdict[Source], out: Console) -> None:
    name, seed, steps, total, changed, drift = _cells(verdict)
    out.print(escape(name), style=_style(verdict), soft_wrap=True)
    named = (("seed", seed), ("steps", steps), ("return", total), ("drift", drift))
    facts = ", ".join(f"{what} {value}" for what, value in named if value)
    for line in (changed, facts):
        if line:
            out.print(Padding(escape(line), (0, 0, 0, 4)), style=_style(verdict))


def _style(verdict: Verdict[Source]) -> str:
    return "yellow" if verdict.why_not else "bold" if verdict.differs else "dim"

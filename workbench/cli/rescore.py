"""Runs ``workbench rescore``: a progress bar, then a table of results."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.padding import Padding
from rich.progress import MofNCompleteColumn, TimeElapsedColumn
from rich.table import Table

from workbench.authoring.loading.reference import TaskName
from workbench.authoring.problem import TaskError
from workbench.cli.terminal import (
    Exit,
    TerminalPrompt,
    can_ask,
    out,
    print_finding,
    progress_bar,
    stdout_to_stderr,
    warn,
)
from workbench.core.backends import unused_gpu_text
from workbench.core.broken_rule import warn_of
from workbench.core.rules import Finding
from workbench.jobs.open_task import open_task
from workbench.jobs.rescore.run import rescore
from workbench.jobs.rescore.verdict import Verdict
from workbench.jobs.task import TaskOptions
from workbench.machine.files import replace_file
from workbench.machine.folders import CurrentFolder
from workbench.machine.text import plain_text
from workbench.recording.episode.row import Source, UnreadableRecording
from workbench.recording.reader.reading import find_all_sources
from workbench.session.clearance import Clearances, NotCleared, NotTrusted
from workbench.session.rescore import verdict_text
from workbench.session.rescore.recordings import (
    Group,
    group_episodes,
    hidden_modules_text,
    rescore_each,
    with_renderer,
)


@dataclass(frozen=True)
class RescoreOptions:
    places: tuple[Path, ...]
    """Files and folders."""
    task: str | None = None
    """The task for all of them, instead of the one that each names."""
    recorded_source: bool = False
    use_env_states: bool = False
    num_envs: int = 16
    base: TaskOptions = field(default_factory=TaskOptions)
    """The backend and other options that are the same for all."""


@dataclass(frozen=True)
class RescoreOutput:
    """What is given besides the table as text."""

    csv: bool = False
    """Print it as CSV instead."""
    csv_file: Path | None = None
    json: bool = False
    """Print it as JSON instead."""
    json_file: Path | None = None


def rescore_all(
    what: RescoreOptions,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_progress: Callable[[int, int, int], None] = lambda episodes, total, steps: None,
    on_finding: Callable[[Finding], None] = warn_of,
    clearances: Clearances | None = None,
    on_notice: Callable[[str], None] = lambda notice: None,
) -> tuple[list[Verdict[Source]], tuple[str, ...]]:
    """The verdicts in the order of the files, and notes about intended differences from the recording.

    Args:
        on_progress: gets the rescored episodes, all episodes, and the control steps so far.
        clearances: decides which code that recordings name may run; None asks no one.
        on_notice: gets a sentence for each file in a task's folder that no import finds, before the task is opened.

    Raises:
        NotTrusted: a recording names code that is not trusted and no one can be asked, or the answer to all was no.
        FileNotFoundError, UnreadableRecording: there is nothing to rescore.
        TaskError: no task can be opened, or each raises; if some can, the verdicts of the others carry the error.
        CannotEnterRecording: as TaskError, for a recorded text that cannot be opened.
    """
    torch.set_num_threads(1)  # see workbench.session.worker.loop.work
    here = CurrentFolder()
    files = [s for s in find_all_sources([place.absolute() for place in what.places]) if s.kind != "lerobot"]
    if not files:
        raise UnreadableRecording(
            f"A LeRobot dataset cannot be rescored: {', '.join(map(str, what.places))}."
        )
    groups, verdicts = group_episodes(
        files, what.num_envs, what.base, task=what.task, recorded_source=what.recorded_source
    )
    cleared = _cleared(groups, clearances or Clearances())
    steps = 0
    printed: set[object] = set()

    def report_once(finding: Finding) -> None:
        if finding.key not in printed:  # a task that is opened several times breaks the rule each time
            printed.add(finding.key)
            on_finding(finding)

    def rescore_group(group: Group, reference: TaskName) -> None:
        nonlocal steps
        for notice in hidden_modules_text(reference):
            if notice not in printed:
                printed.add(notice)
                on_notice(notice)
        begin = partial(open_task, reference, on_activity=on_activity, on_finding=report_once)
        with here.again(stay=True):  # the task before may have changed the current folder
            try:
                opened = begin(group.options)
            except TaskError:
                opened = begin(with_renderer(group.options))
        before = steps

        def report(now: int) -> None:
            nonlocal steps
            steps = before + now
            on_progress(len(verdicts), len(files), steps)

        try:
            for verdict in rescore(opened, group.files, use_env_states=what.use_env_states, on_steps=report):
                verdicts.append(verdict)
                on_progress(len(verdicts), len(files), steps)
        finally:
            opened.env.close()

    rescore_each(groups, cleared, rescore_group, lambda: verdicts, verdicts.extend)
    place = {file.id: number for number, file in enumerate(files)}
    verdicts.sort(key=lambda verdict: place[verdict.of.id])
    return verdicts, tuple(dict.fromkeys(group.note for group in groups if group.note))


def _cleared(groups: list[Group], clearances: Clearances) -> list[TaskName | NotCleared]:
    """The task to open for each group, decided before any of them runs: all or nothing if no one can be asked."""
    cleared = clearances.clear_all([group.code for group in groups])
    not_cleared = [one for one in cleared if isinstance(one, NotCleared)]
    refused = [one.question for one in not_cleared if one.question is not None]
    reasons = [str(one) for one in not_cleared if one.trust_helps]
    all_of_them = len(refused) + len(reasons) == len(groups) > 0
    if all_of_them or (refused and not clearances.asks):
        raise NotTrusted(list(dict.fromkeys(refused)), list(dict.fromkeys(reasons)))
    return cleared


def run_rescore(what: RescoreOptions, output: RescoreOutput, trust: bool) -> int:
    """Rescore, print, and write the requested tables; raises as `rescore_all`, and OSError for a table."""
    here = CurrentFolder()  # a task may change it
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
        )
        bar.update(row, total=len(verdicts), completed=len(verdicts), description="rescored")
    for path, text in ((output.csv_file, verdict_text.as_csv), (output.json_file, verdict_text.as_json)):
        if path is not None:
            with here.again():
                replace_file(path, text(verdicts).encode())
    if for_programs:
        print((verdict_text.as_csv if output.csv else verdict_text.as_json)(verdicts), end="", flush=True)
    else:
        print_verdicts(verdicts, out)
    for note in (*notes, *verdict_text.not_carried(verdicts)):
        warn(note)
    if verdict_text.count_drifted(verdicts):
        warn(verdict_text.drift_summary(verdicts, verdict_text.PUT_IN))
    return Exit.DONE


def print_verdicts(verdicts: list[Verdict[Source]], out: Console) -> None:
    """Print the table and a summary.

    Names of recordings take 55 characters. If the rest does not fit, as in 80 columns, each name has its own line, unbroken
    so that it can be copied.
    """
    table = Table(box=None, pad_edge=False)
    for name in ("episode", "seed", "steps", "return", "what changed", "drift"):
        table.add_column(name, justify="right" if name in ("seed", "steps") else "left", overflow="fold")
    for verdict in verdicts:
        table.add_row(*map(escape, _cells(verdict)), style=_style(verdict))
    if Measurement.get(out, out.options.update(max_width=10**6), table).maximum <= out.width:
        out.print(table)
    else:
        for verdict in verdicts:
            _print_lines(verdict, out)
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

"""Runs ``workbench sweep``: progress bar, table of the points, and result files."""

from __future__ import annotations

import csv
import io
import json
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.progress import MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from workbench.actions.choose import needed_by
from workbench.cli.arguments import ONE_WORKER, JobArguments
from workbench.cli.check_reports import json_text
from workbench.cli.output import (
    Exit,
    interrupted,
    out,
    print_failures,
    print_finding,
    print_text,
    progress_bar,
    refuse,
    warn,
)
from workbench.cli.record import RecordBar
from workbench.cli.run_by import (
    EPISODES_KEPT,
    JOB_ENDS,
    exit_after,
    job_path,
    print_part,
    run_by,
    shard_of,
    status_in_folder,
)
from workbench.envs.step_result import TERM_PREFIX
from workbench.episodes.reader.reading import recover_confined
from workbench.episodes.sweep_results import RESULTS, PointSummary, SweepResults, value_text, write_results
from workbench.episodes.writing.publish import try_folder
from workbench.episodes.writing.upload import require_place, upload_file
from workbench.jobs.results_file import JobKey, job_of
from workbench.machine.files import replace_file
from workbench.machine.folders import CurrentFolder
from workbench.machine.text import number_text
from workbench.record.job_worker import Written
from workbench.sweep.job import Point, Setting, SweepOptions, SweepReport, recordings_of, sweep

_MAX_POINTS = 50
"""Maximum number of points that are printed."""


@dataclass(frozen=True)
class SweepOutput:
    """Output in addition to the text and ``results.parquet``."""

    json_file: Path | None = None
    csv_file: Path | None = None


def parse_settings(given: Sequence[str]) -> tuple[Setting, ...]:
    """Parse the ``--set`` values of a command line. Raises ValueError with a message that names the argument."""
    if not given:
        raise ValueError("sweep needs a name and its values, as in --set reach_weight=0.5,1,2; repeatable")
    settings: list[Setting] = []
    for text in given:
        name, equals, values = text.partition("=")
        if not equals or not all(part.isidentifier() for part in name.split(".")):
            raise ValueError(f"--set takes name=value,value as in --set reach_weight=0.5,1,2; got {text!r}")
        if any(one.name == name for one in settings):
            raise ValueError(f"--set names {name} twice: give all its values at once, as in --set {name}=1,2")
        read = _values(values)
        texts = [json.dumps(value, sort_keys=True) for value in read]
        if len({float(one) if _is_number(one) else one for one in texts}) < len(texts):
            raise ValueError(f"--set {text}: a value is given twice")
        settings.append(Setting(name, tuple(read)))
    return tuple(settings)


def _values(text: str) -> list[Any]:
    """Parse comma-separated values: each as JSON if it is valid JSON, else as text."""
    try:
        # As one JSON list, since nested lists and quoted texts contain commas.
        values = json.loads(f"[{text}]", parse_constant=_no_constant)
    except (ValueError, RecursionError):
        values = [_value(one.strip()) for one in text.split(",")]
    if not values or "" in values:
        raise ValueError(f"--set takes a value before and after each comma; got {text!r}")
    return values


def _value(text: str) -> Any:
    try:
        return json.loads(text, parse_constant=_no_constant)
    except (ValueError, RecursionError):
        return text


def _no_constant(name: str) -> Any:
    raise ValueError(name)


def _is_number(text: str) -> bool:
    return text[:1] in "-0123456789"


def sweep_in_terminal(what: SweepOptions, output: SweepOutput, run: JobArguments = ONE_WORKER) -> int:
    """Sweep, print, and write the results; returns the exit code. Ctrl-C keeps and reports the finished
    episodes."""
    here = CurrentFolder()  # a task may change the current folder
    points = what.points

    def named(number: int) -> str:
        return _named(what, points, number)

    try:
        job = job_path(run, "sweep")
        if (what.out / RESULTS).exists() and not (job is not None and job.exists()):
            raise ValueError(
                f"{what.out} holds the results of another sweep: name another folder with --out, or remove "
                "this one"
            )
        recordings_of(what)
        try_folder(what.out)
        if what.upload:
            require_place(what.upload)
        else:
            for point in points:
                recover_confined(what.out / point.folder)
        shard = shard_of(run)
        chunks = sorted({number // what.chunk for number in what.items})
        part = shard.part(len(chunks))
        mine = set(chunks[part.start : part.stop])
        total = sum(number // what.chunk in mine for number in what.items)
        left = (TextColumn("left"), TimeRemainingColumn())
        with (
            run_by(run, "sweep", len(chunks), lambda: job_of_sweep(what), _is_recorded(what.out)) as (
                executor,
                name,
            ),
            progress_bar(MofNCompleteColumn(), TimeElapsedColumn(), *left) as bar,
            status_in_folder(run, "sweep", what.task, what.out, total, named) as status,
        ):
            with RecordBar(bar, total, "sweeping", named=named) as shown:
                report = sweep(
                    what,
                    shown.describe,
                    status.with_status(shown.show),
                    lambda: shown.stop_requested,
                    print_finding,
                    executor,
                    name,
                    warn,
                )
            shown.describe("swept", len(report.results.episodes))
            status.end("stopped" if report.stopped else "done")
    except JOB_ENDS as error:
        return exit_after(error)
    try:
        with here.again():
            # A part keeps its results in its job file: parts would overwrite each other's table.
            if run.shard is None:
                keep_results(what, report.results)
            write_reports(report.results, output)
    except OSError as error:
        return refuse(str(error))
    code = print_report(report, what, has_table=run.shard is None)
    print_part(run, "sweep", report.stopped)
    return interrupted(EPISODES_KEPT) if report.stopped else code


def _is_recorded(out: Path) -> Callable[[Written | None], bool]:
    """A function that returns False for a result whose episode is missing from the folder of its point.
    Uploaded episodes are not in the folder, so it returns True for them."""
    return lambda one: (
        one is None or bool(one.address) or (out / one.path.parent.name / f"{one.path.stem}.json").exists()
    )


def _named(what: SweepOptions, points: Sequence[Point], number: int) -> str:
    point, episode = divmod(number, what.stride)
    return f"seed {what.options.seed + episode} of {points[point].folder}"


def job_of_sweep(what: SweepOptions) -> JobKey:
    """Key of the job file of this sweep. Raises OSError."""
    return job_of(
        "sweep", what.task, what, ("out", "workers", "upload"), needed_by(what.task, what.actions).files
    )


def keep_results(what: SweepOptions, results: SweepResults) -> None:
    """Write the table next to the recordings. Raises OSError."""
    what.out.mkdir(parents=True, exist_ok=True)
    write_results(what.out / RESULTS, results)
    if what.upload:
        upload_file(what.out / RESULTS, what.upload)


# --- text ------------------------------------------------------------------------------------------------


def print_report(report: SweepReport, what: SweepOptions, has_table: bool) -> int:
    """Print the points, the best first, and the failures; returns the exit code.

    Args:
        has_table: whether the table of results was written.
    """
    print_points(report.results)
    if report.failures:
        points = what.points
        print_failures(report.failures, lambda number: _named(what, points, number))
    if has_table and any(one.steps is not None for one in report.results.episodes):
        table, folder = what.out / RESULTS, shlex.quote(str(what.out))
        copied = f", after copying the contents of {what.upload} into it" if what.upload else ""
        print_text(f"Each episode is a row of {table}. Look at them with: workbench review {folder}{copied}")
    return Exit.FAILED if report.failures else Exit.DONE


def print_points(results: SweepResults) -> None:
    """Print a row for each point."""
    summaries = results.summaries()
    terms = list(dict.fromkeys(name for one in summaries for name in one.means))
    # If the task reports the terms that sum to the reward, show only these; else show all its terms.
    terms = [name for name in terms if name.startswith(TERM_PREFIX)] or terms
    cells = [_cells(one, terms) for one in summaries[:_MAX_POINTS]]
    heads = [*results.names, "success (95 %)", "at the end", "return"]
    heads = [*heads, *(name.removeprefix(TERM_PREFIX) for name in terms)]
    widths = [max(map(len, column)) + 2 for column in zip(heads, *(row for _, row in cells), strict=True)]
    first, fit = len(heads) - len(terms), len(heads)
    # Drop columns that do not fit: a table wrapped within words is unreadable.
    while fit > first and sum(widths[:fit]) > out.width:
        fit -= 1
    table = Table(box=None, pad_edge=False)
    for k, head in enumerate(heads[:fit]):
        if k < len(results.names):
            table.add_column(escape(head), overflow="fold")
        else:
            table.add_column(escape(head), justify="right", no_wrap=True)
    for style, row in cells:
        table.add_row(*map(escape, row[:fit]), style=style)
    out.print(table)
    if len(summaries) > _MAX_POINTS:
        print_text(f"... and {len(summaries) - _MAX_POINTS} more points")
    print_text(
        "success: share of episodes with success at any step, with its 95 % confidence interval; the columns return and "
        "terms are means over the episodes"
    )
    if fit < len(heads):
        print_text(f"More means are in {RESULTS}: {', '.join(heads[fit:])}")


def _cells(one: PointSummary, terms: Sequence[str]) -> tuple[str, list[str]]:
    """Returns (style, texts) of a row."""
    values = [value_text(text) for text in one.values.values()]
    if not one.episodes:
        return "yellow", [*values, f"{one.failed} failed" if one.failed else "-", *["-"] * (2 + len(terms))]
    success = at_end = "-"
    if one.rate is not None and one.interval is not None and one.solved_at_end is not None:
        low, high = (100 * end for end in one.interval)
        success = f"{100 * one.rate:.0f} % ({low:.0f} - {high:.0f})"
        at_end = f"{100 * one.solved_at_end / one.episodes:.0f} %"
    if one.failed:
        success += f", {one.failed} failed"
    total = "-" if one.mean_return is None else number_text(one.mean_return, ".3f")
    means = [number_text(one.means[name], ".3g") if name in one.means else "-" for name in terms]
    return "yellow" if one.failed else "", [*values, success, at_end, total, *means]


# --- for programs ----------------------------------------------------------------------------------------


def write_reports(results: SweepResults, output: SweepOutput) -> None:
    """Write the requested files. Raises OSError."""
    if output.json_file is not None:
        replace_file(output.json_file, as_json(results).encode())
    if output.csv_file is not None:
        replace_file(output.csv_file, as_csv(results).encode())


def as_json(results: SweepResults) -> str:
    """The points, the best first, each with its episodes."""
    points = []
    for one in results.summaries():
        rows = [_row(results, row) for row in results.episodes if row.point == one.index]
        points.append(
            {
                "point": one.index,
                "set": {name: json.loads(text) for name, text in one.values.items()},
                "success_rate": one.rate,
                "success_interval_95": one.interval,
                "success_rate_at_end": None
                if one.solved_at_end is None
                else one.solved_at_end / one.episodes,
                "mean_return": one.mean_return,
                "means": dict(one.means),
                "failed": one.failed,
                "failure": one.failure,
                "episodes": rows,
            }
        )
    return json_text(
        {"task": results.task, "actions": results.actions, "seeds": results.seeds, "points": points}
    )


def as_csv(results: SweepResults) -> str:
    """A row for each episode, as in ``results.parquet``."""
    means = list(dict.fromkeys(name for row in results.episodes for name in row.means))
    names = [*results.names]
    text = io.StringIO()
    header = ["point", *(f"set.{name}" for name in names), *_COLUMNS, *(f"mean.{name}" for name in means)]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*header, "recording", "failure"])
    for row in results.episodes:
        values = [value_text(results.points[row.point][name]) for name in names]
        entries = _row(results, row)
        writer.writerow(
            [row.point, *values, *(entries[name] for name in _COLUMNS)]
            + [row.means.get(name) for name in means]
            + [row.recording, row.failure]
        )
    return text.getvalue()


_COLUMNS = ("seed", "success", "success_at_end", "solved_at", "steps", "return")


def _row(results: SweepResults, row: Any) -> dict[str, Any]:
    values = row.seed, row.success, row.success_at_end, row.solved_at, row.steps, row.total_reward
    entries = dict(zip(_COLUMNS, values, strict=True))
    return {**entries, "means": dict(row.means), "recording": row.recording, "failure": row.failure}

"""Runs ``workbench solve``: progress bar, table of the seeds, verdicts on the reward, and reports for other programs."""

from __future__ import annotations

import csv
import io
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from rich.markup import escape
from rich.progress import MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from workbench.checks.rule_table import RULES
from workbench.cli.arguments import ONE_WORKER, JobArguments
from workbench.cli.check_reports import json_text, xml_text
from workbench.cli.output import (
    Exit,
    interrupted,
    out,
    print_failures,
    print_finding,
    print_text,
    progress_bar,
    refuse,
    stdout_to_stderr,
    warn,
)
from workbench.cli.record import RecordBar
from workbench.cli.run_by import (
    EPISODES_KEPT,
    JOB_ENDS,
    exit_after,
    is_recorded,
    items_of,
    print_part,
    run_by,
    status_in_folder,
)
from workbench.envs.gpu_rules import FailOn, fails
from workbench.episodes.reader.reading import recover_confined
from workbench.episodes.writing.publish import try_folder
from workbench.episodes.writing.upload import require_place
from workbench.jobs.results_file import JobKey, job_of
from workbench.jobs.scheduler import Failure
from workbench.machine.files import replace_file
from workbench.machine.folders import CurrentFolder
from workbench.machine.text import plain_text
from workbench.planning.seeds_report import SolvedSeed, SolveReport
from workbench.planning.verdicts import RewardVerdict
from workbench.record.job import chunk_of
from workbench.record.job_worker import with_given_actions
from workbench.solve.job import SolveOptions, solve

_COLUMNS = ("seed", "solved_at", "steps", "return", "seconds", "in_the_way", "rules", "recording")


@dataclass(frozen=True)
class SolveOutput:
    """Files that the command writes, what it prints (text, JSON or CSV), and when it fails."""

    json: bool = False
    """Print JSON instead of text."""
    json_file: Path | None = None
    csv: bool = False
    """Print CSV instead of text."""
    csv_file: Path | None = None
    junit: Path | None = None
    fail_on: FailOn = "stop"
    """Lowest degree of a broken rule that makes the exit code 1."""

    def fails(self, report: SolveReport) -> bool:
        """Whether the exit code is 1: the reward breaks a rule of the degree `fail_on` or a higher one, or no
        seed was solved. Always False if `fail_on` is ``never``."""
        if self.fail_on == "never":
            return False
        return not report.solved or any(self.fails_by(verdict) for verdict in report.verdicts)

    def fails_by(self, verdict: RewardVerdict) -> bool:
        return fails(RULES[verdict.rule].degree, self.fail_on)


def solve_in_terminal(what: SolveOptions, output: SolveOutput, run: JobArguments = ONE_WORKER) -> int:
    """Solve, print, and write the reports; returns the exit code. Ctrl-C keeps and reports the finished
    episodes."""
    here = CurrentFolder()  # a task may change the current folder
    failures: list[Failure] = []

    def named(number: int) -> str:
        return f"seed {what.options.seed + number}"

    try:
        if what.upload:
            require_place(what.upload)
        else:
            try_folder(what.out)
        with_given_actions(what.recording())
        recover_confined(what.out)
        left = (TextColumn("left"), TimeRemainingColumn())
        chunk = chunk_of(what.seeds, what.options.num_envs)
        count = items_of(run, what.seeds, chunk)
        with (
            stdout_to_stderr(),
            run_by(run, "solve", -(-what.seeds // chunk), lambda: _job_of(what), is_recorded(what.out)) as (
                executor,
                name,
            ),
            progress_bar(MofNCompleteColumn(), TimeElapsedColumn(), *left) as bar,
            status_in_folder(
                run, "solve", what.task, None if what.upload else what.out, count, named
            ) as status,
        ):
            with RecordBar(bar, count, "solving", what.options.seed) as shown:
                report = solve(
                    what,
                    shown.describe,
                    status.with_status(shown.show),
                    lambda: shown.stop_requested,
                    print_finding,
                    executor,
                    run=name,
                    on_failures=failures.extend,
                    on_notice=warn,
                )
            shown.describe("solved", len(report.seeds))
            status.end("stopped" if report.stopped else "done")
    except JOB_ENDS as error:
        return exit_after(error)
    try:
        with here.again():
            write_reports(report, what, output)
    except OSError as error:
        return refuse(str(error))
    if output.json or output.csv:
        print((as_json if output.json else as_csv)(report, what, output), end="", flush=True)
    else:
        print_report(report)
    if failures:
        print_failures(failures, named)
    print_part(run, "solve", report.stopped)
    if report.stopped:
        return interrupted(EPISODES_KEPT)
    return Exit.FAILED if failures or output.fails(report) else Exit.DONE


def _job_of(what: SolveOptions) -> JobKey:
    return job_of("solve", what.task, what, ("out", "workers", "upload"))


# --- text ------------------------------------------------------------------------------------------------


def print_report(report: SolveReport) -> None:
    """Print the seeds, the verdicts on the reward, and a summary."""
    table = Table(box=None, pad_edge=False)
    for name in ("seed", "solved at", "steps", "return", "seconds"):
        table.add_column(name, justify="right")
    table.add_column("what stood in the way", overflow="fold")
    for one in report.seeds:
        cells = _cells(one)
        style = "" if one.solved_at else "yellow"
        table.add_row(*(escape(cell) for cell in cells), style=style)
    if report.seeds:
        out.print(table)
    for verdict in report.verdicts:
        _print_verdict(verdict)
    for note in report.notes:
        out.print(f"[dim]note[/] {escape(note)}", soft_wrap=True)
    print_text(report.summary)
    if report.seeds:
        print_text(f"Look at them with: workbench review {shlex.quote(str(report.seeds[0].path.parent))}")


def _cells(one: SolvedSeed) -> Iterator[str]:
    yield str(one.seed)
    yield str(one.solved_at) if one.solved_at else "-"
    yield str(one.steps)
    yield f"{one.total_reward:.3f}"
    yield f"{one.seconds:.1f}"
    yield one.in_the_way


def _print_verdict(verdict: RewardVerdict) -> None:
    rule = RULES[verdict.rule]
    out.print(f"\n[yellow]{rule.id}[/] ({rule.degree})", soft_wrap=True)
    out.print(f"  {escape(plain_text(verdict.message))}", soft_wrap=True)
    out.print(f"  Why: {escape(rule.otherwise)}", soft_wrap=True)
    seeds = ", ".join(map(str, verdict.seeds[:12])) + (" ..." if len(verdict.seeds) > 12 else "")
    out.print(f"  [dim]seeds {seeds}; workbench help {rule.id}[/]", soft_wrap=True)


# --- for programs ----------------------------------------------------------------------------------------


def write_reports(report: SolveReport, what: SolveOptions, output: SolveOutput) -> None:
    """Write the requested files. Raises OSError."""
    for path, made in ((output.json_file, as_json), (output.csv_file, as_csv), (output.junit, as_junit)):
        if path is not None:
            replace_file(path, made(report, what, output).encode())


def as_json(report: SolveReport, what: SolveOptions, output: SolveOutput) -> str:
    """The whole report as one JSON object."""
    return json_text(
        {
            "task": what.task,
            "first_seed": what.options.seed,
            "plan": vars(what.plan),
            "env": what.options.env_kwargs,
            "solved": len(report.solved),
            "tried": len(report.seeds),
            "median_steps": report.median_steps,
            "seconds": round(report.seconds, 3),
            "stopped": report.stopped,
            "fail_on": output.fail_on,
            "fails": output.fails(report),
            "notes": list(report.notes),
            "verdicts": [
                {"rule": one.rule, "message": one.message, "seeds": list(one.seeds)}
                for one in report.verdicts
            ],
            "seeds": [_row(one, report) for one in report.seeds],
        }
    )


def as_csv(report: SolveReport, what: SolveOptions, output: SolveOutput) -> str:
    """A row for each seed."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list[str](_COLUMNS), lineterminator="\n")
    writer.writeheader()
    for one in report.seeds:
        row = _row(one, report)
        writer.writerow({**row, "rules": " ".join(row["rules"])})
    return text.getvalue()


def as_junit(report: SolveReport, what: SolveOptions, output: SolveOutput) -> str:
    """JUnit XML with a test case for each broken rule of `planning.verdicts` and for each seed. The case of a
    rule fails if the rule's degree makes the command fail. The case of an unsolved seed is skipped: one
    unsolved seed is not a fault of the task."""
    cases = [_case(what, f"seed {one.seed}", one.seconds) for one in report.seeds]
    for case, one in zip(cases, report.seeds, strict=True):
        if not one.solved_at:
            ElementTree.SubElement(case, "skipped", message=xml_text(one.in_the_way))
    broken = [_case(what, verdict.rule, 0) for verdict in report.verdicts]
    for case, verdict in zip(broken, report.verdicts, strict=True):
        if output.fails_by(verdict):
            ElementTree.SubElement(case, "failure", type=verdict.rule, message=xml_text(verdict.message))
        else:
            ElementTree.SubElement(case, "system-out").text = xml_text(verdict.message)
    if not report.solved and output.fails(report):
        broken.append(_case(what, "solved", 0))
        ElementTree.SubElement(broken[-1], "failure", type="solved", message="no seed was solved")
    totals = {
        "tests": str(len(cases) + len(broken)),
        "failures": str(sum(case.find("failure") is not None for case in broken)),
        "skipped": str(len(report.seeds) - len(report.solved)),
        "time": f"{report.seconds:.3f}",
    }
    suites = ElementTree.Element("testsuites", {"name": "workbench solve", **totals})
    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    suite = ElementTree.SubElement(
        suites, "testsuite", {"name": xml_text(what.task), "timestamp": now, **totals}
    )
    suite.extend([*broken, *cases])
    ElementTree.indent(suites)
    return ElementTree.tostring(suites, encoding="unicode", xml_declaration=True) + "\n"


def _case(what: SolveOptions, name: str, seconds: float) -> ElementTree.Element:
    classname = xml_text(f"workbench.solve.{what.task}")
    return ElementTree.Element("testcase", classname=classname, name=name, time=f"{seconds:.3f}")


def _row(one: SolvedSeed, report: SolveReport) -> dict[str, Any]:
    values = (
        one.seed,
        one.solved_at or None,
        one.steps,
        round(one.total_reward, 6),
        round(one.seconds, 3),
        one.in_the_way,
        [verdict.rule for verdict in report.verdicts if one.seed in verdict.seeds],
        str(one.path),
    )
    return dict(zip(_COLUMNS, values, strict=True))

"""Runs ``workbench check``: a progress bar, the findings by degree, a summary, and reports for other programs."""

from __future__ import annotations

import textwrap
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.markup import escape
from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn

from workbench.actions.choose import needed_by
from workbench.checks.job import CheckReport, check
from workbench.checks.job_items import (
    CheckedTask,
    CheckOptions,
    count_chunks,
    count_items,
    count_rules,
    degrees_of_request,
)
from workbench.checks.results import RuleResult, state_text
from workbench.checks.rule_table import RULES
from workbench.cli.arguments import JobArguments
from workbench.cli.check_reports import (
    REPORT_IT,
    Reported,
    as_json,
    as_junit,
    as_sarif,
    count_text,
    shown_path,
)
from workbench.cli.output import (
    Exit,
    err,
    interrupted,
    out,
    print_problem,
    progress_bar,
    refuse,
    stdout_to_stderr,
    warn,
)
from workbench.cli.run_by import print_part, run_by, shard_of
from workbench.envs.gpu_rules import FailOn, Finding
from workbench.jobs.results_file import JobKey, job_of
from workbench.jobs.scheduler import PoolError
from workbench.machine.files import replace_file
from workbench.machine.folders import CurrentFolder
from workbench.machine.text import plain_text
from workbench.task.problem import Problem, TaskError, place_text
from workbench.task.reference import named_file

MAX_RULES_PER_LINE = 3
"""Maximum number of rules on one line with their common reason. If more rules share a reason, the reason is
printed first, and the rules on the lines below."""


@dataclass(frozen=True)
class CheckOutput:
    """Files that a check writes, what it prints (text or JSON), and when it fails."""

    json: bool = False
    """Print JSON instead of text."""
    json_file: Path | None = None
    junit: Path | None = None
    sarif: Path | None = None
    fail_on: FailOn = "stop"
    """Lowest degree of a finding that makes the exit code 1."""


def check_in_terminal(
    what: CheckOptions, output: CheckOutput, began: float, run: JobArguments | None = None
) -> int:
    """Check, print, and write the reports; returns the exit code.

    Args:
        began: when the command began, by ``time.monotonic()``.
        run: where the work runs; None for one process per core, but not more processes than chunks.
    """
    run = run or JobArguments()
    here, root = CurrentFolder(), Path.cwd()  # a task may change the current folder
    try:
        total, chunks = count_rules(degrees_of_request(what)), count_chunks(what)
        items = count_items(what, shard_of(run).part(chunks))
        with (
            stdout_to_stderr(),
            run_by(run, "check", chunks, lambda: _job_of(what)) as (executor, _),
            progress_bar(MofNCompleteColumn(), TimeElapsedColumn()) as bar,
        ):
            shown = _CheckProgress(bar, total, items)
            try:
                report = check(
                    what,
                    shown.show_activity,
                    shown.show_result,
                    executor=executor,
                    began=began,
                    on_progress=shown.show_count,
                )
            except BaseException:
                shown.hide()
                raise
            shown.finish(len(report.results))
    except TaskError as error:
        print_problem(error.problem)
        reported = _without_result(what, output, root, error.problem, began)
    except PoolError as error:
        refuse(str(error))
        reported = _without_result(
            what, output, root, Problem("worker", str(error), None, None, None, ""), began
        )
    except (OSError, ValueError) as error:
        return refuse(str(error))
    except KeyboardInterrupt:
        print_part(run, "check", stopped=True)
        return interrupted()
    else:
        reported = Reported(report, what, root, output.fail_on)
    try:
        with here.again():
            write_reports(reported, output)
    except OSError as error:
        return refuse(str(error))
    if output.json:
        print(as_json(reported), end="", flush=True)
    elif reported.error is None:
        print_report(reported)
        print_part(run, "check", stopped=False)
    return exit_code(reported)


class _CheckProgress:
    """The progress of a check: a bar, and lines about rules that are broken or not known where the bar is not
    drawn (a file or a pipe).

    Args:
        total: number of rules.
        items: number of work items, if the check reports how many are done (`show_count`).
    """

    def __init__(self, bar: Progress, total: int, items: int) -> None:
        self._bar, self._items = bar, items
        self._row = bar.add_task("opening", total=total)
        self._done: set[str] = set()
        self._printed: set[str] = set()
        self._counts_items = False
        """Whether the bar counts work items, not rules."""

    def show_activity(self, activity: str) -> None:
        self._bar.update(self._row, description=activity)

    def show_count(self, count: int) -> None:
        """Show the number of work items that are done."""
        self._counts_items = True
        self._bar.update(self._row, completed=count, total=self._items)

    def show_result(self, result: RuleResult) -> None:
        self._done.add(result.rule)
        if not self._counts_items:
            self._bar.update(self._row, completed=len(self._done))
        line = ""
        if result.state in ("broken", "failed"):
            line = f"{result.rule}: {result.state}"
        elif result.problem is not None:
            # One exception of the task may leave most rules undecided: print each reason only once.
            line = f"not known: {result.why}"
        if line and not err.is_terminal and line not in self._printed:
            self._printed.add(line)
            # In a file or a pipe, the bar is drawn only once, at the end.
            err.print(_safe(line), soft_wrap=True)

    def hide(self) -> None:
        """Remove the bar, because the check has failed."""
        self._bar.update(self._row, visible=False)

    def finish(self, rules: int) -> None:
        """Show that the check is done, for this number of rules."""
        if not self._counts_items:
            self._bar.update(self._row, completed=rules)
        self._bar.update(self._row, description="checked")


def write_reports(reported: Reported, output: CheckOutput) -> None:
    """Write the requested files. Raises OSError."""
    for path, made in ((output.json_file, as_json), (output.junit, as_junit), (output.sarif, as_sarif)):
        if path is not None:
            replace_file(path, made(reported).encode())


def exit_code(reported: Reported) -> int:
    """Exit code of a check: 2 if nothing was checked, 1 if the check fails (`CheckReport.fails`), else 0."""
    if reported.error is not None:
        return Exit.REFUSED
    return Exit.FAILED if reported.report.fails(reported.fail_on) else Exit.DONE


def _job_of(what: CheckOptions) -> JobKey:
    return job_of("check", what.task, what, ("workers",), needed_by(what.task, what.actions).files)


def _without_result(
    what: CheckOptions, output: CheckOutput, root: Path, problem: Problem, began: float
) -> Reported:
    """Content of the reports if nothing was checked."""
    file = named_file(what.task)
    named = str(file) if file is not None and file.is_file() else None
    seconds = time.monotonic() - began
    report = CheckReport(CheckedTask(what.task, "", named), (), seconds, seconds)
    return Reported(report, what, root, output.fail_on, problem)


# --- text ------------------------------------------------------------------------------------------------


def print_report(reported: Reported) -> None:
    """Print the findings, and a summary."""
    report = reported.report
    findings = report.findings
    for degree, style in (("stop", "red"), ("warn", "yellow")):
        of_degree = [finding for finding in findings if finding.degree == degree]
        if of_degree:
            _print(f"[bold {style}]{degree}[/]: {count_text(len(of_degree), 'finding')}\n")
        for finding in of_degree:
            _print_finding(finding, reported.root, style)
    _print_summary(report, reported.root)
    for notice in report.task.notices:
        warn(notice)
    if report.task.others:
        name = Path(report.task.file or "").name
        others = ", ".join(f"{name}:{other}" for other in report.task.others)
        warn(f"Not checked, because each run checks one task: {others}")


def _print_finding(finding: Finding, root: Path, style: str) -> None:
    place = place_text(finding.file and shown_path(finding.file, root), finding.line)
    times = f", {finding.count} times" if finding.count > 1 else ""
    _print(f"{_safe(place)}[{style}]{finding.rule}[/] ({finding.degree}{times})")
    _print(f"  {_safe(finding.message)}")
    if finding.code:
        _print(f"      [bold]{_safe(finding.code)}[/]")
    _print(f"  Why: {escape(RULES[finding.rule].otherwise)}")
    _print(f"  [dim]workbench help {finding.rule}[/]\n")


def _print_summary(report: CheckReport, root: Path) -> None:
    failed = report.of_state("failed")
    for result in failed:
        _print(f"[bold red]failed[/] {result.rule}: {_safe(result.why)}")
    if crashed := [result.rule for result in failed if result.is_crash]:
        _print(f"{', '.join(crashed)}: {REPORT_IT}")
    for result in report.results:
        for one in result.silenced:
            file = shown_path(one.finding.file or "", root)
            _print(f"[dim]silenced[/] {file}:{one.finding.line}: {result.rule}: {_safe(one.reason)}")
    for comment in report.comments:
        place = f"{shown_path(comment.file, root)}:{comment.line}"
        _print(f"[yellow]comment[/] {_safe(place)}: {_safe(comment.message)}")
    _print_by_reason("[yellow]not known[/]", report.of_state("not_known"))
    _print_by_reason("[dim]not applicable[/]", report.of_state("not_applicable"))
    if report.ignored:
        _print_names(f"[dim]{len(report.ignored)} ignored[/]:", report.ignored)
    for result in report.results:
        for note in result.notes:
            _print(f"[dim]note[/] {result.rule}: {_safe(note)}")
    counts = Counter(result.state for result in report.results)
    words = [f"{count_text(counts['kept'], 'rule')} kept", f"{counts['broken']} broken"]
    others = ("silenced", "not_applicable", "not_known", "failed")
    words += [f"{counts[state]} {state_text(state)}" for state in others if counts[state]]
    words += [f"{len(report.ignored)} ignored"] if report.ignored else []
    summary = f"{_safe(report.task.env_id)}: {', '.join(words)}."
    if report.seconds:
        summary += f" {report.seconds:.1f} s, of which {report.start_seconds:.1f} s to start"
        if report.picture_seconds:
            summary += f" and {report.picture_seconds:.1f} s for the first pictures"
        summary += "."
    _print(summary)


def _print_by_reason(label: str, results: tuple[RuleResult, ...]) -> None:
    """Print a line for each reason; the reason comes first if many rules share it."""
    rules: dict[str, list[str]] = {}
    for result in results:
        rules.setdefault(result.why, []).append(result.rule)
    for why, of in rules.items():
        if len(of) <= MAX_RULES_PER_LINE:
            _print(f"{label} {', '.join(of)}: {_safe(why)}")
        else:
            _print(f"{label} {_safe(why)}")
            _print_names(f"    {count_text(len(of), 'rule')}:", of)


def _print_names(label: str, names: Sequence[str]) -> None:
    """Print the names after the label, wrapped to the terminal's width."""
    lines = textwrap.wrap(", ".join(names), max(40, out.width - 6), break_on_hyphens=False)
    _print(f"{label} {lines[0]}" if len(lines) == 1 else label)
    for line in lines if len(lines) > 1 else ():
        _print(f"      {line}")


def _safe(text: str) -> str:
    return escape(plain_text(text))


def _print(text: str) -> None:
    out.print(text, soft_wrap=True)

"""Runs ``workbench merge``: merges the parts of a job and prints the output of the whole command."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from workbench.checks.job import report_of as check_report_of
from workbench.checks.job_items import CheckOptions, ItemOutcome
from workbench.cli.check import CheckOutput, exit_code
from workbench.cli.check import print_report as print_check
from workbench.cli.check import write_reports as write_check_reports
from workbench.cli.check_reports import Reported
from workbench.cli.output import Exit, print_text, refuse
from workbench.cli.output import out as out_console
from workbench.cli.record import print_recorded
from workbench.cli.rescore import (
    RescoreOutput,
    RescoreRequest,
    code_of,
    print_verdicts,
    warn_of_verdicts,
    write_tables,
)
from workbench.cli.solve import SolveOutput, print_report
from workbench.cli.solve import write_reports as write_solve_reports
from workbench.cli.sweep import SweepOutput, keep_results
from workbench.cli.sweep import print_report as print_report_of_sweep
from workbench.cli.sweep import write_reports as write_sweep_reports
from workbench.envs.gpu_rules import FailOn
from workbench.episodes.writing.publish import RecordingError
from workbench.jobs.results_file import JobFileError, JobParts, read_parts, write_whole
from workbench.machine.files import new_file
from workbench.machine.text import listed
from workbench.record.job import collect
from workbench.record.job_worker import RecordOptions, Written
from workbench.rescore.job import RescoredRecording
from workbench.solve.job import SolveOptions, report_of
from workbench.sweep.job import SweepOptions, collect_sweep


@dataclass(frozen=True)
class MergeOutput:
    """Output in addition to the text. Each command that `--part` splits writes some of these files; see
    `_WRITES`."""

    json_file: Path | None = None
    csv_file: Path | None = None
    junit: Path | None = None
    sarif: Path | None = None
    fail_on: FailOn = "stop"
    """Lowest degree of a finding that makes the exit code 1; see `CheckOutput` and `SolveOutput`."""


_WRITES = {
    "record": (),
    "check": ("json_file", "junit", "sarif"),
    "rescore": ("json_file", "csv_file"),
    "solve": ("json_file", "csv_file", "junit"),
    "sweep": ("json_file", "csv_file"),
}
"""Files that each command writes, as fields of `MergeOutput`."""


def merge_in_terminal(files: Sequence[Path], job: Path | None, out: Path | None, output: MergeOutput) -> int:
    """Merge and print; returns the exit code."""
    try:
        merged = read_parts(files)
        _require_known(merged, output)
        merged = _together(merged, out)
        if job is not None:
            write_whole(job, merged)
        code = _print(merged, output)
    except (OSError, ValueError) as error:
        return refuse(str(error))
    return code


def _require_known(merged: JobParts, output: MergeOutput) -> None:
    """Raise JobFileError if merge does not support the command, or if a file is requested that the command
    does not write."""
    if merged.command not in _WRITES:
        raise JobFileError(
            f"{merged.files[0]} comes from workbench {merged.command}, which merge does not support"
        )
    for name in ("json_file", "csv_file", "junit", "sarif"):
        if getattr(output, name) is not None and name not in _WRITES[merged.command]:
            option = name.replace("_", "-")
            raise JobFileError(
                f"--{option} does not apply to results of workbench {merged.command}: leave it out"
            )


def _together(merged: JobParts, out: Path | None) -> JobParts:
    """Copy the episodes of all parts into the folder `out`; returns the results with that folder. If `out` is
    None, returns `merged`, or raises JobFileError if its episodes are in several folders."""
    if merged.command not in ("record", "solve", "sweep"):
        return merged
    results: dict[int, Written | None] = merged.results(Written | None)
    local = {number: one for number, one in results.items() if one is not None and not one.address}
    if out is not None:
        # A sweep has a folder for the episodes of each point.
        below = _folder_of_point(merged) if merged.command == "sweep" else lambda number: ""
        for number, one in local.items():
            _copy(Path(merged.folders[number], below(number), one.path.name), out / below(number))
        return replace(merged, folders=dict.fromkeys(merged.folders, str(out.absolute())))
    folders = {merged.folders[number] for number in local}
    if len(folders) > 1:
        raise JobFileError(
            f"the episodes are in {len(folders)} folders ({listed(sorted(folders), 3)}): copy them into one folder with --out FOLDER"
        )
    return merged


def _folder_of_point(merged: JobParts) -> Callable[[int], str]:
    what = merged.requested(SweepOptions)
    points, stride = what.points, what.stride
    return lambda number: points[number // stride].folder


def _copy(rrd: Path, out: Path) -> None:
    """Copy those files of an episode that are not in `out` yet, the .json last."""
    for suffix in (".rrd", ".h5", ".json"):
        source, target = rrd.with_suffix(suffix), out / f"{rrd.stem}{suffix}"
        if not source.is_file() and not target.is_file():
            raise RecordingError(
                f"{source} does not exist: merge on a machine that can read the folders of all parts"
            )
        if not target.exists():
            with new_file(target) as temporary:
                shutil.copyfile(source, temporary)


def _print(merged: JobParts, output: MergeOutput) -> int:
    """Print the output of the command, and write its files; returns its exit code."""
    if merged.command == "check":
        return _print_check(merged, output)
    if merged.command == "rescore":
        return _print_rescore(merged, output)
    folder = next(iter(merged.folders.values()), "")
    items: Iterable[int]
    known: dict[int, Written | None] = merged.results(Written | None)
    if merged.command == "record":
        what = merged.requested(RecordOptions)
        what = replace(what, out=Path(folder or what.out))
        recorded = collect(what, known)
        code, missing = print_recorded(what, recorded), recorded.missing
        items = range(what.episodes or 0)
    elif merged.command == "solve":
        asked = merged.requested(SolveOptions)
        asked = replace(asked, out=Path(folder or asked.out))
        recorded = collect(asked.recording(), known)
        report = report_of(asked, recorded, 0.0)
        files = SolveOutput(
            json_file=output.json_file, csv_file=output.csv_file, junit=output.junit, fail_on=output.fail_on
        )
        write_solve_reports(report, asked, files)
        print_report(report)
        code, missing = Exit.FAILED if files.fails(report) else Exit.DONE, recorded.missing
        items = range(asked.seeds)
    else:
        varied = merged.requested(SweepOptions)
        varied = replace(varied, out=Path(folder or varied.out))
        swept = collect_sweep(varied, known)
        keep_results(varied, swept.results)
        write_sweep_reports(swept.results, SweepOutput(output.json_file, output.csv_file))
        code, missing = print_report_of_sweep(swept, varied, has_table=True), swept.missing
        items = varied.items
    return _with_missing(code, missing, "episodes", (f"number {n}" for n in items if n not in known))


def _with_missing(code: int, missing: int, what: str, names: Iterable[str] = ()) -> int:
    """Print the missing results, if any. Returns `Exit.FAILED` if there are any, else `code`."""
    if missing:
        some = listed(list(names), 20)
        print_text(f"{missing} of the job's {what} are in none of these files{some and ': '}{some}")
        return Exit.FAILED
    return code


def _print_check(merged: JobParts, output: MergeOutput) -> int:
    what = merged.requested(CheckOptions)
    report = check_report_of(what, merged.results(ItemOutcome))
    reported = Reported(report, what, Path.cwd(), output.fail_on)
    write_check_reports(
        reported, CheckOutput(json_file=output.json_file, junit=output.junit, sarif=output.sarif)
    )
    print_check(reported)
    return _with_missing(exit_code(reported), report.missing, "results of rules")


def _print_rescore(merged: JobParts, output: MergeOutput) -> int:
    what = merged.requested(RescoreRequest)
    results: dict[int, RescoredRecording] = merged.results(RescoredRecording)
    ordered = sorted(results.values(), key=lambda result: result.place)
    verdicts = [result.verdict for result in ordered]
    write_tables(verdicts, RescoreOutput(json_file=output.json_file, csv_file=output.csv_file))
    print_verdicts(verdicts, out_console)
    warn_of_verdicts(verdicts, dict.fromkeys(result.note for result in ordered if result.note))
    return _with_missing(code_of(verdicts), what.recordings - len(results), "recordings")

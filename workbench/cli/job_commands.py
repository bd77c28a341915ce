"""The commands that run jobs, and their arguments."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from workbench.cli.arguments import (
    CheckArguments,
    EpisodeArguments,
    JobArguments,
    RescoreArguments,
    Task,
    plan_options,
    separated,
    why_unwritable,
)
from workbench.cli.output import Exit, lacks_maniskill, print_text, refuse
from workbench.envs.gpu_rules import FailOn
from workbench.machine.processes.child_python import quick_imports
from workbench.machine.software_vulkan import use_private_driver
from workbench.planning.options import PlanArguments
from workbench.task.description import RecordArguments

_FEW = EpisodeArguments()
_ONE = EpisodeArguments(num_envs=1)
_HERE = JobArguments()
_PLAN = PlanArguments()


def record(
    recording: Annotated[RecordArguments, tyro.conf.PositionalRequiredArgs],
    plan: PlanArguments = _PLAN,
    envs: EpisodeArguments = _FEW,
    run: JobArguments = _HERE,
    debug: bool = False,
) -> int:
    """Record episodes of a task without a page: for each an .rrd, and ManiSkill's own .h5 with its .json. Episodes that the
    task's code fails in are told at the end; the exit code is 1 then.

    Args:
        debug: wait for a debugger (debugpy, as of VS Code) before the task is loaded, with one worker; breakpoint() stops for
            it. Anyone who can log in to this machine can attach too.
    """
    if lacks_maniskill("record"):
        return Exit.REFUSED
    from workbench.task.reference import why_missing

    if (why := why_missing(recording.task)) is not None:
        return refuse(why)
    use_private_driver()
    with quick_imports():
        from workbench.cli.record import record_in_terminal
        from workbench.cli.run_by import require_job
        from workbench.machine.processes.debugger import debug_here
        from workbench.record.job_worker import RecordOptions

    try:
        options, planned = envs.options(), plan_options(plan)
        require_job(run)
        if debug and (run.cluster is not None or (run.workers or 1) > 1):
            raise ValueError("--debug is for one process: leave out --workers and --cluster")
        if debug:
            debug_here(print_text)
    except ValueError as error:
        return refuse(str(error))
    run = replace(run, workers=1) if debug else run
    return record_in_terminal(RecordOptions(**vars(recording), options=options, plan=planned), run)


def check(
    task: Task,
    /,
    *,
    envs: CheckArguments,
    run: JobArguments = _HERE,
    select: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    ignore: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    actions: str = "random",
    solve: bool = False,
    fail_on: FailOn = "stop",
    json: bool = False,
    json_file: Path | None = None,
    junit: Path | None = None,
    sarif: Path | None = None,
) -> int:
    """Check a task for what goes wrong on a GPU cluster or in training, with the line of each mistake. The exit code is 1
    where a rule is broken, and 2 where the task cannot be imported.

    Args:
        task: a task file, file.py:ClassName, package.module:ClassName, or a registered env id such as PickCube-v1.
        select: check only this rule; repeatable, or several with commas. workbench help rules lists them.
        ignore: do not check this rule; repeatable, or several with commas.
        actions: zero, hold, a policy as module:function or file.py:function, or a file, as of workbench record: it acts
            in further episodes, beside random actions, for the rules of evaluate() and of rewards.
        solve: also plan episodes with the task's own reward, and check what that shows of it: minutes more. See workbench
            help solve.
        fail_on: lowest degree of a finding that makes the exit code 1; never is for a job that only reports.
        json: print the result as JSON in place of text.
        json_file: also write the result to this file, as JSON.
        junit: also write it to this file as JUnit's XML, with a test case for each rule.
        sarif: also write it to this file as SARIF 2.1.0, for code scanning.
    """
    began = time.monotonic()
    if lacks_maniskill("check"):
        return Exit.REFUSED
    from workbench.task.reference import why_missing

    # A report is to say it too.
    reports = json or any(file is not None for file in (json_file, junit, sarif))
    if (why := why_missing(task)) is not None and not reports:
        return refuse(why)
    from workbench.checks.rule_table import degree_of_each

    try:
        options = envs.options()
        # Before torch is imported: a typo is answered at once.
        degree_of_each(separated(select), separated(ignore))
    except ValueError as error:
        return refuse(str(error))
    if (why := why_unwritable(json_file, junit, sarif)) is not None:
        return refuse(why)
    if options.env_kwargs.get("render_backend") != "none":
        use_private_driver()
    with quick_imports():
        from workbench.checks.job_items import CheckOptions
        from workbench.cli.check import CheckOutput, check_in_terminal
        from workbench.cli.run_by import require_job

    try:
        require_job(run)
    except ValueError as error:
        return refuse(str(error))
    rules = separated(select), separated(ignore)
    what = CheckOptions(task, options, envs.seeds, *rules, actions, solve=solve)
    return check_in_terminal(what, CheckOutput(json, json_file, junit, sarif, fail_on), began, run)


def solve(
    task: Task,
    /,
    *,
    plan: PlanArguments = _PLAN,
    envs: EpisodeArguments = _ONE,
    run: JobArguments = _HERE,
    seeds: int = 32,
    max_steps: int | None = None,
    seconds_per_seed: float | None = None,
    pictures: bool = False,
    out: Path = Path("recordings"),
    upload: str = "",
    fail_on: FailOn = "stop",
    json: bool = False,
    json_file: Path | None = None,
    csv: bool = False,
    csv_file: Path | None = None,
    junit: Path | None = None,
) -> int:
    """Solve a task by planning with its own reward, before anyone trains on it: how many seeds, in how many steps, and what
    the rollouts tell of the reward. Episodes are recorded. The exit code is 1 where no seed is solved, or where the reward
    breaks a rule of the degree that --fail-on names, as of workbench check --solve.

    Args:
        task: a task file, file.py:ClassName, package.module:ClassName, or a registered env id such as PickCube-v1.
        seeds: how many seeds are tried. That no rule is broken says something from 8 on.
        max_steps: longest episode; else the task's own limit, or 200 steps where it has none.
        seconds_per_seed: wall time after which a seed ends at its next step, solved or not. What that cuts off depends on
            the machine and on what else it does, so that a second run may come to another result.
        pictures: record what every camera sees.
        out: folder for the recordings.
        upload: an address of fsspec, such as s3://bucket/folder: each episode goes there when it is over, and not into
            the folder.
        fail_on: lowest degree of a broken rule that makes the exit code 1, as of workbench check; the rules of the reward
            are of the degree warn. never: nor does it where no seed is solved.
        json: print the result as JSON in place of text.
        json_file: also write the result to this file, as JSON.
        csv: print a row for each seed as CSV in place of text, with the rules that it is an example of; what is said of
            them is in the JSON.
        csv_file: also write the rows to this file, as CSV.
        junit: also write the result to this file as JUnit's XML.
    """
    if lacks_maniskill("solve"):
        return Exit.REFUSED
    from workbench.task.reference import why_missing

    if (why := why_missing(task)) is not None:
        return refuse(why)
    if json and csv:
        return refuse(
            "--json and --csv both print the result: give one of them, and --json-file or --csv-file"
        )
    if (why := why_unwritable(json_file, csv_file, junit)) is not None:
        return refuse(why)
    try:
        options = envs.options()
        planned = plan_options(plan)
        for name, number in (("seeds", seeds), ("workers", run.workers), ("max-steps", max_steps)):
            if number is not None and number < 1:
                raise ValueError(f"--{name} must be at least 1, not {number}")
    except ValueError as error:
        return refuse(str(error))
    if pictures and options.env_kwargs.get("render_backend") != "none":
        use_private_driver()
    with quick_imports():
        from workbench.cli.solve import SolveOutput, solve_in_terminal
        from workbench.solve.job import SolveOptions

    what = SolveOptions(
        task, out, seeds, 1, pictures, max_steps, planned, options, seconds_per_seed, upload=upload
    )
    return solve_in_terminal(what, SolveOutput(json, json_file, csv, csv_file, junit, fail_on), run)


def sweep(
    task: Task,
    /,
    *,
    plan: PlanArguments = _PLAN,
    envs: EpisodeArguments = _FEW,
    run: JobArguments = _HERE,
    settings: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="set")] = (),
    seeds: int = 100,
    actions: str = "random",
    max_steps: int | None = None,
    pictures: bool = False,
    out: Path | None = None,
    upload: str = "",
    json_file: Path | None = None,
    csv_file: Path | None = None,
) -> int:
    """Record a task with each combination of several values, and compare: how often it succeeds, its return, the terms of
    its reward. The task's file is not changed. Values that the task fails with are told at the end; the exit code is 1
    then.

    Args:
        task: a task file, file.py:ClassName, package.module:ClassName, or a registered env id such as PickCube-v1.
        settings: a name and its values, as in --set reach_weight=0.5,1,2 (each in JSON, or text); repeatable, for all
            combinations. A constant of the file, of its module or of a class, whose value is written there as it is; or an
            argument of the task class.
        seeds: how many episodes for each combination: the same seeds for all.
        actions: random, zero, hold; solve, which plans them by rollouts of the task with its own reward; or a policy as
            module:function or file.py:function.
        max_steps: longest episode; else the task's own limit, or 200 steps where it has none.
        pictures: record what every camera sees.
        out: folder for the recordings and results.parquet; else one in sweeps, with the name of the task.
        upload: an address of fsspec, such as s3://bucket/folder: each episode goes there when it is over, and not into
            the folder; results.parquet is in both.
        json_file: also write the results to this file, as JSON.
        csv_file: also write a row for each episode to this file, as CSV.
    """
    if lacks_maniskill("sweep"):
        return Exit.REFUSED
    from workbench.task.reference import split_reference, why_missing

    if (why := why_missing(task)) is not None:
        return refuse(why)
    if (why := why_unwritable(json_file, csv_file)) is not None:
        return refuse(why)
    if pictures:
        use_private_driver()
    with quick_imports():
        from workbench.cli.run_by import require_job
        from workbench.cli.sweep import SweepOutput, parse_settings, sweep_in_terminal
        from workbench.sweep.job import SweepOptions

    try:
        varied, options, planned = parse_settings(settings), envs.options(), plan_options(plan)
        require_job(run)
        for name, number in (("seeds", seeds), ("max-steps", max_steps)):
            if number is not None and number < 1:
                raise ValueError(f"--{name} must be at least 1, not {number}")
    except ValueError as error:
        return refuse(str(error))
    if out is None:
        named = split_reference(task)
        out = Path("sweeps", named[1] if named is not None else Path(task.partition(".py")[0]).name)
    what = SweepOptions(
        task, varied, out, seeds, actions, pictures, max_steps, planned, options, upload=upload
    )
    return sweep_in_terminal(what, SweepOutput(json_file, csv_file), run)


def merge(
    files: Annotated[tuple[Path, ...], tyro.conf.Positional],
    /,
    *,
    job: Path | None = None,
    out: Path | None = None,
    json_file: Path | None = None,
    csv_file: Path | None = None,
    junit: Path | None = None,
    sarif: Path | None = None,
    fail_on: FailOn = "stop",
) -> int:
    """Put the parts of a job together that were run with --shard, and print what the whole command would have printed. Nothing
    is run. The exit code is 1 where parts are missing, or as of the command.

    Args:
        files: job files of all parts.
        job: also write one job file for the whole. With it the command goes on where parts are missing.
        out: copy the episodes of all parts into this folder.
        json_file: also write the result to this file, as JSON: of check, rescore, solve and sweep.
        csv_file: likewise as CSV: of rescore, solve and sweep.
        junit: likewise as JUnit's XML: of check and solve.
        sarif: likewise as SARIF: of check.
        fail_on: lowest degree of a finding that makes the exit code 1, as of check and solve.
    """
    for file in files:
        if not file.is_file():
            return refuse(f"there is no file {file}")
    if (why := why_unwritable(json_file, csv_file, junit, sarif)) is not None:
        return refuse(why)
    with quick_imports():
        from workbench.cli.merge import MergeOutput, merge_in_terminal

    return merge_in_terminal(files, job, out, MergeOutput(json_file, csv_file, junit, sarif, fail_on))


def rescore(
    places: Annotated[tuple[Path, ...], tyro.conf.Positional],
    /,
    task: str | None = None,
    recorded_source: bool = False,
    use_env_states: bool = False,
    *,
    envs: RescoreArguments,
    run: JobArguments = _HERE,
    csv: bool = False,
    csv_file: Path | None = None,
    json: bool = False,
    json_file: Path | None = None,
    trust: bool = False,
) -> int:
    """Rescore recorded episodes with today's reward and evaluate, and list what differs (on the page: Rescore).

    Args:
        places: recordings (.json, .h5 or .rrd of the workbench, .h5 of ManiSkill's RecordEpisode) and folders of them.
        task: a task file, file.py:ClassName, package.module:ClassName or id to rescore all of them with, in place of the
            one each names.
        recorded_source: rescore each with the text that it was recorded with.
        use_env_states: put every recorded state in after its step, so that nothing drifts from the record.
        csv: print the table as CSV in place of text.
        csv_file: also write the table to this file, as CSV.
        json: print the table as JSON in place of text.
        json_file: also write the table to this file, as JSON.
        trust: run what recordings from elsewhere name or hold without asking, in this run; nothing is kept of it. Without
            it, and without a terminal to ask in, nothing is run and the exit code is 4.
    """
    if lacks_maniskill("rescore"):
        return Exit.REFUSED
    with quick_imports():
        from workbench.cli.rescore import RescoreOptions, RescoreOutput, rescore_in_terminal
        from workbench.cli.run_by import require_job

    if task is not None and recorded_source:
        return refuse("--task and --recorded-source name two versions to rescore with: give one of them")
    if csv and json:
        return refuse(
            "--csv and --json both print the table: give one of them, and --csv-file or --json-file"
        )
    if (why := why_unwritable(csv_file, json_file)) is not None:
        return refuse(why)
    try:
        base = envs.options()
        require_job(run)
    except ValueError as error:
        return refuse(str(error))
    use_private_driver()
    what = RescoreOptions(places, task, recorded_source, use_env_states, envs.num_envs, base)
    return rescore_in_terminal(what, RescoreOutput(csv, csv_file, json, json_file), trust, run)

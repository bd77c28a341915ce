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
from workbench.machine.processes.child_environment import quick_imports
from workbench.machine.software_vulkan import use_private_driver
from workbench.planning.options import PlanArguments
from workbench.task.description import RecordArguments

_DEFAULT_ENVS = EpisodeArguments()
_ONE_ENV = EpisodeArguments(num_envs=1)
_DEFAULT_JOB = JobArguments()
_DEFAULT_PLAN = PlanArguments()


def record(
    recording: Annotated[RecordArguments, tyro.conf.PositionalRequiredArgs],
    plan: PlanArguments = _DEFAULT_PLAN,
    envs: EpisodeArguments = _DEFAULT_ENVS,
    run: JobArguments = _DEFAULT_JOB,
    debug: bool = False,
) -> int:
    """Record episodes of a task without a page, each as an .rrd and as ManiSkill's own .h5 with its .json.
    Episodes in which the task's code raises are listed at the end, with exit code 1.

    Args:
        debug: wait for a debugger (debugpy, such as VS Code's) before the task is loaded, with one worker; breakpoint()
            stops in the debugger. Anyone who can log in to this machine can attach too.
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
    run: JobArguments = _DEFAULT_JOB,
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
    """Check a task for mistakes that show up on a GPU cluster or in training, and print the line of each. The
    exit code is 1 if a rule is broken, and 2 if the task cannot be imported.

    Args:
        task: a task file, file.py:ClassName, package.module:ClassName, or a registered env id such as PickCube-v1.
        select: check only this rule; repeatable, or comma-separated. workbench help rules lists them.
        ignore: do not check this rule; repeatable, or comma-separated.
        actions: zero, hold, a policy as module:function or file.py:function, or a file, as for workbench
            record. The check runs additional episodes with these actions for the rules of evaluate() and of
            rewards.
        solve: also plan episodes with the task's own reward, and check the reward in them. This takes some
            minutes more. See workbench help solve.
        fail_on: lowest degree of a finding that makes the exit code 1. With never, findings do not change the
            exit code.
        json: print the result as JSON instead of text.
        json_file: also write the result to this file, as JSON.
        junit: also write the result to this file as JUnit XML, with a test case for each rule.
        sarif: also write the result to this file as SARIF 2.1.0, for code scanning.
    """
    began = time.monotonic()
    if lacks_maniskill("check"):
        return Exit.REFUSED
    from workbench.task.reference import why_missing

    # If a report is requested, the error must be in the report as well.
    reports = json or any(file is not None for file in (json_file, junit, sarif))
    if (why := why_missing(task)) is not None and not reports:
        return refuse(why)
    from workbench.checks.rule_table import degree_of_each

    try:
        options = envs.options()
        # Check the names before torch is imported, to report a typo at once.
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
    plan: PlanArguments = _DEFAULT_PLAN,
    envs: EpisodeArguments = _ONE_ENV,
    run: JobArguments = _DEFAULT_JOB,
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
    """Solve a task by planning with its own reward before training on it: reports how many seeds are solved, in how many
    steps, and reward problems that the rollouts find. Episodes are recorded. The exit code is 1 if no seed is solved, or if
    the reward breaks a rule of the degree of --fail-on or higher, as in workbench check --solve.

    Args:
        task: a task file, file.py:ClassName, package.module:ClassName, or a registered env id such as PickCube-v1.
        seeds: number of seeds to try. At least 8 are needed to conclude that no rule is broken.
        max_steps: maximum length of an episode; default: the task's own limit, or 200 steps if it has none.
        seconds_per_seed: wall time limit of a seed. A seed that reaches the limit ends at its next step,
            solved or not. Which seeds reach it depends on the machine and its load, so a second run may
            differ.
        pictures: record the pictures of every camera.
        out: folder for the recordings.
        upload: fsspec URL (such as s3://bucket/folder) to which each finished episode is
            uploaded, instead of being kept in the folder.
        fail_on: lowest degree of a broken rule that makes the exit code 1, as for workbench check; the rules of the reward
            have the degree warn. With never, the exit code is 0 even if no seed is solved.
        json: print the result as JSON instead of text.
        json_file: also write the result to this file, as JSON.
        csv: print a row for each seed as CSV instead of text. A row names the broken rules that the seed is
            an example of; their messages are in the JSON.
        csv_file: also write the rows to this file, as CSV.
        junit: also write the result to this file as JUnit XML.
    """
    if lacks_maniskill("solve"):
        return Exit.REFUSED
    from workbench.task.reference import why_missing

    if (why := why_missing(task)) is not None:
        return refuse(why)
    if json and csv:
        return refuse(
            "--json and --csv both print the result: print one, and write the other with --json-file or "
            "--csv-file"
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
    plan: PlanArguments = _DEFAULT_PLAN,
    envs: EpisodeArguments = _DEFAULT_ENVS,
    run: JobArguments = _DEFAULT_JOB,
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
    """Record a task with each combination of several values, and compare success rates, returns and reward terms. The
    task's file is not changed. Values with which the task raises are listed at the end, with exit code 1.

    Args:
        task: a task file, file.py:ClassName, package.module:ClassName, or a registered env id such as PickCube-v1.
        settings: a name and its values, as in --set reach_weight=0.5,1,2 (each in JSON, or text); repeatable, for all
            combinations. The name is a constant of the file (module or class) with a literal
            value, or an argument of the task class.
        seeds: number of episodes for each combination, with the same seeds for all.
        actions: random, zero, hold; solve, which plans with rollouts of the task and its own reward; or a policy as
            module:function or file.py:function.
        max_steps: maximum length of an episode; default: the task's own limit, or 200 steps if it has none.
        pictures: record the pictures of every camera.
        out: folder for the recordings and results.parquet; default: a folder named after the task, in
            sweeps/.
        upload: fsspec URL (such as s3://bucket/folder) to which each finished episode is
            uploaded, instead of being kept in the folder; results.parquet is in both.
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
    """Merge the parts of a job that were run with --shard, and print the output of the whole command. Runs nothing. The exit
    code is 1 if parts are missing, else the exit code of the command.

    Args:
        files: job files of all parts.
        job: also write one job file for the whole job. The command that was sharded can resume from this
            file, to run missing parts.
        out: copy the episodes of all parts into this folder.
        json_file: also write the result to this file, as JSON (check, rescore, solve and sweep).
        csv_file: also write the result to this file, as CSV (rescore, solve and sweep).
        junit: also write the result to this file, as JUnit XML (check and solve).
        sarif: also write the result to this file, as SARIF (check).
        fail_on: lowest degree of a finding that makes the exit code 1, as for check and solve.
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
    run: JobArguments = _DEFAULT_JOB,
    csv: bool = False,
    csv_file: Path | None = None,
    json: bool = False,
    json_file: Path | None = None,
    trust: bool = False,
) -> int:
    """Rescore recorded episodes with the task's current reward and evaluate, and list what differs (on the page: Rescore).

    Args:
        places: recordings (.json, .h5 or .rrd of the workbench, .h5 of ManiSkill's RecordEpisode) and folders of them.
        task: a task file, file.py:ClassName, package.module:ClassName or id to rescore all of them with, instead of the
            task that each recording names.
        recorded_source: rescore each recording with the source code that it was recorded with.
        use_env_states: restore the recorded state after each step, so that the rollout cannot drift from the recording.
        csv: print the table as CSV instead of text.
        csv_file: also write the table to this file, as CSV.
        json: print the table as JSON instead of text.
        json_file: also write the table to this file, as JSON.
        trust: run code referenced by or embedded in foreign recordings without asking. Applies to this run only. Without
            it, and without a terminal to ask in, nothing runs and the exit code is 4.
    """
    if lacks_maniskill("rescore"):
        return Exit.REFUSED
    with quick_imports():
        from workbench.cli.rescore import RescoreOptions, RescoreOutput, rescore_in_terminal
        from workbench.cli.run_by import require_job

    if task is not None and recorded_source:
        return refuse("--task and --recorded-source each choose the code to rescore with: give one of them")
    if csv and json:
        return refuse(
            "--csv and --json both print the table: print one, and write the other with --csv-file or "
            "--json-file"
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

"""The commands of ``workbench`` and their arguments, as ``workbench --help`` shows them."""

from __future__ import annotations

# First: a file in the current folder could have the name of a module that is imported below.
import workbench.machine.processes.own_path  # noqa: F401

# isort: split
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from workbench.cli.terminal.arguments import (
    CheckArguments,
    EnvArguments,
    EpisodeArguments,
    Imports,
    JobArguments,
    PageArguments,
    RescoreArguments,
    Rules,
    history_bytes,
    imported,
    plan_options,
    separated,
)
from workbench.cli.terminal.output import Exit, interrupted, print_text, refuse, warn
from workbench.core.rules import FailOn
from workbench.jobs.task import RecordArguments, ShownPictures
from workbench.machine.maniskill_installed import lines_if_lacking, lines_if_mixed
from workbench.machine.processes.child_python import quick_imports
from workbench.machine.software_vulkan import use_private_driver
from workbench.machine.text import guard_terminal
from workbench.planning.options import PlanArguments

Task = Annotated[str, tyro.conf.Positional]
"""A task file, ``file.py:ClassName``, ``package.module:ClassName``, or a registered env id such as ``PickCube-v1``."""

_FEW = EpisodeArguments()
_HERE = JobArguments()
_PLAN = PlanArguments()

app = tyro.extras.SubcommandApp()
# Commands import what they need when they are chosen, so that ``--help`` and a mistyped option answer at once.


@app.command
def start(
    *,
    envs: EnvArguments,
    page: PageArguments,
    recordings: Path = Path("recordings"),
    history: str = "256MB",
    memory_limit: str = "auto",
    spare: bool = True,
    trust: bool = False,
    editor: str = "vscode",
) -> int:
    """Choose a task on a page: recent ones, the files of this folder, ManiSkill's own. This is what workbench without a
    command does, as in workbench --port 8081.

    Args:
        recordings: folder for recorded episodes.
        history: memory that the steps of the past may take, such as 64MB or 2GB; the oldest go first.
        memory_limit: memory that the task's process may use, such as 8GB; auto is 80 % of this machine's, none
            sets no limit. A process that uses more is ended and replaced.
        spare: keep a second process ready to take over when the task's dies (--no-spare: it then takes some
            seconds more, and about 0.8 GB of memory less).
        trust: run task files from other folders, and what recordings from elsewhere name or hold, without asking, in
            this run; nothing is kept of it.
        editor: what a press on a file's line opens: vscode, cursor, pycharm, none, or an address with {file} and {line};
            as of open.
    """
    from workbench.cli.page import start_in_terminal
    from workbench.session.process.memory_limit import parse_memory
    from workbench.session.process.supervisor import WorkerOptions
    from workbench.ui.server.gated_server import ServerOptions
    from workbench.ui.widgets.editor import parse_editor

    try:
        options = envs.options()
        past = history_bytes(history)
        worker = WorkerOptions(parse_memory(memory_limit), spare)
        at = ServerOptions(**vars(page))
        address = parse_editor(editor)
    except ValueError as error:
        return refuse(str(error))
    # Recordings can be reviewed without it.
    _lacks_maniskill("start")
    return start_in_terminal(options, at, worker, recordings, past, trust, address)


@app.command(name="open")
def open_page(
    task: Task,
    /,
    *,
    envs: EnvArguments,
    page: PageArguments,
    recordings: Path = Path("recordings"),
    history: str = "256MB",
    memory_limit: str = "auto",
    spare: bool = True,
    trust: bool = False,
    editor: str = "vscode",
    pictures: ShownPictures = "auto",
    debug: bool = False,
    debug_port: int | None = None,
    debug_wait: bool = False,
) -> int:
    """Open a task in a browser page that follows its file.

    Args:
        task: a task file, file.py:ClassName, package.module:ClassName, or a registered env id such as PickCube-v1.
        recordings: folder for recorded episodes.
        history: memory that the steps of the past may take, such as 64MB or 2GB; the oldest go first.
        memory_limit: memory that the task's process may use, such as 8GB; auto is 80 % of this machine's, none
            sets no limit. A process that uses more is ended and replaced.
        spare: keep a second process ready to take over when the task's dies (--no-spare: it then takes some
            seconds more, and about 0.8 GB of memory less).
        trust: run what recordings from elsewhere name or hold without asking, in this run; nothing is kept of it.
        editor: what a press on a file's line opens: vscode, cursor, pycharm, none, or an address with {file} (an absolute
            path) and {line}. If the browser is on another machine than the file, VS Code opens it over ssh with
            vscode://vscode-remote/ssh-remote+HOST{file}:{line}, where HOST is the machine as your ssh config names it.
        pictures: of the cameras, as the page shows them: exact; fast, of simplified meshes; or auto, which is fast while
            something moves and exact when it stands still. Observations and recordings are exact.
        debug: let a debugger (debugpy, as of VS Code) attach to the task's process, from this machine only; breakpoint()
            stops for it. Anyone who can log in to this machine can attach too.
        debug_port: port for the debugger; 5678 if it is free, else any. Means --debug.
        debug_wait: load the task only when a debugger has attached. Means --debug.
    """
    if _lacks_maniskill("open"):
        return Exit.REFUSED
    from workbench.authoring.loading.reference import why_missing

    if (why := why_missing(task)) is not None:
        return refuse(why)
    from workbench.cli.page import open_in_terminal
    from workbench.machine.processes.debugger import port_for_debugger
    from workbench.session.process.memory_limit import parse_memory
    from workbench.session.process.supervisor import WorkerOptions
    from workbench.ui.server.gated_server import ServerOptions
    from workbench.ui.widgets.editor import parse_editor

    try:
        options = envs.options()
        past = history_bytes(history)
        debug = debug or debug_wait or debug_port is not None
        if debug and page.socket is not None:
            raise ValueError(
                "--debug opens a port that every user of this machine can connect to, which --socket is there to avoid: "
                "leave one of them out"
            )
        at_port = port_for_debugger(debug_port) if debug else None
        worker = WorkerOptions(parse_memory(memory_limit), spare, at_port, debug_wait)
        at = ServerOptions(**vars(page))
        address = parse_editor(editor)
    except ValueError as error:
        return refuse(str(error))
    return open_in_terminal(task, options, at, worker, recordings, past, trust, address, pictures)


@app.command
def new(
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = "",
    /,
    *,
    origin: Annotated[str, tyro.conf.arg(name="from", metavar="TEMPLATE")] = "",
) -> int:
    """Write NAME.py into this folder: a task that opens and passes its checks, to go on from. Asks for what is not given.

    Args:
        name: of the file, such as stack_two, whose class is StackTwoEnv and whose id is StackTwo-v1.
        origin: minimal (also if not given), tabletop, articulated, multi-robot, locomotion, or the id of a task of ManiSkill, such as PickCube-v1, which is copied.
    """
    from workbench.cli.new import new_in_terminal

    return new_in_terminal(name, origin)


@app.command
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
    if _lacks_maniskill("record"):
        return Exit.REFUSED
    from workbench.authoring.loading.reference import why_missing

    if (why := why_missing(recording.task)) is not None:
        return refuse(why)
    use_private_driver()
    with quick_imports():
        from workbench.cli.jobs.record import record_in_terminal
        from workbench.cli.jobs.run_by import require_job
        from workbench.jobs.record.episodes import RecordOptions
        from workbench.machine.processes.debugger import debug_here

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


@app.command
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
    if _lacks_maniskill("check"):
        return Exit.REFUSED
    from workbench.authoring.loading.reference import why_missing

    # A report is to say it too.
    reports = json or any(file is not None for file in (json_file, junit, sarif))
    if (why := why_missing(task)) is not None and not reports:
        return refuse(why)
    from workbench.checks.rules import degree_of_each

    try:
        options = envs.options()
        # Before torch is imported: a typo is answered at once.
        degree_of_each(separated(select), separated(ignore))
    except ValueError as error:
        return refuse(str(error))
    if (why := _without_folder(json_file, junit, sarif)) is not None:
        return refuse(why)
    if options.env_kwargs.get("render_backend") != "none":
        use_private_driver()
    with quick_imports():
        from workbench.cli.jobs.check import CheckOutput, check_in_terminal
        from workbench.cli.jobs.run_by import require_job
        from workbench.jobs.check import CheckOptions

    try:
        require_job(run)
    except ValueError as error:
        return refuse(str(error))
    rules = separated(select), separated(ignore)
    what = CheckOptions(task, options, envs.seeds, *rules, actions, solve=solve)
    return check_in_terminal(what, CheckOutput(json, json_file, junit, sarif, fail_on), began, run)


@app.command
def solve(
    task: Task,
    /,
    *,
    plan: PlanArguments = _PLAN,
    run: JobArguments = _HERE,
    seeds: int = 32,
    seed: int = 0,
    max_steps: int | None = None,
    seconds_per_seed: float | None = None,
    pictures: bool = False,
    out: Path = Path("recordings"),
    upload: str = "",
    imports: Imports = (),
    env: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
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
        seed: the first of them; each further one counts up.
        max_steps: longest episode; else the task's own limit, or 200 steps where it has none.
        seconds_per_seed: wall time after which a seed ends at its next step, solved or not. What that cuts off depends on
            the machine and on what else it does, so that a second run may come to another result.
        pictures: record what every camera sees.
        out: folder for the recordings.
        upload: an address of fsspec, such as s3://bucket/folder: each episode goes there when it is over, and not into
            the folder.
        imports: a module that registers the task's id, such as lab.tasks, imported in the process that runs the task;
            repeatable.
        env: further arguments of the task class, as name=value (value in JSON, or text), such as
            control_mode=pd_ee_delta_pose; repeatable.
        fail_on: lowest degree of a broken rule that makes the exit code 1, as of workbench check; the rules of the reward
            are of the degree warn. never: nor does it where no seed is solved.
        json: print the result as JSON in place of text.
        json_file: also write the result to this file, as JSON.
        csv: print a row for each seed as CSV in place of text, with the rules that it is an example of; what is said of
            them is in the JSON.
        csv_file: also write the rows to this file, as CSV.
        junit: also write the result to this file as JUnit's XML.
    """
    if _lacks_maniskill("solve"):
        return Exit.REFUSED
    from workbench.authoring.loading.reference import why_missing

    if (why := why_missing(task)) is not None:
        return refuse(why)
    if json and csv:
        return refuse(
            "--json and --csv both print the result: give one of them, and --json-file or --csv-file"
        )
    if (why := _without_folder(json_file, csv_file, junit)) is not None:
        return refuse(why)
    try:
        options = EpisodeArguments(1, "auto", None, imports, seed, env).options()
        planned = plan_options(plan)
        for name, number in (("seeds", seeds), ("workers", run.workers), ("max-steps", max_steps)):
            if number is not None and number < 1:
                raise ValueError(f"--{name} must be at least 1, not {number}")
    except ValueError as error:
        return refuse(str(error))
    if pictures and options.env_kwargs.get("render_backend") != "none":
        use_private_driver()
    with quick_imports():
        from workbench.cli.jobs.solve import SolveOutput, solve_in_terminal
        from workbench.jobs.record.solve import SolveOptions

    what = SolveOptions(
        task, out, seeds, 1, pictures, max_steps, planned, options, seconds_per_seed, upload=upload
    )
    return solve_in_terminal(what, SolveOutput(json, json_file, csv, csv_file, junit, fail_on), run)


@app.command
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
    if _lacks_maniskill("sweep"):
        return Exit.REFUSED
    from workbench.authoring.loading.reference import split_reference, why_missing

    if (why := why_missing(task)) is not None:
        return refuse(why)
    if (why := _without_folder(json_file, csv_file)) is not None:
        return refuse(why)
    if pictures:
        use_private_driver()
    with quick_imports():
        from workbench.cli.jobs.run_by import require_job
        from workbench.cli.jobs.sweep import SweepOutput, parse_settings, sweep_in_terminal
        from workbench.jobs.record.sweep import SweepOptions

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


@app.command
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
    if (why := _without_folder(json_file, csv_file, junit, sarif)) is not None:
        return refuse(why)
    with quick_imports():
        from workbench.cli.jobs.merge import MergeOutput, merge_in_terminal

    return merge_in_terminal(files, job, out, MergeOutput(json_file, csv_file, junit, sarif, fail_on))


@app.command
def review(
    folder: Annotated[Path, tyro.conf.Positional] = Path("recordings"),
    /,
    *,
    page: PageArguments,
    rules: Rules = None,
    task: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = (),
    imports: Imports = (),
    trust: bool = False,
    editor: str = "vscode",
) -> int:
    """Look through a folder of recordings in a browser page: play, compare, share. No task file is needed.

    Args:
        folder: where the recordings are, in folders below it too: .rrd, .h5 and .json of the workbench, and .h5
            with .json of ManiSkill's RecordEpisode.
        rules: what happens where a task that is opened from here breaks a rule of GPU simulation: stop, warn, or off
            to check none. If not given, what writes over the state of other envs stops, all else is a warning.
        task: a task file in which the envs of ManiSkill's recordings may be found; repeatable. Envs that ManiSkill
            itself has need none.
        imports: a module that registers ids that recordings name, such as lab.tasks, imported in the processes that
            run their tasks; repeatable.
        trust: run what recordings from elsewhere name or hold without asking, in this run; nothing is kept of it.
        editor: what a press on a file's line opens: vscode, cursor, pycharm, none, or an address with {file} and {line};
            see workbench open --help.
    """
    if not folder.is_dir():
        return refuse(f"there is no folder {folder}; workbench record and the page's Episodes tab make one")
    for file in task:
        if not file.is_file():
            return refuse(f"there is no file {file}")
    from workbench.recording.reader.reading import start_reading

    # Meanwhile the page is imported.
    start_reading()
    from workbench.cli.page import review_in_terminal
    from workbench.jobs.task import TaskOptions
    from workbench.session.process.memory_limit import parse_memory
    from workbench.session.process.supervisor import WorkerOptions
    from workbench.ui.server.gated_server import ServerOptions
    from workbench.ui.widgets.editor import parse_editor

    try:
        at = ServerOptions(**vars(page))
        base = TaskOptions(rules=rules, imports=imported(imports))
        address = parse_editor(editor)
    except ValueError as error:
        return refuse(str(error))
    return review_in_terminal(folder, task, at, WorkerOptions(parse_memory("auto")), base, trust, address)


@app.command
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
    if _lacks_maniskill("rescore"):
        return Exit.REFUSED
    with quick_imports():
        from workbench.cli.jobs.rescore import RescoreOptions, RescoreOutput, rescore_in_terminal
        from workbench.cli.jobs.run_by import require_job

    if task is not None and recorded_source:
        return refuse("--task and --recorded-source name two versions to rescore with: give one of them")
    if csv and json:
        return refuse(
            "--csv and --json both print the table: give one of them, and --csv-file or --json-file"
        )
    if (why := _without_folder(csv_file, json_file)) is not None:
        return refuse(why)
    try:
        base = envs.options()
        require_job(run)
    except ValueError as error:
        return refuse(str(error))
    use_private_driver()
    what = RescoreOptions(places, task, recorded_source, use_env_states, envs.envs_per_worker, base)
    return rescore_in_terminal(what, RescoreOutput(csv, csv_file, json, json_file), trust, run)


@app.command
def share(
    files: Annotated[tuple[Path, ...], tyro.conf.Positional],
    /,
    mp4: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    html: bool = False,
    sheet: bool = False,
    out: Path = Path("."),
) -> int:
    """Make films, moving 3-D pages and sheets of pictures of recordings.

    Args:
        files: recordings, or folders of them.
        mp4: a film of the camera of this name, of "scene" (the 3-D view), or of "cameras" (each of them); repeatable.
        html: the moving 3-D view as one HTML file that needs no server and no network.
        sheet: what each camera saw over time, on one picture.
        out: folder for what is made; nothing that is there is written over.
    """
    from workbench.cli.share import share_in_terminal

    use_private_driver()
    return share_in_terminal(files, mp4, html, sheet, out)


@app.command
def export(
    files: Annotated[tuple[Path, ...], tyro.conf.Positional],
    /,
    lerobot: Path | None = None,
    maniskill: Path | None = None,
    only_successes: bool = False,
    only_fitting: bool = False,
    task: str | None = None,
    fps: int | None = None,
    cameras: tuple[str, ...] | None = None,
    state: tuple[str, ...] = (),
    environment_state: tuple[str, ...] = (),
) -> int:
    """Make a dataset for training of recordings.

    Args:
        files: recordings, or folders of them.
        lerobot: folder that becomes a LeRobot dataset (version 3); must not exist yet.
        maniskill: file (.h5) that becomes ManiSkill's demonstrations, with its .json, as its baselines load them; must not
            exist yet. Of the other options it takes --only-successes and --only-fitting.
        only_successes: leave out recordings that reach success at no step.
        only_fitting: leave out recordings that cannot be read, or lack what the first one has (cameras, dimensions), and
            say which; else such a one ends it.
        task: the task in words, for policies that read; else its id.
        fps: frames a second, of which the control rate is a whole multiple; else the control rate.
        cameras: names of cameras; else all. Give none (--cameras) for a dataset without films.
        state: observations that become observation.state, such as agent/qpos; else all that the robot knows of itself.
        environment_state: observations that become observation.environment_state, such as extra; else none.
    """
    if (lerobot is None) == (maniskill is None):
        return refuse("say what to make: --lerobot FOLDER or --maniskill FILE.h5, one of them")
    if fps is not None and fps < 1:
        return refuse(f"--fps must be 1 or more, not {fps}")
    if lerobot is None:
        from workbench.cli.share import demonstrations_in_terminal

        assert maniskill is not None
        return demonstrations_in_terminal(files, maniskill, only_successes, only_fitting)
    from workbench.cli.share import export_in_terminal
    from workbench.recording.lerobot.export import ExportOptions
    from workbench.recording.lerobot.format import Choice

    choice = Choice(state, environment_state, cameras)
    return export_in_terminal(files, lerobot, ExportOptions(choice, only_successes, only_fitting, task, fps))


@app.command
def view(
    files: Annotated[tuple[Path, ...], tyro.conf.Positional],
    /,
    web: bool = False,
    host: str = "127.0.0.1",
    port: int = 0,
) -> int:
    """Open recordings in rerun's own viewer: a window, or a page where there is no screen.

    Args:
        files: one or more .rrd files.
        web: a page, also where there is a screen; it contacts only this program.
        host: address to serve the page on.
        port: port of the page; 0 takes any free one.
    """
    from workbench.cli.share import view_in_terminal

    return view_in_terminal(files, web, host, port)


@app.command
def doctor() -> int:
    """Say what this machine can do, and for each lack what to do about it."""
    from workbench.machine.doctor import main

    return main()


@app.command(name="help")
def show_help(topic: Annotated[str, tyro.conf.Positional] = "", /) -> int:
    """Show a page of the documents, or list the topics.

    Args:
        topic: name of the page, such as cameras; without one, all are listed.
    """
    from workbench.cli import help

    return help.show_help(topic)


def _without_folder(*files: Path | None) -> str | None:
    """Make the folders of these files. Returns why one of the files cannot be written; None if each can."""
    for file in files:
        if file is None:
            continue
        folder = file.resolve().parent
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            return f"{file} cannot be written: the folder {folder} cannot be made ({error.strerror})"
        if file.is_dir():
            return f"{file} is a folder: name a file in it"
        if not os.access(folder, os.W_OK):
            return f"{file} cannot be written: you may not write into {folder}"
    return None


def _lacks_maniskill(command: str) -> bool:
    """Say what to type where the command cannot do its work for want of ManiSkill, and warn of two that are mixed."""
    lines = lines_if_lacking(f"workbench {command}", sys.argv[1:])
    for line in lines or ():
        refuse(line)
    for line in lines_if_mixed() or ():
        warn(line)
    return lines is not None


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of the ``workbench`` command."""
    guard_terminal()
    given = list(sys.argv[1:] if args is None else args)
    if not given or (given[0].startswith("-") and given[0] not in ("-h", "--help")):
        given = ["start", *given]
    try:
        code: Any = app.cli(
            prog="workbench",
            description="Workbench: write ManiSkill tasks in front of a live, batched view of them. Without a command it "
            "opens a page to choose a task from.",
            args=given,
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone),
        )
    except KeyboardInterrupt:  # during the imports of a command: torch takes seconds
        code = interrupted()
    except ImportError:
        # A package that is older than the range lacks what is imported of it.
        from workbench.machine.versions import unmet_lines

        if (unmet := unmet_lines()) is None:
            raise
        for line in unmet:
            code = refuse(line)
    sys.exit(code)


if __name__ == "__main__":
    main()

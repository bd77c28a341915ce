"""The commands of ``workbench`` and their arguments."""

from __future__ import annotations

# Imported first: a file in the current folder could shadow a module that is imported below.
import workbench.machine.processes.own_path  # noqa: F401

# isort: split
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from workbench.cli import job_commands as jobs
from workbench.cli.arguments import (
    EnvArguments,
    Imports,
    PageArguments,
    Rules,
    Task,
    history_bytes,
    imported,
    with_new_names,
)
from workbench.cli.output import Exit, end_quietly, interrupted, lacks_maniskill, refuse, warn
from workbench.machine.processes.time_limit import end_after, end_limit
from workbench.machine.software_vulkan import use_private_driver
from workbench.machine.text import guard_terminal
from workbench.task.description import ShownPictures

app = tyro.extras.SubcommandApp()
# Commands import lazily, so that ``--help`` and errors in options appear at once.


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
    """Open a page for choosing a task: recent ones, the files of this folder, ManiSkill's tasks. The default command:
    workbench --port 8081 is the same as workbench start --port 8081.

    Args:
        recordings: folder for recorded episodes.
        history: memory limit for step history, such as 64MB or 2GB; the oldest steps are dropped first.
        memory_limit: memory limit of the task's process, such as 8GB; auto is 80 % of this machine's memory, none
            is no limit. A process that exceeds it is killed and restarted.
        spare: keep a spare process that takes over when the task's process dies (--no-spare: recovery takes a few
            seconds longer, and about 0.8 GB of memory is saved).
        trust: run task files from other folders, and code referenced by or embedded in foreign recordings, without
            asking. Applies to this run only.
        editor: what a click on a file's line opens: vscode, cursor, pycharm, none, or an address with {file} and {line};
            see workbench open --help.
    """
    from workbench.cli.page import start_in_terminal
    from workbench.live.process.memory_limit import parse_memory
    from workbench.live.process.supervisor import WorkerOptions
    from workbench.page.door.gated_server import ServerOptions
    from workbench.page.widgets.editor_links import parse_editor

    try:
        options = envs.options()
        past = history_bytes(history)
        worker = WorkerOptions(parse_memory(memory_limit), spare)
        at = ServerOptions(**vars(page))
        address = parse_editor(editor)
    except ValueError as error:
        return refuse(str(error))
    # The result is ignored: recordings can be reviewed without ManiSkill.
    lacks_maniskill("start")
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
        history: memory limit for step history, such as 64MB or 2GB; the oldest steps are dropped first.
        memory_limit: memory limit of the task's process, such as 8GB; auto is 80 % of this machine's memory, none
            is no limit. A process that exceeds it is killed and restarted.
        spare: keep a spare process that takes over when the task's process dies (--no-spare: recovery takes a few
            seconds longer, and about 0.8 GB of memory is saved).
        trust: run code referenced by or embedded in foreign recordings without asking. Applies to this run only.
        editor: what a click on a file's line opens: vscode, cursor, pycharm, none, or an address with {file} (an absolute
            path) and {line}. If the browser is on another machine than the file, VS Code opens it over ssh with
            vscode://vscode-remote/ssh-remote+HOST{file}:{line}, where HOST is the machine as your ssh config names it.
        pictures: how the page renders camera pictures: exact; fast, with simplified meshes; or auto, which is fast during
            motion and exact at rest. Observations and recordings are always exact.
        debug: let a debugger (debugpy, such as VS Code's) attach to the task's process, from this machine only; breakpoint()
            stops in the debugger. Anyone who can log in to this machine can attach too.
        debug_port: port for the debugger; 5678 if it is free, else any. Implies --debug.
        debug_wait: wait for a debugger to attach before the task is loaded. Implies --debug.
    """
    if lacks_maniskill("open"):
        return Exit.REFUSED
    from workbench.task.reference import why_missing

    if (why := why_missing(task)) is not None:
        return refuse(why)
    from workbench.cli.page import open_in_terminal
    from workbench.live.process.memory_limit import parse_memory
    from workbench.live.process.supervisor import WorkerOptions
    from workbench.machine.processes.debugger import port_for_debugger
    from workbench.page.door.gated_server import ServerOptions
    from workbench.page.widgets.editor_links import parse_editor

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
    """Write NAME.py into this folder: a starting task that opens and passes its checks. Asks for missing
    arguments.

    Args:
        name: name of the file, such as stack_two; its class is StackTwoEnv and its id StackTwo-v1.
        origin: minimal (default), tabletop, articulated, multi-robot, locomotion, or the id of a ManiSkill task to copy, such as PickCube-v1.
    """
    from workbench.cli.new import new_in_terminal

    return new_in_terminal(name, origin)


for _command in (jobs.record, jobs.check, jobs.solve, jobs.sweep, jobs.merge):
    app.command(_command)


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
    """Play, compare and share a folder of recordings in a browser page. No task file is needed.

    Args:
        folder: folder of the recordings, searched recursively: .rrd, .h5 and .json of the workbench, and .h5
            with .json of ManiSkill's RecordEpisode.
        rules: what happens when a task opened from here breaks a rule of GPU simulation: stop, warn, or off
            (no checks). By default, a breach that makes every later number wrong stops the task; others warn.
        task: a task file to search for the envs of ManiSkill's recordings; repeatable. Not needed for ManiSkill's
            own envs.
        imports: a module that registers the env ids of the recordings, such as lab.tasks, imported in the processes
            that run their tasks; repeatable.
        trust: run code referenced by or embedded in foreign recordings without asking. Applies to this run only.
        editor: what a click on a file's line opens: vscode, cursor, pycharm, none, or an address with {file} and {line};
            see workbench open --help.
    """
    if not folder.is_dir():
        return refuse(f"there is no folder {folder}; workbench record and the page's Episodes tab create it")
    for file in task:
        if not file.is_file():
            return refuse(f"there is no file {file}")
    from workbench.episodes.reader.reading import start_reading

    # The processes that read recordings get ready while the modules of the page are imported.
    start_reading()
    from workbench.cli.page import review_in_terminal
    from workbench.live.process.memory_limit import parse_memory
    from workbench.live.process.supervisor import WorkerOptions
    from workbench.page.door.gated_server import ServerOptions
    from workbench.page.widgets.editor_links import parse_editor
    from workbench.task.description import TaskOptions

    try:
        at = ServerOptions(**vars(page))
        base = TaskOptions(rules=rules, imports=imported(imports))
        address = parse_editor(editor)
    except ValueError as error:
        return refuse(str(error))
    return review_in_terminal(folder, task, at, WorkerOptions(parse_memory("auto")), base, trust, address)


app.command(jobs.rescore)


@app.command
def share(
    files: Annotated[tuple[Path, ...], tyro.conf.Positional],
    /,
    mp4: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    html: bool = False,
    sheet: bool = False,
    out: Path = Path("."),
) -> int:
    """Make films, animated 3-D pages and sheets of pictures from recordings.

    Args:
        files: recordings, or folders of them.
        mp4: make a film of the camera with this name; "scene" films the 3-D view, and "cameras" makes one
            film of each camera; repeatable.
        html: the animated 3-D view as one HTML file that needs no server and no network.
        sheet: frames of each camera over time, in one picture.
        out: folder for the results; existing files are not overwritten.
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
    """Convert recordings to a training dataset.

    Args:
        files: recordings, or folders of them.
        lerobot: new folder for a LeRobot dataset (version 3); must not exist yet.
        maniskill: new file (.h5, with a .json) of ManiSkill demonstrations, as its baselines load them; must not exist
            yet. Of the other options, only --only-successes and --only-fitting apply.
        only_successes: leave out recordings that never reach success.
        only_fitting: leave out recordings that cannot be read or lack data that the first
            recording has (cameras, dimensions), and print their names. Without this
            option, such a recording ends the export.
        task: the task in words, for language-conditioned policies; default: its id.
        fps: frames per second; the control rate must be a whole multiple of it. Default: the control rate.
        cameras: names of cameras; default: all. --cameras without a name makes a dataset without films.
        state: observations that become observation.state, such as agent/qpos; default: the robot's whole proprioception.
        environment_state: observations that become observation.environment_state, such as extra; default: none.
    """
    if (lerobot is None) == (maniskill is None):
        return refuse("say what to make: give either --lerobot FOLDER or --maniskill FILE.h5")
    if fps is not None and fps < 1:
        return refuse(f"--fps must be 1 or more, not {fps}")
    if lerobot is None:
        from workbench.cli.share import demonstrations_in_terminal

        assert maniskill is not None
        return demonstrations_in_terminal(files, maniskill, only_successes, only_fitting)
    from workbench.cli.share import export_in_terminal
    from workbench.episodes.lerobot.export import ExportOptions
    from workbench.episodes.lerobot.format import Choice

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
    """Open recordings in rerun's own viewer: in a window, or in a page if there is no display.

    Args:
        files: one or more .rrd files.
        web: use a page even if there is a display; the page contacts only this program.
        host: address to serve the page on.
        port: port of the page; 0 picks a free one.
    """
    from workbench.cli.share import view_in_terminal

    return view_in_terminal(files, web, host, port)


@app.command
def doctor() -> int:
    """Show what this machine can do, and how to fix what is missing."""
    from workbench.machine.doctor import main

    return main()


@app.command(name="help")
def show_help(topic: Annotated[str, tyro.conf.Positional] = "", /) -> int:
    """Show a page of the documentation, or list the topics.

    Args:
        topic: name of the page, such as cameras; default: list all.
    """
    from workbench.cli import help

    return help.show_help(topic)


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of the ``workbench`` command."""
    guard_terminal()
    end_after()
    given = list(sys.argv[1:] if args is None else args)
    given, renamed = with_new_names(given)
    for sentence in renamed:
        warn(sentence)
    if not given or (given[0].startswith("-") and given[0] not in ("-h", "--help")):
        given = ["start", *given]
    try:
        try:
            code: Any = app.cli(
                prog="workbench",
                description="Workbench: write ManiSkill tasks with a live, batched view of them. Without a command it "
                "opens a page to choose a task from.",
                args=given,
                config=(tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone),
            )
        finally:
            end_limit()
            if sys.stdout is not None:
                sys.stdout.flush()
    except KeyboardInterrupt:  # during the imports of a command: torch takes seconds
        code = interrupted()
    except BrokenPipeError:  # ``workbench open --help | head``
        code = end_quietly()
    except ImportError:
        # The cause may be an installed package that is too old to have the names that we import from it.
        from workbench.machine.versions import unmet_lines

        if (unmet := unmet_lines()) is None:
            raise
        for line in unmet:
            code = refuse(line)
    sys.exit(code)


if __name__ == "__main__":
    main()

"""The commands: ``workbench open``, ``workbench record``, ``workbench view``, ``workbench doctor``.

Only what a terminal needs lives here: arguments in, lines out, exit codes. Heavy imports wait until a
command is chosen, so that ``--help`` and a mistyped option answer at once.
"""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import tyro
from rich.console import Console
from rich.markup import escape

import workbench

if TYPE_CHECKING:
    from workbench.authoring.problem import Problem
    from workbench.session.kept_worker import WorkerOptions
    from workbench.session.messages import Event, TaskOptions
    from workbench.ui.door import Door
    from workbench.ui.put_together import Workplace

Task = Annotated[str, tyro.conf.Positional]
"""A task file, ``file.py:ClassName``, or a registered env id such as ``PickCube-v1``."""
Backend = Literal["auto", "cpu", "gpu"]

app = tyro.extras.SubcommandApp()
out = Console(highlight=False)
err = Console(stderr=True, highlight=False)


@app.command(name="open")
def open_page(
    task: Task,
    /,
    num_envs: int = 16,
    backend: Backend = "auto",
    seed: int = 0,
    host: str = "127.0.0.1",
    port: int = 8080,
    token: bool = True,
    recordings: Path = Path("recordings"),
    history: str = "256MB",
    memory_limit: str = "auto",
    spare: bool = True,
    env: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
) -> int:
    """Open a task in a browser page that follows its file.

    Args:
        task: a task file, file.py:ClassName, or a registered env id such as PickCube-v1.
        num_envs: environments to run at once.
        backend: cpu (batched), gpu (ManiSkill's GPU simulation), or auto (gpu if it works).
        seed: seed of the first reset; env i gets seed + i.
        host: address to listen on; anything but this machine's own needs the token.
        port: port of the page; 0 takes any free one.
        token: ask for the token of the printed address (--no-token: this machine only).
        recordings: folder for recorded episodes.
        history: memory that the steps of the past may take, such as 64MB or 2GB; the oldest go first.
        memory_limit: memory that the task's process may use, such as 8GB; auto is 80 % of this machine's, none
            sets no limit. A process that uses more is ended and replaced.
        spare: keep a second process ready to take over when the task's dies (--no-spare: it then takes some
            seconds more, and about 0.8 GB of memory less).
        env: further arguments of the task class, as name=value (value in JSON, or text); repeatable.
    """
    from workbench.authoring.reference import named_file
    from workbench.session.messages import Failed
    from workbench.ui.door import DoorError, DoorOptions, open_door

    file = named_file(task)
    if file is not None and not file.is_file():
        return _refuse(f"there is no file {file}")
    from workbench.session.kept_worker import WorkerOptions
    from workbench.session.memory_limit import parse_memory

    try:
        options = _task_options(num_envs, backend, seed, env)
        history_bytes = _bytes(history)
        worker = WorkerOptions(parse_memory(memory_limit), spare)
        door = open_door(DoorOptions(host=host, port=port, token=token), label="Workbench")
    except (ValueError, DoorError) as error:
        return _refuse(str(error))
    from workbench.session.session import Session
    from workbench.ui.put_together import Workplace
    from workbench.ui.share_part import Sharing

    _use_private_driver()
    for line in (door.warning, door.notice):
        if line:
            err.print(f"[yellow]{escape(line)}[/]")
    end = _End()

    def on_event(event: Event) -> None:
        _say(event)
        # A broken file is mended and saved; an env id that cannot be opened has nothing to wait for.
        if isinstance(event, Failed) and not event.kept and file is None:
            end.now(1)

    session = Session(
        task,
        options,
        recordings=recordings,
        history_bytes=history_bytes,
        worker=worker,
        on_event=on_event,
        on_line=_echo,
    )
    place = Workplace(door.server, recordings, session)
    sharing = Sharing(door)
    place.offer(sharing.offer)
    leave_recordings = _go_back_in(place, recordings, WorkerOptions(worker.memory_limit))
    end.at_signals()
    try:
        place.pages.start("live")
        _announce(door, f"{task}, {num_envs} envs")
        end.wait()
    finally:
        out.print("closing")
        place.close()
        sharing.close()
        leave_recordings()
        session.close()
        door.close()
    _leave(end.code)


@app.command
def record(
    task: Task,
    /,
    episodes: int | None = None,
    successes: int | None = None,
    tries: int | None = None,
    num_envs: int = 4,
    workers: int = 1,
    seed: int = 0,
    actions: str = "random",
    use_env_states: bool = False,
    out: Path = Path("recordings"),
    pictures: bool = True,
    max_steps: int | None = None,
    backend: Backend = "auto",
    env: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
) -> int:
    """Record episodes of a task without a page: for each an .rrd, and ManiSkill's own .h5 with its .json.

    Args:
        task: a task file, file.py:ClassName, or a registered env id such as PickCube-v1.
        episodes: how many, over all envs; 4, or as many as a file of actions has.
        successes: go on until so many episodes succeeded, and keep no others.
        tries: give up after so many episodes where successes are wanted; 100 for each.
        num_envs: environments to run at once, over all workers.
        workers: processes, each with its share of the envs; the episodes are the same with any number.
        seed: seed of the first episode; each further one counts up.
        actions: random, zero, hold; a policy as module:function or file.py:function; or a file: .npy or .npz with
            actions, or .h5 with ManiSkill's demonstrations, which begin from their own seeds.
        use_env_states: put every env state of a demonstration back after its step.
        out: folder for the files.
        pictures: record what every camera sees (--no-pictures is much faster).
        max_steps: longest episode; else the task's own limit.
        backend: cpu (batched), gpu (ManiSkill's GPU simulation), or auto (gpu if it works).
        env: further arguments of the task class, as name=value (value in JSON, or text); repeatable.
    """
    _use_private_driver()
    from workbench.record_command import record_in_terminal
    from workbench.session.record import RecordOptions

    try:
        options = _task_options(num_envs, backend, seed, env)
    except ValueError as error:
        return _refuse(str(error))
    what = RecordOptions(
        task, out, episodes, successes, tries, actions, use_env_states, pictures, max_steps, workers, options
    )
    return record_in_terminal(what, err, _print_problem, _refuse)


@app.command
def review(
    folder: Annotated[Path, tyro.conf.Positional] = Path("recordings"),
    /,
    host: str = "127.0.0.1",
    port: int = 8080,
    token: bool = True,
    task: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = (),
) -> int:
    """Look through a folder of recordings in a browser page: play, compare, share. No task file is needed.

    Args:
        folder: where the recordings are, in folders below it too: .rrd, .h5 and .json of the workbench, and .h5
            with .json of ManiSkill's RecordEpisode.
        host: address to listen on; anything but this machine's own needs the token.
        port: port of the page; 0 takes any free one.
        token: ask for the token of the printed address (--no-token: this machine only).
        task: a task file in which the envs of ManiSkill's recordings may be found; repeatable. Envs that ManiSkill
            itself has need none.
    """
    from workbench.ui.door import DoorError, DoorOptions, open_door

    if not folder.is_dir():
        return _refuse(f"there is no folder {folder}; workbench record and the page's Episodes tab make one")
    for file in task:
        if not file.is_file():
            return _refuse(f"there is no file {file}")
    try:
        door = open_door(DoorOptions(host=host, port=port, token=token), label="Recordings")
    except (ValueError, DoorError) as error:
        return _refuse(str(error))
    from workbench.session.kept_worker import WorkerOptions
    from workbench.session.memory_limit import parse_memory
    from workbench.ui.put_together import Workplace
    from workbench.ui.share_part import Sharing

    _use_private_driver()
    for line in (door.warning, door.notice):
        if line:
            err.print(f"[yellow]{escape(line)}[/]")
    end = _End()
    place = Workplace(door.server, folder, tasks=task)
    sharing = Sharing(door)
    place.offer(sharing.offer)
    leave_recordings = _go_back_in(place, folder, WorkerOptions(parse_memory("auto")))
    end.at_signals()
    try:
        place.pages.start("review")
        _announce(door, f"recordings in {folder}")
        end.wait()
    finally:
        out.print("closing")
        place.close()
        sharing.close()
        leave_recordings()
        door.close()
    _leave(end.code)


@app.command
def rescore(
    places: Annotated[tuple[Path, ...], tyro.conf.Positional],
    /,
    task: str | None = None,
    recorded_source: bool = False,
    use_env_states: bool = False,
    num_envs: int = 16,
    backend: Backend = "auto",
    csv: Path | None = None,
    json: Path | None = None,
) -> int:
    """Judge recorded episodes again with today's reward and evaluate, and say what is otherwise.

    Args:
        places: recordings (.json, .h5 or .rrd of the workbench, .h5 of ManiSkill's RecordEpisode) and folders of them.
        task: a task file, file.py:ClassName or id to judge all of them with, in place of the one each names.
        recorded_source: judge each by the text that it was recorded with.
        use_env_states: put every recorded state in after its step, so that nothing drifts from the record.
        num_envs: episodes to run at once.
        backend: cpu (batched), gpu (ManiSkill's GPU simulation), or auto (gpu if it works).
        csv: also write the table to this file, as CSV.
        json: also write the table to this file, as JSON.
    """
    from workbench.rescore_command import run_rescore

    if task is not None and recorded_source:
        return _refuse("--task and --recorded-source name two versions to judge with: give one of them")
    for table in (csv, json):
        if table is not None and not table.resolve().parent.is_dir():
            return _refuse(f"there is no folder {table.resolve().parent} to write {table.name} into")
    try:
        base = _task_options(num_envs, backend, 0, ())
    except ValueError as error:
        return _refuse(str(error))
    _use_private_driver()
    from workbench.authoring.problem import TaskError
    from workbench.session.rescore_all import RescoreOptions

    what = RescoreOptions(places, task, recorded_source, use_env_states, num_envs, base)
    try:
        return run_rescore(what, out, err, csv, json)
    except TaskError as error:
        _print_problem(error.problem)
        return 1
    except (OSError, ValueError) as error:
        return _refuse(str(error))
    except KeyboardInterrupt:
        return _refuse("interrupted")


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
    from workbench.share_command import share_in_terminal

    _use_private_driver()
    return share_in_terminal(files, mp4, html, sheet, out, err, _refuse)


@app.command
def export(
    files: Annotated[tuple[Path, ...], tyro.conf.Positional],
    /,
    lerobot: Path,
    only_successes: bool = False,
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
        only_successes: leave out recordings that reach success at no step.
        task: the task in words, for policies that read; else its id.
        fps: frames a second, of which the control rate is a whole multiple; else the control rate.
        cameras: names of cameras; else all. Give none (--cameras) for a dataset without films.
        state: observations that become observation.state, such as agent/qpos; else all that the robot knows of itself.
        environment_state: observations that become observation.environment_state, such as extra; else none.
    """
    from workbench.share_command import export_in_terminal

    return export_in_terminal(
        files, lerobot, only_successes, task, fps, cameras, state, environment_state, err, _refuse
    )


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
        web: a page, also where there is a screen; it asks nobody but this program.
        host: address to serve the page on.
        port: port of the page; 0 takes any free one.
    """
    from workbench.recording.viewer import has_screen, open_window, recordings_among

    try:
        if web or not has_screen(os.environ):
            return _view_in_page(recordings_among(files), host, port)
        viewer = open_window(files)
    except (OSError, ValueError, RuntimeError) as error:
        return _refuse(str(error))
    try:
        viewer.wait()
    except RuntimeError as error:
        return _refuse(str(error))
    except KeyboardInterrupt:
        print("closing", flush=True)
    finally:
        viewer.close()
    return 0


def _view_in_page(files: Sequence[Path], host: str, port: int) -> int:
    from workbench.recording.web_viewer import web_viewer_folder
    from workbench.ui.door import DoorOptions, open_door
    from workbench.ui.offers import Offers
    from workbench.ui.rerun_view import RerunPages

    web_viewer_folder()
    door = open_door(DoorOptions(host=host, port=port))
    try:
        address = RerunPages(door, Offers(door)).address(files)
        if door.warning:
            err.print(f"[yellow]{escape(door.warning)}[/]")
        print(f"  page    {door.address(address)}", flush=True)
        print(f"  remote  {door.ssh_hint}\n  Ctrl-C ends it.", flush=True)
        threading.Event().wait()
    except KeyboardInterrupt:
        print("closing", flush=True)
    finally:
        door.close()
    return 0


@app.command
def doctor() -> int:
    """Say what this machine can do, and for each lack what to do about it."""
    from workbench.machine.doctor import diagnose, exit_code, print_report

    findings = diagnose()
    print_report(findings)
    return exit_code(findings)


def main(args: Sequence[str] | None = None) -> None:
    """Entry of the ``workbench`` command."""
    try:
        code: Any = app.cli(
            prog="workbench",
            description="Workbench: write ManiSkill tasks in front of a live, batched view of them.",
            args=args,
        )
    except KeyboardInterrupt:  # in the seconds before a command listens for it: importing torch takes some
        code = _refuse("interrupted")
    sys.exit(code)


def _use_private_driver() -> None:
    """Let SAPIEN find the software driver that was unpacked for a user who may not install one."""
    from workbench.machine.software_vulkan import ensure_render_device

    os.environ.update(ensure_render_device(install=False).env)


def _go_back_in(place: Workplace, recordings: Path, worker: WorkerOptions) -> Callable[[], None]:
    """Let the review go on live, and judge again; returns what ends that."""
    from workbench.session.session import Session
    from workbench.ui.step_in import offer_going_back_in

    def open_task(task: str, options: TaskOptions) -> Session:
        return Session(task, options, recordings=recordings, worker=worker, on_event=_say, on_line=_echo)

    return offer_going_back_in(place, open_task)


class _End:
    """The end of a page: it comes from a signal or from an event, and with it the exit code."""

    def __init__(self) -> None:
        self.code = 0
        self._due = threading.Event()

    def now(self, code: int) -> None:
        self.code = code
        self._due.set()

    def at_signals(self) -> None:
        def on_signal(number: int, frame: FrameType | None) -> None:
            self._due.set()

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, on_signal)

    def wait(self) -> None:
        self._due.wait()


def _announce(door: Door, what: str) -> None:
    out.print(f"[bold]Workbench[/] {workbench.__version__}: {escape(what)}", soft_wrap=True)
    # Not through rich, which would break the address in a narrow terminal.
    print(f"  page    {door.url}", flush=True)
    print(f"  remote  {door.ssh_hint}", flush=True)
    print("  Ctrl-C ends it.", flush=True)


def _leave(code: int) -> NoReturn:
    """End the process; all must be closed and written."""
    # The interpreter would now take its modules apart, one object after the other: a second of waiting after
    # Ctrl-C, and several on a machine that is at work.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _task_options(num_envs: int, backend: Backend, seed: int, env: Sequence[str]) -> TaskOptions:
    from workbench.session.messages import TaskOptions

    if not 1 <= num_envs <= 4096:
        raise ValueError(f"--num-envs must be from 1 to 4096, not {num_envs}")
    if not 0 <= seed < 2**31:
        raise ValueError(f"--seed must be from 0 to {2**31 - 1}, not {seed}")
    return TaskOptions(num_envs, backend, seed, dict(_env_argument(pair) for pair in env))


def _env_argument(pair: str) -> tuple[str, Any]:
    name, equals, value = pair.partition("=")
    if not equals or not name.isidentifier():
        raise ValueError(f"--env takes name=value, as in --env robot_uids=fetch; got {pair!r}")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


def _bytes(text: str) -> int:
    """``256MB``, ``1.5 GB`` or a plain number, as bytes."""
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kmg]?)b?\s*", text, re.IGNORECASE)
    size = 0.0 if found is None else float(found[1]) * 1024 ** " kmg".index(found[2].lower() or " ")
    if not 1024**2 <= size <= 1024**4:
        raise ValueError(f"--history takes a size from 1MB on, such as 256MB or 2GB; got {text!r}")
    return int(size)


def _say(event: Event) -> None:
    """What the page shows of loads and failures, in the terminal as well."""
    from workbench.session.messages import Failed, Loaded

    if isinstance(event, Loaded):
        parts = ", ".join(f"{name} {ms:.0f}" for name, ms in event.milliseconds.items())
        total = sum(event.milliseconds.values())
        how = "loaded" if event.reload is None else event.reload.level
        why = "" if event.reload is None or not event.reload.reason else f": {escape(event.reload.reason)}"
        out.print(
            f"[green]{how}[/] {escape(event.task.env_id)}{why} in {total:.0f} ms [dim]({parts})[/]",
            soft_wrap=True,
        )
    elif isinstance(event, Failed):
        _print_problem(event.problem)
        if event.kept:
            back = "comes back where it was" if event.problem.stage == "worker" else "keeps running"
            err.print(f"[dim]the last good version {back}[/]")


def _echo(line: str) -> None:
    """What the author's code printed, told apart from the workbench's own lines."""
    print(f"  | {line}", flush=True)


def _print_problem(problem: Problem) -> None:
    place = "" if problem.file is None else f"{problem.file}:{problem.line or 1}: "
    err.print(
        f"[red]{escape(problem.stage)} failed[/] {escape(place)}{escape(problem.message)}", soft_wrap=True
    )
    if problem.code:
        err.print(f"    {escape(problem.code)}", soft_wrap=True)
    if problem.traceback:
        err.print(f"[dim]{escape(problem.traceback.rstrip())}[/]", soft_wrap=True)


def _refuse(message: str) -> int:
    err.print(f"[red]{escape(message)}[/]", soft_wrap=True)
    return 2


if __name__ == "__main__":
    main()

"""Time to the first picture of a new session and of a restarted worker.

    python tests/benchmarks/first_picture.py [--num-envs 4] [--rounds 3] [--no-parts] [--write]

A real session on the example task shows both cameras, as in `workbench open`, without a browser. The first round, which
warms the disk caches, is not counted. Workers are either forked from a process with all imports done, or import everything
themselves. Then the steps of a worker's start are run one by one in one process; their wall time and CPU time are printed
(CPU time is meaningful even on a busy machine).
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import psutil
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.benchmarks.session_times import seconds_until
from tests.benchmarks.table import Row, keep
from tests.drive.page import TASK
from workbench.app.session import Session
from workbench.live.commands import RestartWorker
from workbench.live.events import PagesCounted
from workbench.live.messages import CameraRequest
from workbench.live.process import worker_process
from workbench.live.process.fork_client import start_anew, worker_forks
from workbench.live.process.supervisor import WorkerOptions
from workbench.live.view import SessionView
from workbench.machine.processes.family import proportional_memory
from workbench.task.description import TaskOptions

WITHOUT_SPARE = "without a spare, s"
CAMERAS = (CameraRequest("base_camera", "sensor"), CameraRequest("render_camera", "human"))


@dataclass(frozen=True)
class Options:
    num_envs: int = 4
    rounds: int = 3
    parts: bool = True
    """Also measure the steps of a worker's start one by one."""
    write: bool = False
    """Write a row of the table of benchmarks."""


STARTS = {"forked": worker_forks.start, "anew": start_anew}
"""Two ways to start a worker: forked from a process with all imports done, or a new process that imports everything."""


def waits(options: Options) -> dict[str, dict[str, list[float]]]:
    """Measurements of all rounds for each way to start a worker, taken alternately."""
    found: dict[str, dict[str, list[float]]] = {way: {} for way in STARTS}
    for _ in range(options.rounds + 1):
        for way, start in STARTS.items():
            worker_forks.end()
            setattr(worker_process, "worker_forks", SimpleNamespace(start=start))  # noqa: B010
            for what, number in opened_and_restarted(options.num_envs):
                found[way].setdefault(what, []).append(number)
    return found


def opened_and_restarted(num_envs: int) -> Iterator[tuple[str, float]]:
    def after(reached: Callable[[SessionView], bool]) -> float:
        seconds_until(session, reached)
        return time.monotonic() - began

    with tempfile.TemporaryDirectory() as folder:
        began = time.monotonic()
        session = Session(
            str(TASK),
            TaskOptions(num_envs=num_envs),
            recordings=Path(folder),
            worker=WorkerOptions(spare=True),
        )
        try:
            session.change(cameras=CAMERAS)
            session.dispatch(PagesCounted(1))
            yield "the task's first moment, s", after(lambda view: view.timeline.moments == 1)
            yield "its first picture, s", after(lambda view: bool(view.pictures))
            yield "its first exact picture, s", after(is_exact)
            seconds_until(session, lambda view: view.vitals.spare_ready)
            yield "processor until then and until the spare is warm, s", processor()
            yield "memory of both, MB", memory()
            for restarted in ("a restarted worker's, with the spare warm, s", WITHOUT_SPARE):
                before = session.view()
                began = time.monotonic()
                session.do(RestartWorker())

                def drawn(view: SessionView, before: SessionView = before) -> bool:
                    again = view.task_serial > before.task_serial
                    return again and bool(view.pictures) and view.pictures is not before.pictures

                yield restarted, after(drawn)
        finally:
            session.close()


def is_exact(view: SessionView) -> bool:
    """Whether all pictures are exact. A paused page first gets a fast one, and a worker answers nothing while it renders."""
    return bool(view.pictures) and all(picture.degree == "exact" for picture in view.pictures.values())


def processor() -> float:
    """CPU seconds of all running child processes."""
    times = [child.cpu_times() for child in psutil.Process().children(recursive=True)]
    return sum(time.user + time.system for time in times)


def memory() -> float:
    """Memory of the same processes in MB; shared memory counts once."""
    return proportional_memory(child.pid for child in psutil.Process().children(recursive=True)) / 2**20


# --- parts ----------------------------------------------------------------------------------------------


@contextmanager
def part(name: str) -> Iterator[None]:
    wall, processor = time.perf_counter(), time.process_time()
    yield
    print(
        f"  {name:52s} {time.perf_counter() - wall:6.2f} {time.process_time() - processor:6.2f}", flush=True
    )


def parts(num_envs: int) -> None:
    from workbench.machine.processes.child_environment import quick_imports

    with quick_imports():
        with part("import torch"):
            import torch
        with part("import sapien"):
            import sapien.render
        with part("import mani_skill.envs, with its tasks"):
            import mani_skill.envs  # noqa: F401
        with part("import the worker"):
            import workbench.app.worker.main_loop  # noqa: F401
    torch.set_num_threads(1)
    from workbench.envs.scene.read_scene import read_geometry
    from workbench.envs.snapshots.snapshot import begin_anew
    from workbench.pictures.render import take_pictures
    from workbench.task.open import open_task

    with part("the render device"):
        sapien.render.RenderSystem(sapien.Device("cpu"))
    with part("open the task"):
        opened = open_task(str(TASK), TaskOptions(num_envs=num_envs))
    with part("begin anew, as a worker does"):
        begin_anew(opened.env.env, list(range(num_envs)))
    with part("its shapes for the page"):
        read_geometry(opened.env.env)
    for name, kind, modalities in CAMERAS:
        for degree in ("exact", "exact", "fast", "fast"):
            with part(f"picture of {name}, {degree}"):
                take_pictures(opened.env.env, 0, [(name, kind, modalities)], degree=degree)


def main(options: Options) -> None:
    found = waits(options)
    for what in found["forked"]:
        for way in STARTS:
            numbers = found[way][what][1:]
            each = ", ".join(f"{one:.2f}" for one in numbers)
            print(f"{what:52s} {way:7s} {statistics.median(numbers):8.2f} ({each})", flush=True)
    if options.write:
        what = f"Worker that is restarted without a spare: until its first picture, {options.num_envs} envs, forked, "
        what += "against one that imports for itself"
        forked, anew = (statistics.median(found[way][WITHOUT_SPARE][1:]) for way in STARTS)
        keep([Row(what, forked, anew, "s", "less", "first_picture.py")])
    if options.parts:
        print(f"parts of a worker's start: {'':27s}   wall    processor, s", flush=True)
        call = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import first_picture; first_picture.parts({options.num_envs})"
        for _ in range(2):
            subprocess.run([sys.executable, "-P", "-c", call], check=True)


if __name__ == "__main__":
    main(tyro.cli(Options))

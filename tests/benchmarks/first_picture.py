"""How long a person waits for the first picture: of a session that starts, and of a worker that is started again.

    python tests/benchmarks/first_picture.py [--num-envs 4] [--rounds 3] [--no-parts] [--write]

A real session on the example task with both its cameras looked through, as `workbench open` has it, without a browser. The
machine's disk caches are warm after the first round, which is left out. Once with workers that are forks of a process that has
done the imports, once with workers that import for themselves. Then what a worker does until then, one after the
other in one process: seconds of the wall, and of the processor, which count also on a busy machine.
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
from tests.benchmarks.table import Row, keep
from tests.drive.page import TASK
from workbench.app.session import Session
from workbench.live.commands import RestartWorker
from workbench.live.events import PagesCounted
from workbench.live.messages import CameraRequest
from workbench.live.process import worker_process
from workbench.live.process.supervisor import WorkerOptions
from workbench.live.process.worker_start import start_anew, worker_forks
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
    """Also what a worker does, one after the other."""
    write: bool = False
    """Keep a row in the table of benchmarks."""


def wait(session: Session, reached: Callable[[SessionView], bool], patience: float = 300.0) -> float:
    """Seconds until then."""
    began, seen = time.monotonic(), -1
    while time.monotonic() < began + patience:
        if reached(session.view()):
            return time.monotonic() - began
        seen = session.wait(seen, 0.5)
    raise SystemExit(f"it did not come within {patience:.0f} s")


WAYS = {"forked": worker_forks.start, "anew": start_anew}
"""Workers as forks of a process that has done the imports, and workers that import for themselves."""


def waits(options: Options) -> dict[str, dict[str, list[float]]]:
    """What each round found, of each way to start a worker, one after the other in turn."""
    found: dict[str, dict[str, list[float]]] = {way: {} for way in WAYS}
    for _ in range(options.rounds + 1):
        for way, start in WAYS.items():
            worker_forks.end()
            setattr(worker_process, "worker_forks", SimpleNamespace(start=start))  # noqa: B010
            for what, number in opened_and_restarted(options.num_envs):
                found[way].setdefault(what, []).append(number)
    return found


def opened_and_restarted(num_envs: int) -> Iterator[tuple[str, float]]:
    def after(reached: Callable[[SessionView], bool]) -> float:
        wait(session, reached)
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
            session.happen(PagesCounted(1))
            yield "the task's first moment, s", after(lambda view: view.timeline.moments == 1)
            yield "its first picture, s", after(lambda view: bool(view.pictures))
            yield "its first exact picture, s", after(is_exact)
            wait(session, lambda view: view.vitals.spare_ready)
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
    """Until then a page that stands still gets a fast one, and a worker that draws an exact one answers nothing."""
    return bool(view.pictures) and all(picture.degree == "exact" for picture in view.pictures.values())


def processor() -> float:
    """Seconds of all that this process started and that still runs."""
    times = [child.cpu_times() for child in psutil.Process().children(recursive=True)]
    return sum(time.user + time.system for time in times)


def memory() -> float:
    """Of the same, megabytes; what they share counts once."""
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
    from workbench.machine.processes.child_python import quick_imports

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
        for way in WAYS:
            numbers = found[way][what][1:]
            each = ", ".join(f"{one:.2f}" for one in numbers)
            print(f"{what:52s} {way:7s} {statistics.median(numbers):8.2f} ({each})", flush=True)
    if options.write:
        what = f"Worker that is restarted without a spare: until its first picture, {options.num_envs} envs, forked, "
        what += "against one that imports for itself"
        forked, anew = (statistics.median(found[way][WITHOUT_SPARE][1:]) for way in WAYS)
        keep([Row(what, forked, anew, "s", "less", "first_picture.py")])
    if options.parts:
        print(f"parts of a worker's start: {'':27s}   wall    processor, s", flush=True)
        call = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import first_picture; first_picture.parts({options.num_envs})"
        for _ in range(2):
            subprocess.run([sys.executable, "-P", "-c", call], check=True)


if __name__ == "__main__":
    main(tyro.cli(Options))

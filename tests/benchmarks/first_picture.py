"""How long a person waits for the first picture: of a session that starts, and of a worker that is started again.

    python tests/benchmarks/first_picture.py [--num-envs 4] [--rounds 3] [--no-parts]

A real session on the example task with both its cameras looked through, as `workbench open` has it, without a browser. The
machine's disk caches are warm after the first round, which is left out. Then what a worker does until then, one after the
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

import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.drive.page import TASK
from workbench.jobs.task import TaskOptions
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.session.process.supervisor import WorkerOptions
from workbench.session.protocol.messages import CameraRequest

CAMERAS = (CameraRequest("base_camera", "sensor"), CameraRequest("render_camera", "human"))


@dataclass(frozen=True)
class Options:
    num_envs: int = 4
    rounds: int = 3
    parts: bool = True
    """Also what a worker does, one after the other."""


def wait(session: Session, reached: Callable[[SessionView], bool], patience: float = 300.0) -> float:
    """Seconds until then."""
    began, seen = time.monotonic(), -1
    while time.monotonic() < began + patience:
        if reached(session.view()):
            return time.monotonic() - began
        seen = session.wait(seen, 0.5)
    raise SystemExit(f"it did not come within {patience:.0f} s")


def waits(options: Options) -> dict[str, list[float]]:
    """Seconds of each round."""
    found: dict[str, list[float]] = {}
    for _ in range(options.rounds + 1):
        with tempfile.TemporaryDirectory() as folder:
            began = time.monotonic()
            session = Session(
                str(TASK),
                TaskOptions(num_envs=options.num_envs),
                recordings=Path(folder),
                worker=WorkerOptions(spare=True),
            )
            try:
                session.change(cameras=CAMERAS)
                session.set_clients(1)
                wait(session, lambda view: view.timeline.moments == 1)
                found.setdefault("the task's first moment", []).append(time.monotonic() - began)
                wait(session, lambda view: bool(view.pictures))
                found.setdefault("its first picture", []).append(time.monotonic() - began)
                wait(session, lambda view: view.vitals.spare_ready)
                before = session.view().pictures
                began = time.monotonic()
                session.versions.restart_worker()
                wait(session, lambda view, old=before: bool(view.pictures) and view.pictures is not old)
                found.setdefault("a restarted worker's, with the spare warm", []).append(
                    time.monotonic() - began
                )
            finally:
                session.close()
    return found


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
            import workbench.session.worker.loop  # noqa: F401
    torch.set_num_threads(1)
    from workbench.core.cameras.render import take_pictures
    from workbench.core.scene.read_scene import read_geometry
    from workbench.jobs.open_task import open_task

    with part("the render device"):
        sapien.render.RenderSystem(sapien.Device("cpu"))
    with part("open the task"):
        opened = open_task(str(TASK), TaskOptions(num_envs=num_envs))
    with part("its shapes for the page"):
        read_geometry(opened.env.env)
    for name, kind, modalities in CAMERAS:
        for degree in ("exact", "exact", "fast", "fast"):
            with part(f"picture of {name}, {degree}"):
                take_pictures(opened.env.env, 0, [(name, kind, modalities)], degree=degree)


def main(options: Options) -> None:
    for what, seconds in waits(options).items():
        each = ", ".join(f"{one:.2f}" for one in seconds[1:])
        print(f"{what:45s} {statistics.median(seconds[1:]):6.2f} s ({each})", flush=True)
    if options.parts:
        print(f"parts of a worker's start: {'':27s}   wall    processor, s", flush=True)
        call = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import first_picture; first_picture.parts({options.num_envs})"
        for _ in range(2):
            subprocess.run([sys.executable, "-P", "-c", call], check=True)


if __name__ == "__main__":
    main(tyro.cli(Options))

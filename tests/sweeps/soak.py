"""Hundreds of reloads and dozens of worker deaths in one session: does anything grow or leak?

    python tests/sweeps/soak.py [--reloads 500] [--deaths 50] [--num-envs 4] [--no-spare]

Versions of `tests/live/hazards.py`'s task are saved in turn: one that only patches the envs, one with a syntax error, one
that rebuilds all envs, one that raises in ``evaluate``. In between the worker dies in one of several ways. After each
tenth a row prints the memory, threads, open files and child processes of the server and the worker. The last lines
print the server's growth from the first row to the last, and what was left at the end.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import psutil
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.live.hazards import calm, provoke, write_task
from workbench.app.session import Session
from workbench.live.commands import Step
from workbench.live.process.supervisor import WorkerOptions
from workbench.live.view import SessionView
from workbench.task.description import TaskOptions

DEATHS = ("segfault", "exit", "kill", "abort", "children")
TIMEOUT_SECONDS = 120.0


@dataclass(frozen=True)
class Options:
    reloads: int = 500
    deaths: int = 50
    num_envs: int = 4
    spare: bool = True


@dataclass(frozen=True)
class Resources:
    """Memory, threads, open files and child processes of a process."""

    megabytes: float
    threads: int
    files: int
    children: int

    @classmethod
    def of(cls, pid: int) -> Resources:
        process = psutil.Process(pid)
        memory = process.memory_info().rss / 2**20
        return cls(memory, process.num_threads(), process.num_fds(), len(process.children(recursive=True)))

    def __str__(self) -> str:
        return (
            f"{self.megabytes:.0f} MB, {self.threads} threads, {self.files} files, {self.children} children"
        )


def reach(session: Session, reached: Callable[[SessionView], bool], what: str) -> SessionView:
    deadline, serial = time.monotonic() + TIMEOUT_SECONDS, -1
    while time.monotonic() < deadline:
        view = session.view()
        if reached(view):
            return view
        serial = session.wait(serial, timeout=0.2)
    raise TimeoutError(
        f"{what} did not come within {TIMEOUT_SECONDS:.0f} s: {session.view().state}, {session.view().problem}"
    )


def save(session: Session, file: Path, good: str, number: int, levels: Counter[str]) -> None:
    """Save version `number` and wait until it is loaded, which `levels` counts, or refused."""
    before = session.view()
    if number % 4 == 1:
        file.write_text(good + f"\ndef broken(:  # {number}\n")
    elif number % 4 == 3:
        file.write_text(good.replace('hazard("evaluate")', f"raise KeyError({number})"))
    else:
        changed = good.replace(
            '{"success"', f'{{"version": self.cube.pose.p[:, 0] * 0 + {number - number % 4}, "success"'
        )
        scene = number if number % 4 == 2 else max(0, number - 2)  # the scene that is loaded
        changed = changed.replace("\nVERSION = 0\n", f"\nVERSION = {scene}\n")
        file.write_text(changed)
        view = reach(session, lambda v: v.task_serial > before.task_serial, f"version {number}")
        if view.reload is not None:
            levels[view.reload.level] += 1
        return
    reach(
        session, lambda v: v.problem is not None and v.problem_serial > before.problem_serial, "the problem"
    )


def die(session: Session, file: Path, number: int) -> float:
    """Let the worker die; return the seconds until its version runs again."""
    before = session.view()
    provoke(file, "evaluate", DEATHS[number % len(DEATHS)])
    session.do(Step())
    reach(session, lambda v: v.problem_serial > before.problem_serial, "the death")
    began = time.monotonic()
    calm(file)
    reach(session, lambda v: v.task_serial > before.task_serial, "the version's reload")
    return time.monotonic() - began


def main(options: Options) -> None:
    server = psutil.Process().pid
    with tempfile.TemporaryDirectory() as name:
        file = write_task(Path(name))
        good = file.read_text()
        session = Session(
            str(file),
            TaskOptions(num_envs=options.num_envs),
            recordings=Path(name) / "recordings",
            worker=WorkerOptions(spare=options.spare),
        )
        reach(session, lambda v: v.task is not None, "the first load")
        every = max(1, options.reloads // 10)
        per_death = max(1, options.reloads // max(1, options.deaths))
        rows: list[Resources] = []
        recovery_seconds: list[float] = []
        levels: Counter[str] = Counter()
        for number in range(options.reloads):
            save(session, file, good, number, levels)
            if number % per_death == per_death - 1 and len(recovery_seconds) < options.deaths:
                file.write_text(good)
                reach(session, lambda v: v.problem is None and not v.stale, "the good version")
                recovery_seconds.append(die(session, file, len(recovery_seconds)))
            if number % every == every - 1:
                rows.append(Resources.of(server))
                worker = "none" if session.worker_pid is None else Resources.of(session.worker_pid)
                print(
                    f"{number + 1} reloads, {len(recovery_seconds)} deaths | server {rows[-1]} | worker {worker}",
                    flush=True,
                )
        session.close()
    first, last, end = rows[0], rows[-1], Resources.of(server)
    print(
        f"server from the first row to the last: {last.megabytes - first.megabytes:+.0f} MB, "
        f"{last.threads - first.threads:+d} threads, {last.files - first.files:+d} files"
    )
    print(f"after the end: {end}; good reloads: {dict(levels)}")
    if recovery_seconds:
        print(
            f"recovery after a death: median {sorted(recovery_seconds)[len(recovery_seconds) // 2]:.2f} s, worst {max(recovery_seconds):.2f} s"
        )


if __name__ == "__main__":
    main(tyro.cli(Options))

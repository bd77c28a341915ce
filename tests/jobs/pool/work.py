"""What the processes of a pool do in tests: no task, and each way to go wrong."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from workbench.authoring.problem import Problem, TaskError
from workbench.jobs.pool.deal import ItemQueue

PROBLEM = Problem("step", "it broke", "task.py", 3, "1 / 0", "Traceback")


@dataclass(frozen=True)
class Setup:
    how: str = ""
    at: int = -1
    """The item with which that happens."""
    folder: Path = field(kw_only=True)


@dataclass(frozen=True)
class Squared:
    number: int
    square: float
    path: Path
    pid: int


def square(setup: Setup, queue: ItemQueue) -> None:
    """The items of a chunk one after another."""
    if setup.how == "cannot be loaded":
        raise TaskError(PROBLEM)
    queue.send_update(f"opened in {os.getpid()} on {','.join(map(str, sorted(os.sched_getaffinity(0))))}")
    while (chunk := queue.next()) is not None:
        for number in sorted(chunk.wanted):
            if number >= queue.limit():
                break
            if number == setup.at:
                go_wrong(setup, queue)
            queue.send_update(1)
            queue.send_result(number, Squared(number, number**2, setup.folder / str(number), os.getpid()))


def go_wrong(setup: Setup, queue: ItemQueue) -> None:
    if setup.how == "killed" or (setup.how == "killed once" and not (setup.folder / "killed").exists()):
        (setup.folder / "killed").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    elif setup.how == "left":
        os._exit(0)
    elif setup.how == "task":
        raise TaskError(PROBLEM)
    elif setup.how == "value":
        raise ValueError("not such a number")
    elif setup.how == "no UTF-8":
        raise FileNotFoundError("there is no " + os.fsdecode(b"caf\xe9"))
    elif setup.how == "bug":
        raise KeyError("nobody expects it")
    elif setup.how == "garbage":
        os.write(int(sys.argv[2]), b"\x00\x00\x00\x05hello")
    elif setup.how == "endless":
        os.write(int(sys.argv[2]), b"\x7f\xff\xff\xff")
    elif setup.how == "another type":
        queue.send_result(setup.at, "a text")
    elif setup.how == "no path":
        queue.send_result(setup.at, {"number": setup.at, "square": 1.0, "path": "text", "pid": 1})
    elif setup.how == "another's":
        queue.send_result(10**6, Squared(0, 0, Path(), 0))
    elif setup.how in ("hangs", "half a message"):
        if setup.how != "hangs":
            os.write(int(sys.argv[2]), b"\x00\x00\x00\x10hel")
        (setup.folder / "hangs").touch()
        while True:
            time.sleep(0.01)
    elif setup.how == "waits":
        (setup.folder / "waits").touch()
        while queue.limit() > setup.at:
            time.sleep(0.01)


def forget(setup: Setup, queue: ItemQueue) -> None:
    """Ends with an item that it says nothing of."""
    queue.next()

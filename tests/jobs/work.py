"""Work for the processes of a pool in tests: without a task, and with each way to fail."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from workbench.jobs.scheduler import Executor, Failure, ItemQueue, Scheduler, Work
from workbench.task.problem import Problem, TaskError

PROBLEM = Problem("step", "it broke", "task.py", 3, "1 / 0", "Traceback")
BEGUN = "begun-"
"""Prefix of a marker file per started item; the item's number follows."""


@dataclass(frozen=True)
class Setup:
    how: str = ""
    at: int = -1
    """The item at which the failure `how` happens."""
    folder: Path = field(kw_only=True)


@dataclass(frozen=True)
class Squared:
    number: int
    square: float
    path: Path
    pid: int


def square(setup: Setup, queue: ItemQueue) -> None:
    """Square the items of each chunk in order."""
    if setup.how == "cannot be loaded":
        raise TaskError(PROBLEM)
    queue.send_update(f"opened in {os.getpid()} on {','.join(map(str, sorted(os.sched_getaffinity(0))))}")
    while (chunk := queue.next()) is not None:
        for number in sorted(chunk.wanted):
            if number >= queue.limit():
                break
            (setup.folder / f"{BEGUN}{number}").touch()
            if number == setup.at:
                go_wrong(setup, queue)
            queue.send_update(1)
            queue.send_result(number, Squared(number, number**2, setup.folder / str(number), os.getpid()))


def go_wrong(setup: Setup, queue: ItemQueue) -> None:
    if setup.how == "killed" or (setup.how == "killed once" and not (setup.folder / "killed").exists()):
        (setup.folder / "killed").write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGKILL)
    elif setup.how == "task":
        raise TaskError(PROBLEM)
    elif setup.how == "no UTF-8":
        raise FileNotFoundError("there is no " + os.fsdecode(b"caf\xe9"))
    elif setup.how == "bug":
        raise KeyError("unexpected")
    elif setup.how == "garbage":
        os.write(int(sys.argv[2]), b"\x00\x00\x00\x05hello")
    elif setup.how == "another type":
        queue.send_result(setup.at, "a text")
    elif setup.how == "another's":
        queue.send_result(10**6, Squared(0, 0, Path(), 0))
    elif setup.how in ("hangs", "half a message"):
        if setup.how != "hangs":
            os.write(int(sys.argv[2]), b"\x00\x00\x00\x10hel")
        (setup.folder / "hangs").touch()
        while True:
            time.sleep(0.01)


class Run:
    """A job, with the results, updates and failures that it reported."""

    def __init__(
        self,
        setup: Setup,
        numbers: Iterable[int],
        stop: Callable[[], bool] = lambda: False,
        on_result: Callable[[Run, int], None] = lambda run, number: None,
        **how: Any,
    ) -> None:
        self.results: dict[int, Squared] = {}
        self.updates: list[str] = []
        self.failures: list[Failure] = []
        self.steps = 0
        self._on_result = on_result
        if how.pop("goes_on", False):
            how["on_failure"] = self.failures.append
        self.scheduler: Scheduler[Squared, str | int] = Scheduler(
            numbers, self.take_result, self.take_update, stop, **how
        )
        self.work = Work(square, setup, Squared, str | int, "that squares")

    def take_result(self, number: int, result: Squared) -> None:
        assert number not in self.results
        self.results[number] = result
        self._on_result(self, number)

    def take_update(self, update: str | int) -> None:
        if isinstance(update, int):
            self.steps += update
        else:
            self.updates.append(update)

    def run_with(self, executor: Executor) -> Run:
        executor.run(self.work, self.scheduler)
        return self

    def squares(self) -> dict[int, float]:
        return {number: result.square for number, result in self.results.items()}

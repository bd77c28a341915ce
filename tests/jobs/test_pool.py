"""Work over numbered items: the same results whoever does them, each of them once, and nothing lost without a word."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.drive.waiting import until
from tests.jobs import work
from tests.jobs.work import PROBLEM, Setup, Squared, square
from workbench.authoring.problem import TaskError
from workbench.jobs.pool import (
    Deal,
    Executor,
    ItemQueue,
    PoolError,
    Processes,
    ThisProcess,
    Work,
    envs_per_process,
)

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture(autouse=True)
def tests_can_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))


class Run:
    """A job, and what was heard of it."""

    def __init__(
        self,
        setups: Iterable[Setup],
        numbers: Iterable[int],
        stop: Callable[[], bool] = lambda: False,
        on_result: Callable[[Run, int], None] = lambda run, number: None,
        run: Callable[[Setup, ItemQueue], None] = square,
    ) -> None:
        self.results: dict[int, Squared] = {}
        self.updates: list[str] = []
        self.steps = 0
        self._on_result = on_result
        self.deal: Deal[Squared, str | int] = Deal(numbers, self.over, self.hear, stop)
        self.work = Work(run, list(setups), Squared, str | int, "that squares")

    def over(self, number: int, result: Squared) -> None:
        assert number not in self.results
        self.results[number] = result
        self._on_result(self, number)

    def hear(self, update: str | int) -> None:
        if isinstance(update, int):
            self.steps += update
        else:
            self.updates.append(update)

    def by(self, executor: Executor) -> Run:
        executor.run(self.work, self.deal)
        return self

    def squares(self) -> dict[int, float]:
        return {number: result.square for number, result in self.results.items()}


@pytest.mark.parametrize(("processes", "chunk"), [(0, 1), (1, 1), (3, 1), (2, 4)])
def test_each_item_is_done_once_with_the_same_result_whoever_does_it(
    processes: int, chunk: int, tmp_path: Path
) -> None:
    executor = Processes(chunk) if processes else ThisProcess()
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    folder.mkdir()
    numbers = [*range(10), 12, 20]
    done = Run([Setup(folder=folder)] * max(1, processes), numbers).by(executor)
    assert sorted(done.results) == numbers and done.steps == len(numbers)
    assert done.results[3] == Squared(3, 9, folder / "3", done.results[3].pid)
    # Each keeps what it has opened.
    assert len(done.updates) == max(1, processes)
    pids = {result.pid for result in done.results.values()}
    assert pids == {os.getpid()} if processes == 0 else os.getpid() not in pids
    assert not any(map(psutil.pid_exists, pids - {os.getpid()}))


def test_cores_and_envs_are_shared_out(tmp_path: Path) -> None:
    cores = sorted(os.sched_getaffinity(0))
    given = [
        line.rpartition(" ")[2].split(",")
        for line in Run([Setup(folder=tmp_path)] * 2, range(4)).by(Processes()).updates
    ]
    together = sorted(int(core) for one in given for core in one)
    assert together == (cores if len(cores) > 1 else 2 * cores)
    divided = [envs_per_process(5, 2), envs_per_process(2, 3), envs_per_process(6, 3)]
    assert divided == [[3, 2], [1, 1], [2, 2, 2]]


@pytest.mark.parametrize("executor", [ThisProcess(), Processes(), Processes(3)])
def test_what_is_not_wanted_any_more_is_left_out_and_all_before_it_is_done(
    executor: Executor, tmp_path: Path
) -> None:
    def enough(run: Run, number: int) -> None:
        if number == 5:
            run.deal.lower(8)

    setups = [Setup(folder=tmp_path)] if isinstance(executor, ThisProcess) else [Setup(folder=tmp_path)] * 2
    done = Run(setups, range(10**6), on_result=enough).by(executor)
    assert set(range(8)) <= set(done.results)
    # One that was begun meanwhile may come.
    assert len(done.results) < 100


def test_an_item_that_waits_for_others_is_dropped_when_it_is_not_wanted(tmp_path: Path) -> None:
    def enough(run: Run, number: int) -> None:
        if (tmp_path / "waits").exists():
            run.deal.lower(4)

    setups = [Setup("waits", 4, folder=tmp_path), Setup("waits", 4, folder=tmp_path)]
    done = Run(setups, range(10**6), on_result=enough).by(Processes())
    assert set(range(4)) <= set(done.results)


@pytest.mark.parametrize("executor", [ThisProcess(), Processes(2)])
def test_what_was_stopped_is_resumed_with_what_is_left(executor: Executor, tmp_path: Path) -> None:
    asked = False

    def now(run: Run, number: int) -> None:
        nonlocal asked
        asked = len(run.results) >= 5

    setups = [Setup(folder=tmp_path)] if isinstance(executor, ThisProcess) else [Setup(folder=tmp_path)] * 2
    first = Run(setups, range(400), stop=lambda: asked, on_result=now).by(executor)
    assert 5 <= len(first.results) < 400
    rest = Run(setups, [number for number in range(400) if number not in first.results]).by(executor)
    assert not first.results.keys() & rest.results.keys()
    assert first.squares() | rest.squares() == {number: number**2 for number in range(400)}


def fails(how: str, says: str, error: type[Exception] = PoolError) -> Any:
    return pytest.param(how, says, error, id=how)


@pytest.mark.parametrize(
    ("how", "says", "error"),
    [
        fails("killed", "a process that squares was killed by SIGKILL"),
        fails("left", "a process that squares ended with exit code 0"),
        fails("bug", "a process that squares ended with exit code 1"),
        fails("task", "it broke", TaskError),
        fails("value", "not such a number"),
        fails("no UTF-8", r"there is no .*caf\\udce9"),
        fails("garbage", "a process that squares sent what cannot be read"),
        fails("endless", "a process that squares sent what cannot be read"),
        fails("another type", "a process that squares sent what cannot be read"),
        fails("no path", "a process that squares sent what cannot be read"),
        fails("another's", "a process that squares sent the result of an item that it does not have"),
    ],
)
def test_a_process_that_fails_ends_the_job_and_the_others_finish_what_they_have(
    how: str, says: str, error: type[Exception], tmp_path: Path
) -> None:
    # The last that is dealt, so that the other process has all that is before it.
    run = Run([Setup(how, 7, folder=tmp_path)] * 2, range(8))
    with pytest.raises(error, match=says) as raised:
        run.by(Processes())
    if isinstance(raised.value, TaskError):
        assert raised.value.problem == PROBLEM
    assert {0, 1} <= set(run.results) <= set(range(7))
    assert not any(psutil.pid_exists(result.pid) for result in run.results.values())


@pytest.mark.parametrize("processes", [1, 2])
def test_a_task_that_cannot_be_loaded_is_said_once(processes: int, tmp_path: Path) -> None:
    run = Run([Setup("cannot be loaded", folder=tmp_path)] * processes, range(8))
    with pytest.raises(TaskError, match="it broke") as raised:
        run.by(Processes())
    assert raised.value.problem == PROBLEM and not run.results


def test_a_process_that_forgets_an_item_is_a_failure(tmp_path: Path) -> None:
    run = Run([Setup(folder=tmp_path)], range(8), run=work.forget)
    with pytest.raises(PoolError, match="ended before it was done"):
        run.by(Processes())


def test_who_does_not_want_to_wait_ends_processes_that_hang(tmp_path: Path) -> None:
    def twice() -> bool:
        if (tmp_path / "hangs").exists():
            raise KeyboardInterrupt  # as the second Ctrl-C does
        return False

    run = Run([Setup("hangs", 3, folder=tmp_path)] * 2, range(10**6), stop=twice)
    with pytest.raises(KeyboardInterrupt):
        run.by(Processes())
    pids = {int(line.split()[2]) for line in run.updates}
    assert len(pids) >= 1
    until(lambda: not any(map(psutil.pid_exists, pids)), "their end")


@pytest.mark.parametrize("how", ["hangs", "half a message"])
def test_a_process_that_does_not_stop_is_not_waited_for_for_ever(
    how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.jobs.pool._END_SECONDS", 0.2)
    run = Run([Setup(how, 0, folder=tmp_path)], range(8), stop=lambda: (tmp_path / "hangs").exists())
    with pytest.raises(PoolError, match="that squares did not end in time"):
        run.by(Processes())

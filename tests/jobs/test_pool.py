"""Work on numbered items: equal results on any executor, each item done once, and every loss reported."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.waiting import until
from tests.jobs.work import BEGUN, PROBLEM, Run, Setup, Squared
from workbench.jobs.local_processes import Processes
from workbench.jobs.scheduler import (
    MAX_ALIKE_FIRST,
    MAX_ALIKE_LATER,
    Chunk,
    Executor,
    Failure,
    PoolError,
    Scheduler,
    Shard,
    ThisProcess,
    by_kind,
    parse_shard,
)
from workbench.task.problem import Problem, TaskError


@pytest.fixture(autouse=True)
def tests_can_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))


EXECUTORS = [
    pytest.param(ThisProcess(), id="here"),
    pytest.param(Processes(1), id="one"),
    pytest.param(Processes(3), id="three"),
]
child_process = pytest.mark.usefixtures("child_process")


@child_process
@pytest.mark.parametrize("executor", EXECUTORS)
@pytest.mark.parametrize("chunk", [1, 4])
def test_each_item_is_done_once_with_equal_results_on_any_executor(
    executor: Executor, chunk: int, tmp_path: Path
) -> None:
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    folder.mkdir()
    numbers = [*range(10), 12, 20]
    done = Run(Setup(folder=folder), numbers, chunk=chunk).run_with(executor)
    assert sorted(done.results) == numbers and done.steps == len(numbers)
    assert done.results[3] == Squared(3, 9, folder / "3", done.results[3].pid)
    # Each worker opens its task only once.
    count = 3 if executor is EXECUTORS[2].values[0] else 1
    assert len(done.updates) == count
    # The processes share the cores: PhysX and the renderer start a thread for each core of a process.
    cores = sorted(os.sched_getaffinity(0))
    shares = [",".join(map(str, cores[place::count] or cores)) for place in range(count)]
    assert sorted(update.split()[-1] for update in done.updates) == sorted(shares)
    pids = {result.pid for result in done.results.values()}
    assert pids == {os.getpid()} if isinstance(executor, ThisProcess) else os.getpid() not in pids
    assert not any(map(psutil.pid_exists, pids - {os.getpid()}))


@child_process
@pytest.mark.parametrize("executor", EXECUTORS)
def test_items_above_a_lowered_limit_are_skipped_and_all_below_are_done(
    executor: Executor, tmp_path: Path
) -> None:
    def enough(run: Run, number: int) -> None:
        if number == 5:
            run.scheduler.lower(8)

    done = Run(Setup(folder=tmp_path), range(10**6), on_result=enough, chunk=3).run_with(executor)
    assert set(range(8)) <= set(done.results)
    # Items that were already started may still be finished.
    assert len(done.results) < 100


@child_process
@pytest.mark.parametrize("executor", EXECUTORS)
def test_a_stopped_job_is_resumed_with_the_remaining_items(executor: Executor, tmp_path: Path) -> None:
    asked = False

    def now(run: Run, number: int) -> None:
        nonlocal asked
        asked = len(run.results) >= 5

    kept: dict[int, Squared] = {}
    first = Run(Setup(folder=tmp_path), range(400), stop=lambda: asked, on_result=now, chunk=3)
    first.scheduler.go_on({}, kept.__setitem__)
    first.run_with(executor)
    assert 5 <= len(kept) < 400 and kept == first.results
    rest = Run(Setup(folder=tmp_path), range(400), chunk=3)
    more: dict[int, Squared] = {}
    rest.scheduler.go_on(kept, more.__setitem__)
    rest.run_with(executor)
    assert not kept.keys() & more.keys() and rest.steps == len(more)
    assert rest.squares() == {number: number**2 for number in range(400)}


@child_process
@pytest.mark.parametrize(
    ("how", "says", "error"),
    [
        ("killed", "a process that squares was killed by SIGKILL", PoolError),
        ("bug", "a process that squares ended with exit code 1", PoolError),
        ("task", "it broke", TaskError),
        ("no UTF-8", r"there is no .*caf\\udce9", PoolError),
        ("garbage", "a process that squares sent an unreadable message", PoolError),
        ("another type", "a process that squares sent an unreadable message", PoolError),
        ("another's", "a process that squares sent the result of an item that it was not given", PoolError),
    ],
)
def test_a_failing_process_ends_the_job_and_the_others_finish_their_started_items(
    how: str, says: str, error: type[Exception], tmp_path: Path
) -> None:
    # Item 7 is dealt last, so the other process has all items before it.
    run = Run(Setup(how, 7, folder=tmp_path), range(8))
    with pytest.raises(error, match=says) as raised:
        run.run_with(Processes(2))
    if isinstance(raised.value, TaskError):
        assert raised.value.problem == PROBLEM
    begun = {int(path.name.removeprefix(BEGUN)) for path in tmp_path.glob(f"{BEGUN}*")}
    # The other process may have received an item that it had not started.
    assert set(run.results) == begun - {7} and 6 <= len(run.results) <= 7
    assert not any(psutil.pid_exists(result.pid) for result in run.results.values())


@child_process
@pytest.mark.parametrize("workers", [1, 2])
def test_a_killed_process_is_replaced_and_its_chunk_retried(workers: int, tmp_path: Path) -> None:
    run = Run(Setup("killed once", 4, folder=tmp_path), range(9), chunk=3, tries=3, goes_on=True)
    reports: list[str] = []
    run.run_with(Processes(workers, reports.append))
    assert reports == ["a process that squares was killed by SIGKILL; its unfinished items are dealt again"]
    assert run.squares() == {number: number**2 for number in range(9)} and not run.failures
    assert len({result.pid for result in run.results.values()}) > 1


@child_process
@pytest.mark.parametrize(("how", "stage"), [("task", "step"), ("killed", "worker")])
def test_items_that_fail_on_each_try_are_reported_at_the_end_and_the_others_are_done(
    how: str, stage: str, tmp_path: Path
) -> None:
    run = Run(Setup(how, 4, folder=tmp_path), range(9), chunk=3, tries=2, goes_on=True)
    run.run_with(Processes(2))
    assert sorted(run.results) == [0, 1, 2, 3, 5, 6, 7, 8]
    (failure,) = run.failures
    assert (failure.numbers, failure.problem.stage) == ((4,), stage)


@child_process
@pytest.mark.parametrize("executor", EXECUTORS)
def test_a_task_that_cannot_be_loaded_is_reported_once(executor: Executor, tmp_path: Path) -> None:
    run = Run(Setup("cannot be loaded", folder=tmp_path), range(8), tries=3, goes_on=True)
    with pytest.raises(TaskError, match="it broke") as raised:
        run.run_with(executor)
    assert raised.value.problem == PROBLEM and not run.results


@child_process
def test_a_second_interrupt_ends_processes_that_hang(tmp_path: Path) -> None:
    def twice() -> bool:
        if (tmp_path / "hangs").exists():
            raise KeyboardInterrupt  # like the second Ctrl-C
        return False

    run = Run(Setup("hangs", 3, folder=tmp_path), range(10**6), stop=twice)
    with pytest.raises(KeyboardInterrupt):
        run.run_with(Processes(2))
    pids = {int(line.split()[2]) for line in run.updates}
    assert len(pids) >= 1
    until(lambda: not any(map(psutil.pid_exists, pids)), "their end")


@child_process
@pytest.mark.parametrize("how", ["hangs", "half a message"])
def test_a_process_that_does_not_stop_is_waited_for_only_a_limited_time(
    how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.jobs.local_processes._END_SECONDS", 0.2)
    run = Run(Setup(how, 0, folder=tmp_path), range(8), stop=lambda: (tmp_path / "hangs").exists())
    with pytest.raises(PoolError, match="that squares did not end in time"):
        run.run_with(Processes(1))


# --- dealing, without processes --------------------------------------------------------------------------


class SchedulerProbe:
    """A scheduler of numbers that stores results and failures."""

    def __init__(self, numbers: Iterable[int], known: Mapping[int, int] | None = None, **how: Any) -> None:
        self.results: dict[int, int] = {}
        self.failures: list[Failure] = []
        self.scheduler: Scheduler[int, None] = Scheduler(
            numbers, self.results.__setitem__, on_failure=self.failures.append, **{"tries": 3, **how}
        )
        if known is not None:
            self.scheduler.go_on(known, lambda number, result: None)


def problem(line: int) -> TaskError:
    return TaskError(Problem("step", f"it broke at {line}", "task.py", line, "", ""))


def test_chunks_are_the_same_whatever_results_are_known() -> None:
    probe = SchedulerProbe([*range(7), 9], known={0: 0, 1: 1, 2: 2, 4: 4}, chunk=3)
    dealt = [probe.scheduler.next("a"), probe.scheduler.next("b"), probe.scheduler.next("a")]
    assert dealt == [
        Chunk((3, 4, 5), frozenset({3, 5}), again=True),
        Chunk((6,), frozenset({6}), again=True),
        Chunk((9,), frozenset({9}), again=True),
    ]
    assert probe.scheduler.next("a") is None and probe.results == {0: 0, 1: 1, 2: 2, 4: 4}


def test_items_of_a_failed_chunk_are_retried_one_by_one_before_all_others() -> None:
    probe = SchedulerProbe(range(9), chunk=3)
    probe.scheduler.next("a")
    probe.scheduler.result("a", 1, 1)
    probe.scheduler.failed("a", problem(7))
    dealt = [probe.scheduler.next("b") for _ in range(3)]
    assert dealt == [
        Chunk((0,), frozenset({0}), again=True),
        Chunk((2,), frozenset({2}), again=True),
        Chunk((3, 4, 5), frozenset({3, 4, 5})),
    ]
    assert not probe.failures


@pytest.mark.parametrize(("before", "most"), [(0, MAX_ALIKE_FIRST), (1, MAX_ALIKE_LATER)])
def test_equal_failures_end_the_job_and_sooner_at_its_beginning(before: int, most: int) -> None:
    probe = SchedulerProbe(range(100))
    for number in range(before):
        probe.scheduler.next(number)
        probe.scheduler.result(number, number, 0)
    for number in range(before, before + most - 1):
        assert probe.scheduler.next(number) is not None
        probe.scheduler.failed(number, problem(7))
    assert probe.scheduler.next("last") is not None
    with pytest.raises(TaskError, match="it broke at 7"):
        probe.scheduler.failed("last", problem(7))
    assert len(probe.failures) == most


def test_failures_at_different_places_or_between_results_do_not_end_the_job() -> None:
    probe = SchedulerProbe(range(100))
    for number in range(2 * MAX_ALIKE_FIRST - 2):
        probe.scheduler.next(number)
        probe.scheduler.failed(number, problem(number % 2))
    for number in range(20, 20 + 3 * MAX_ALIKE_LATER):
        chunk = probe.scheduler.next(number)
        if number % 2:
            probe.scheduler.failed(number, problem(1))
        else:
            assert chunk is not None
            probe.scheduler.result(number, chunk.numbers[0], 0)
    assert probe.scheduler.count_left(99) == 100 - (2 * MAX_ALIKE_FIRST - 2) - 3 * MAX_ALIKE_LATER


@given(total=st.integers(1, 200), count=st.integers(1, 40), chunk=st.integers(1, 9))
def test_shards_cover_all_chunks_once_and_are_of_equal_size(total: int, count: int, chunk: int) -> None:
    found: list[int] = []
    sizes = set()
    for index in range(1, count + 1):
        probe = SchedulerProbe(range(total), chunk=chunk)
        probe.scheduler.take_part(Shard(index, count))
        taken = 0
        while (one := probe.scheduler.next("a")) is not None:
            found += one.numbers
            taken += 1
        sizes.add(taken)
    assert found == list(range(total))
    assert max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize("text", ["0/4", "5/4", "1", "a/b", "-1/3", "1/0", " 1/2", "1/2/3", "١/٢"])
def test_an_invalid_shard_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="--shard takes a part of the job"):
        parse_shard(text)
    assert str(parse_shard("3/64")) == "3/64"


@pytest.mark.parametrize(("stage", "begun"), [("reset", MAX_ALIKE_FIRST), ("build", 1)])
def test_a_group_with_equal_failures_is_abandoned_and_the_others_continue(stage: str, begun: int) -> None:
    results: list[int] = []
    failures: list[Failure] = []
    scheduler: Scheduler[int, None] = Scheduler(
        range(20), lambda number, _: results.append(number), on_failure=failures.append, group=10
    )
    failed = 0
    while (chunk := scheduler.next("a worker")) is not None:
        (number,) = chunk.numbers
        if number < 10:
            failed += 1
            scheduler.failed("a worker", TaskError(replace(PROBLEM, stage=stage)))
        else:
            scheduler.result("a worker", number, number)
    assert failed == begun and results == list(range(10, 20))
    assert sorted(number for failure in failures for number in failure.numbers) == list(range(10))


def test_a_dead_workers_chunks_are_dealt_again_last_without_their_finished_items() -> None:
    def with_two_of_four() -> SchedulerProbe:
        probe = SchedulerProbe(range(6), chunk=2)
        assert probe.scheduler.next("a") == Chunk((0, 1), frozenset({0, 1}))
        probe.scheduler.next("a")
        for number in (0, 3):
            probe.scheduler.result("a", number, number)
        return probe

    with pytest.raises(PoolError):
        with_two_of_four().scheduler.ended("a")
    probe = with_two_of_four()
    assert probe.scheduler.count_left(9) == 1
    probe.scheduler.died("a", "was killed", -9)
    assert probe.scheduler.count_left(9) == 3 and probe.scheduler.count_left(2) == 2
    dealt = [probe.scheduler.next("b") for _ in range(3)]
    assert [chunk and (chunk.numbers, sorted(chunk.wanted), chunk.again) for chunk in dealt] == [
        ((4, 5), [4, 5], False), ((0, 1), [1], True), ((2, 3), [2], True),
    ]  # fmt: skip
    with pytest.raises(PoolError, match="that it was not given"):
        probe.scheduler.result("b", 0, 0)
    for number in (4, 5, 1, 2):
        probe.scheduler.result("b", number, number)
    probe.scheduler.ended("b")
    assert sorted(probe.results) == list(range(6)) and probe.scheduler.results == 6


def test_failed_code_gives_the_workers_other_chunk_back_whole() -> None:
    probe = SchedulerProbe(range(4), chunk=2)
    for _ in range(2):
        probe.scheduler.next("a")
    probe.scheduler.failed("a", problem(7))
    dealt = [probe.scheduler.next("b") for _ in range(4)]
    assert [chunk and chunk.numbers for chunk in dealt] == [(2,), (3,), (0, 1), None]
    with pytest.raises(TaskError):
        probe.scheduler.failed("never had a chunk", problem(7))


def test_workers_that_die_before_their_first_chunk_end_the_job() -> None:
    probe = SchedulerProbe(range(9))
    for _ in range(2):
        probe.scheduler.died("a", "was killed", -9)
    probe.scheduler.next("b")
    probe.scheduler.result("b", 0, 0)
    for _ in range(2):
        probe.scheduler.died("a", "was killed", -9)
    with pytest.raises(PoolError):
        probe.scheduler.died("a", "was killed", -9)
    with pytest.raises(PoolError):
        SchedulerProbe(range(9), tries=1).scheduler.died("a", "was killed", -9)


def test_a_limit_never_rises_and_what_is_beyond_it_is_not_dealt_again() -> None:
    probe = SchedulerProbe(range(9), chunk=3)
    for worker in ("a", "b"):
        probe.scheduler.next(worker)
    probe.scheduler.lower(4)
    probe.scheduler.lower(8)
    assert probe.scheduler.limit() == 4 and probe.scheduler.count_left(9) == 0
    probe.scheduler.result("b", 3, 3)
    probe.scheduler.ended("b")  # 4 and 5 are not needed
    probe.scheduler.died("a", "was killed", -9)
    again = probe.scheduler.next("c")
    assert again is not None and again.numbers == (0, 1, 2) and probe.scheduler.next("c") is None
    probe.scheduler.lower(0)
    probe.scheduler.died("c", "was killed", -9)
    assert probe.scheduler.next("d") is None and not probe.failures


@pytest.mark.parametrize("known", [False, True])
def test_a_group_whose_workers_die_is_abandoned_with_all_its_chunks(known: bool) -> None:
    """The items 0 to 29 are one group, and each worker that gets one of them dies."""
    how = {"group": 30, "tries": 2, "chunk": 2}
    probe = SchedulerProbe(range(34), known={0: 0} if known else None, **how)
    deaths = 0
    while (chunk := probe.scheduler.next("a")) is not None:
        if chunk.numbers[0] < 30:
            deaths += 1
            probe.scheduler.died("a", "was killed", -9)
        else:
            for number in sorted(chunk.wanted):
                probe.scheduler.result("a", number, number)
    failed = sorted(number for failure in probe.failures for number in failure.numbers)
    assert failed == list(range(int(known), 30)) and set(probe.results) == {*range(30, 34), *([0] * known)}
    assert all(failure.problem.stage == "worker" for failure in probe.failures)
    # A group that already had a result is tried longer.
    assert deaths > MAX_ALIKE_FIRST if known else deaths == MAX_ALIKE_FIRST


def test_without_any_result_the_first_failure_is_the_jobs() -> None:
    probe = SchedulerProbe(range(2))
    for line in (7, 8):
        probe.scheduler.next("a")
        probe.scheduler.failed("a", problem(line))
    with pytest.raises(TaskError, match="it broke at 7"):
        probe.scheduler.require_results()
    probe = SchedulerProbe(range(2), known={1: 1})
    probe.scheduler.next("a")
    probe.scheduler.failed("a", problem(7))
    probe.scheduler.require_results()
    assert probe.scheduler.next("a") is None


def test_failures_of_one_kind_are_joined_in_order() -> None:
    failures = [Failure((5, 4), problem(1).problem), Failure((3,), problem(2).problem)]
    failures += [Failure((1,), replace(problem(1).problem, message="other words"))]
    found = by_kind(failures)
    assert [(one.line, numbers) for one, numbers in found] == [(1, [1, 4, 5]), (2, [3])]
    assert found[0][0] == failures[0].problem

"""What a failure of the author's code leaves behind in the worker, and what the server hears of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.drive.scenes import problem
from workbench.live.messages import TaskFailed
from workbench.live.process.heartbeat import HeartbeatReader, HeartbeatWriter, Interrupts, make_heartbeat
from workbench.live.worker.guarded_task import GuardedTask
from workbench.live.worker.process_state import read_process_state
from workbench.live.worker.step_events import StepEvents
from workbench.task.problem import Interrupted, TaskError


@dataclass
class Guard:
    """A worker's task, and what was sent to the server."""

    sent: list[TaskFailed] = field(default_factory=list)
    dropped: int = 0
    failures: int = 0

    def __post_init__(self) -> None:
        heartbeat = make_heartbeat()
        self.reader, self.interrupts = HeartbeatReader(heartbeat), Interrupts()
        line: Any = SimpleNamespace(send=self.sent.append, drop_steps=self._drop)
        self.task = GuardedTask(line, self.interrupts, HeartbeatWriter(heartbeat), StepEvents(), self._fail)

    def _drop(self) -> None:
        self.dropped += 1

    def _fail(self) -> None:
        self.failures += 1

    def opens(self) -> None:
        self.task.opened = cast(Any, SimpleNamespace(loaded=SimpleNamespace(source_files=())))

    def rests(self) -> bool:
        return self.reader.read().doing == "idle" and not self.interrupts.allowed


@pytest.fixture
def guard() -> Iterator[Guard]:
    yield Guard()


def raises(error: BaseException) -> Callable[..., None]:
    def work(*_: object) -> None:
        raise error

    return work


def test_work_may_be_interrupted_while_it_runs_and_is_named(guard: Guard) -> None:
    seen: list[tuple[str, bool]] = []

    def work() -> None:
        seen.append((guard.reader.read().doing, guard.interrupts.allowed))

    assert guard.task.run("stepping", work) is None and guard.rests()
    assert guard.task.run(None, work) is None, "no code of the author runs"
    assert seen == [("stepping", True), ("idle", False)] and guard.sent == []


@pytest.mark.parametrize("kept", [False, True])
def test_an_end_of_the_program_is_a_failure_and_an_interrupt_drops_the_steps_that_wait(
    guard: Guard, kept: bool
) -> None:
    if kept:
        guard.opens()
    found = guard.task.run("resetting", raises(SystemExit(3)))
    (failed,) = guard.sent
    assert found is failed.problem and failed.problem.stage == "reset"
    assert (failed.kept, failed.at_run, failed.spoiled) == (kept, True, "")
    assert (guard.dropped, guard.failures) == (0, 1) and guard.task.failed and guard.rests()
    guard.task.run("stepping", raises(Interrupted("stopped by the user")))
    assert (guard.dropped, guard.failures, len(guard.sent)) == (1, 2, 2) and guard.rests()


def test_a_version_whose_load_ends_the_program_is_refused_and_spoils_the_process(guard: Guard) -> None:
    guard.opens()
    guard.task.run("loading", raises(KeyboardInterrupt()), loads=True)
    (failed,) = guard.sent
    assert (failed.kept, failed.at_run) == (True, False) and failed.spoiled and guard.task.spoiled
    assert guard.failures == 0 and guard.rests()


def test_a_bug_of_ours_passes_through(guard: Guard) -> None:
    with pytest.raises(ZeroDivisionError):
        guard.task.run("stepping", raises(ZeroDivisionError()))
    assert guard.sent == [] and guard.rests()


@pytest.mark.parametrize("interrupted", [False, True])
def test_a_failure_of_a_hook_is_sent_with_what_it_changed(guard: Guard, interrupted: bool) -> None:
    def fails(stage: str = "evaluate") -> TaskFailed:
        error = TaskError(replace(problem(), stage=stage))
        error.__cause__ = Interrupted("stopped") if interrupted else None
        guard.task.guarded(raises(error))
        return guard.sent[-1]

    guard.task.guarded(raises(TaskError(problem())))
    assert guard.sent == [], "there is no task"
    guard.opens()
    guard.task.when_loaded = read_process_state()
    assert fails("policy").spoiled == "" and not guard.task.failed, "the task itself has not failed"
    failed = fails()
    assert (failed.problem.stage, failed.kept, failed.at_run, failed.spoiled) == ("evaluate", True, True, "")
    assert guard.task.failed and not guard.task.spoiled
    assert guard.dropped == (2 if interrupted else 0) and guard.failures == 2
    guard.task.when_loaded = {**guard.task.when_loaded, "a setting": 1}
    assert "a setting" in fails("policy").spoiled and guard.task.spoiled
    guard.task.when_loaded = read_process_state()
    fails()
    assert guard.task.spoiled, "another failure does not mend the process"

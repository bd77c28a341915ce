"""The supervisor replaces workers and reports why each ended: real processes without a task, which start at once."""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.drive.waiting import until
from workbench.cameras.questions import RunCameras
from workbench.live.messages import Event, Load, Loading, Request, WarmUp
from workbench.live.process import fork_client, supervisor, worker_process
from workbench.live.process.heartbeat import Busy
from workbench.live.process.supervisor import Death, End, SpareWorker, Supervisor, WorkerOptions
from workbench.machine.processes.wire import Call
from workbench.task.description import TaskOptions

pytestmark = pytest.mark.usefixtures("child_process")
SMALL_WORKER = Path(__file__).parents[1] / "small_worker.py"
OPTIONS = TaskOptions(num_envs=1)


class Supervised:
    """A `Supervisor`, and everything that it reported."""

    def __init__(self, options: WorkerOptions) -> None:
        self.events: list[Event] = []
        self.deaths: list[Death] = []
        self.busy: list[Busy | None] = []
        self.greeted = 0
        self.fails = 0
        """Number of next events whose handling fails."""
        self.first_requests: Callable[[], list[Request]] = self.greeting
        self.worker = Supervisor(
            options,
            WarmUp(OPTIONS),
            first_requests=lambda: self.first_requests(),
            on_event=self._take,
            on_death=self.deaths.append,
            on_busy=self.busy.append,
            own_files=lambda: [str(SMALL_WORKER)],
            texts=lambda loading: {},
            output=lambda stream, piece: False,
        )

    def greeting(self) -> list[Request]:
        self.greeted += 1
        return [do(f"say hello {self.greeted}")]

    def _take(self, event: Event) -> None:
        if self.fails:
            self.fails -= 1
            raise ValueError("no such step")
        self.events.append(event)

    @property
    def activities(self) -> list[str]:
        return [event.activity for event in self.events if isinstance(event, Loading)]

    def until(self, condition: Callable[[], object], what: str) -> None:
        until(
            lambda: bool(condition()), what, seen=lambda: (self.activities[-9:], self.deaths, self.busy[-1:])
        )

    def until_greeted(self, times: int) -> None:
        self.until(lambda: f"hello {times}" in self.activities, f"greeting {times}")

    def until_dead(self, times: int = 1) -> Death:
        self.until(lambda: len(self.deaths) >= times, f"death {times}")
        return self.deaths[times - 1]

    def until_busy(self) -> Busy:
        self.until(lambda: self.busy and self.busy[-1] is not None, "a busy report")
        found = self.busy[-1]
        assert found is not None
        return found


def do(what: str) -> Call:
    """A request that `small_worker` reads as a command; unlike others, these are never merged in the queue."""
    return Call(0, RunCameras(what, {}))


def load(name: str, number: int = 0) -> Load:
    return Load(name, OPTIONS, number=number)


@contextmanager
def supervised(options: WorkerOptions | None = None) -> Iterator[Supervised]:
    one = Supervised(options or WorkerOptions())
    one.worker.start()
    try:
        one.until_greeted(1)
        yield one
    finally:
        one.worker.stop()


@pytest.fixture(autouse=True)
def small_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    def command(dash_m: str, module: str, *arguments: str) -> list[str]:
        assert (dash_m, module) == ("-m", "workbench.app.worker.start")
        return [sys.executable, "-P", str(SMALL_WORKER), *arguments]

    monkeypatch.setattr(fork_client, "python_command", command)
    monkeypatch.setattr(worker_process, "worker_forks", SimpleNamespace(start=fork_client.start_anew))
    # Timeouts of seconds, for slow machines, are tenths here.
    for name, seconds in (
        ("BUSY_SECONDS", 0.8),
        ("STACK_PERIOD_SECONDS", 0.3),
        ("INTERRUPT_TIMEOUT_SECONDS", 0.3),
        ("HEADLESS_SECONDS", 0.8),
    ):
        monkeypatch.setattr(supervisor, name, seconds)
    for name, seconds in (
        ("LOAD_WAIT_SECONDS", 0.3),
        ("SILENCE_TIMEOUT_SECONDS", 1.2),
        ("RESTART_DELAY_SECONDS", 0.05),
    ):
        monkeypatch.setattr(supervisor, name, seconds)


def test_each_worker_gets_the_first_requests_and_its_events_arrive_in_order() -> None:
    with supervised() as one:
        assert one.worker.pid is not None and one.worker.pid != os.getpid()
        for number in range(20):
            one.worker.send(do(f"say {number}"))
        one.until(lambda: "19" in one.activities, "the last")
        assert one.activities == ["hello 1", *map(str, range(20))]
        first = one.worker.pid
        one.worker.replace()
        death = one.until_dead()
        assert (death.end, death.gives_up) == (End.ASKED, False)
        one.until_greeted(2)
        assert one.worker.pid not in (first, None)
    assert len(one.deaths) == 1, "a stop is not reported as a death"


def test_a_death_names_the_work_and_line_after_all_earlier_events() -> None:
    with supervised() as one:
        one.worker.send(do("last_steps 300"))
        death = one.until_dead()
        assert one.activities[1:301] == [f"step {number}" for number in range(300)]
        assert (death.why, death.end, death.doing, death.stack) == (
            *("was killed by SIGKILL", End.DIED, None, ""),
        )
        one.until_greeted(2)
        one.worker.send(do("leave 7"))
        death = one.until_dead(2)
        assert "exit code 7" in death.why and death.doing == "stepping" and "in leave" in death.stack


@pytest.mark.slow
def test_the_true_cause_of_a_death_is_reported_at_any_time() -> None:
    """Also right after the start, and in the middle of messages."""
    with supervised() as one:
        one.first_requests = lambda: [*one.greeting(), do("chatter")]
        one.worker.replace()
        one.until_dead(1)
        for moment in range(20):
            one.until(lambda: one.worker.pid is not None, "the next worker")
            received, number = len(one.events), (signal.SIGKILL, signal.SIGSEGV, signal.SIGABRT)[moment % 3]
            one.until(lambda count=received + 2 * moment: len(one.events) >= count, "the moment")
            os.kill(one.worker.pid or 0, number)
            death = one.until_dead(moment + 2)
            assert (death.why, death.end) == (f"was killed by {number.name}", End.DIED), moment
            one.worker.reset_deaths()


@pytest.mark.slow
def test_after_three_deaths_in_a_row_no_worker_starts_until_asked_and_a_load_resets_the_count() -> None:
    with supervised() as one:
        for times in range(1, 6):
            one.until_greeted(times)
            if times == 3:
                one.worker.reset_deaths()
            one.worker.send(do("leave 1"))
            assert one.until_dead(times).gives_up is (times == 5)
        one.until(lambda: one.worker.pid is None, "no worker")
        one.worker.replace()
        one.until_greeted(6)
        for times in (6, 7, 8):
            one.until_greeted(times)
            one.worker.send(do("leave 1"))
            assert one.until_dead(times).gives_up is (times == 8), "a requested restart counts from zero"
    assert one.worker.pid is None, "no worker runs until it is asked for"


@pytest.mark.slow
def test_long_work_is_reported_repeatedly_and_when_it_is_over() -> None:
    with supervised() as one:
        one.worker.send(do("work 2.0"))
        one.until(lambda: None in one.busy, "its end")
        reports = [busy for busy in one.busy if busy is not None]
        assert (
            len(reports) >= 2
            and reports[0].seconds >= supervisor.BUSY_SECONDS
            and reports[-1].seconds > reports[0].seconds
        )
        assert (
            reports[-1].file == str(SMALL_WORKER)
            and not reports[-1].ignores_interrupt
            and not reports[-1].held
        )
        assert one.deaths == [] and one.busy.count(None) == 1


def test_asking_for_the_stack_does_not_kill_a_worker_without_signal_handlers() -> None:
    with supervised() as one:
        one.worker.send(do("without_handlers 1.5"))
        one.until(lambda: None in one.busy, "its end")
        assert one.deaths == []


@pytest.mark.slow
def test_an_interrupt_stops_work_but_no_idle_or_debugged_worker() -> None:
    with supervised() as one:
        one.worker.interrupt()
        one.worker.send(do("held_by_a_debugger 1.5"))
        one.until(lambda: any(busy is not None and busy.held for busy in one.busy), "the debugger")
        one.worker.interrupt()
        one.worker.send(load("fixed"))
        one.until(lambda: "fixed" in one.activities, "the load by the same worker")
        one.until(lambda: one.busy[-1] is None, "the end of the debugger")
        assert "interrupted" not in one.activities and one.deaths == []
        one.worker.send(do("work 600"))
        one.until_busy()
        one.worker.interrupt()
        one.until(lambda: "interrupted" in one.activities, "the interrupt")
        assert one.deaths == []


@pytest.mark.slow
def test_a_worker_that_ignores_an_interrupt_is_reported() -> None:
    with supervised() as one:
        one.worker.send(do("work_on 600"))
        assert not one.until_busy().ignores_interrupt
        one.worker.interrupt()
        one.until(lambda: one.until_busy().ignores_interrupt, "the ignored interrupt")


def test_a_load_waits_only_for_short_work() -> None:
    with supervised() as one:
        one.worker.send(do("work 600"))
        one.until_busy()
        assert not one.worker.load_pending
        one.worker.send(load("fixed"))
        assert one.worker.load_pending
        one.until(lambda: "fixed" in one.activities, "the load")
        assert "interrupted" in one.activities and one.deaths == []
        one.until(lambda: not one.worker.load_pending, "the start of the load")


@pytest.mark.slow
def test_a_save_during_the_first_requests_of_a_new_worker_is_loaded_after_them() -> None:
    with supervised() as one:

        def saved_meanwhile() -> list[Request]:
            one.worker.send(load("saved", 7))
            return [*one.greeting(), load("brought back")]

        def has_it() -> list[Request]:
            one.worker.send(load("again", 8))
            return [load("again", 8), do("say the end")]

        for first, last in ((saved_meanwhile, "saved"), (has_it, "the end")):
            one.first_requests = first
            os.kill(one.worker.pid or 0, signal.SIGKILL)
            one.until(lambda last=last: last in one.activities, f"the activity {last}")
        assert (
            "brought back" not in one.activities[one.activities.index("saved") :]
            and one.activities.count("again") == 1
        )


@pytest.mark.slow
def test_a_load_behind_uninterruptible_work_ends_the_worker() -> None:
    with supervised() as one:
        for times in (1, 2, 3):
            one.until_greeted(times)
            one.worker.send(do("work_on 600"))
            one.until_busy()
            one.worker.send(load("fixed"))
            death = one.until_dead(times)
            assert death.end is End.FILE_WAITS and not death.gives_up, "it was not the worker's fault"
            # Only after the interrupt had its time: sent after 0.3 s, and 1.2 s to work.
            waited = re.search(r"(\d+) s", death.why)
            assert waited is not None and int(waited[1]) >= 2, death.why
            assert death.doing == "stepping" and "in _pass_time" in death.stack
        assert one.busy[-1] is None


@pytest.mark.parametrize(
    ("does", "fails", "says"),
    [
        pytest.param("nonsense x", 0, "unreadable data", marks=pytest.mark.slow),
        ("say this", 1, "no such step"),
        pytest.param("without_a_main_thread 600", 0, "main thread", marks=pytest.mark.slow),
        pytest.param("close_its_line 600", 0, "closed its connection", marks=pytest.mark.slow),
    ],
)
def test_a_broken_worker_is_ended_with_a_reason_and_replaced(does: str, fails: int, says: str) -> None:
    with supervised() as one:
        one.fails = fails
        one.worker.send(do(does))
        assert says in one.until_dead().why
        one.until_greeted(2)


def test_a_worker_without_main_thread_may_end_on_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(supervisor, "HEADLESS_SECONDS", 600.0)
    with supervised() as one:
        one.worker.send(do("ends_soon_without_a_main_thread 0.5"))
        assert "exit code 7" in one.until_dead().why


@pytest.mark.slow
def test_failing_first_requests_end_the_worker_and_are_tried_again(caplog: pytest.LogCaptureFixture) -> None:
    with supervised() as one:
        failures = iter(range(5))

        def fails() -> list[Request]:
            if next(failures, None) is not None:
                raise RuntimeError("no first requests")
            return one.greeting()

        one.first_requests = fails
        one.worker.replace()
        one.until_dead(4)
        assert all("no first requests" in death.why for death in one.deaths[1:])
        assert [death.gives_up for death in one.deaths] == [False, False, False, True]
        assert one.worker.pid is None
        one.worker.replace()
        one.until_greeted(2)
        assert [death.gives_up for death in one.deaths[4:]] == [False, False]
    assert "no first requests" in caplog.text


def test_without_a_startable_worker_it_gives_up_until_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    command, failures = fork_client.python_command, iter(range(4))

    def fails(*arguments: str) -> list[str]:
        if next(failures, None) is not None:
            raise OSError("no more processes")
        return command(*arguments)

    monkeypatch.setattr(fork_client, "python_command", fails)
    one = Supervised(WorkerOptions())
    one.worker.start()
    try:
        one.until_dead(3)
        one.worker.replace()
        one.until_greeted(1)
        assert [death.gives_up for death in one.deaths] == [False, False, True, False]
        assert all("no more processes" in death.why for death in one.deaths)
    finally:
        one.worker.stop()


def test_memory_use_is_reported_and_ends_the_worker_above_the_limit() -> None:
    limit = 600 << 20
    with supervised(WorkerOptions(memory_limit=limit)) as one:
        one.until(lambda: one.worker.vitals.memory > 0, "a memory reading")
        vitals = one.worker.vitals
        assert (vitals.memory_limit, vitals.spare_memory, vitals.spare_ready) == (limit, None, False)
        one.worker.send(do("fill_memory 700"))
        death = one.until_dead()
        assert "--memory-limit" in death.why and death.end is End.DIED


def test_stop_ends_the_thread_and_a_worker_that_hangs() -> None:
    with supervised() as one:
        one.worker.send(do("work_on 600"))
        one.until_busy()
        pid = one.worker.pid
    until(lambda: not Path(f"/proc/{pid}").exists(), "its end")
    assert [thread.name for thread in threading.enumerate() if thread.name == "session"] == []


@pytest.mark.slow
def test_a_spare_replaces_a_dead_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor, "SPARE_DELAY_SECONDS", 0.0)
    with supervised(WorkerOptions(spare=True)) as one:
        assert one.worker.vitals.spare_memory is None
        one.worker.send(do("loaded"))
        one.until(lambda: one.worker.vitals.spare_ready, "the spare")
        assert (one.worker.vitals.spare_memory or 0) > 0
        # A new spare would be ready before the assertion.
        monkeypatch.setattr(supervisor, "SPARE_DELAY_SECONDS", 600.0)
        first = one.worker.pid
        os.kill(first or 0, signal.SIGKILL)
        one.until_greeted(2)
        assert one.worker.pid not in (None, first)
        one.until(lambda: not one.worker.vitals.spare_ready, "the use of the spare")


@pytest.mark.slow
def test_a_spare_that_dies_while_warming_up_is_tried_only_once_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(supervisor, "SPARE_DELAY_SECONDS", 0.0)
    spare = SpareWorker(WarmUp(OPTIONS))

    def lives() -> bool:
        spare.poll()
        return spare.memory > 0

    try:
        spare.begin_soon()
        for _ in range(2):
            until(lives, "a spare")
            spare.kill()
            until(lambda: spare.memory == 0, "its end")
            spare.poll()
        # A process frees its memory before it closes its socket.
        until(lambda: not lives() and not spare.ready, "the end of the second spare to be noticed")
        spare.begin_soon()
        assert not lives() and not spare.ready
    finally:
        spare.stop()

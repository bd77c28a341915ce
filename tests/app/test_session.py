"""What a session keeps, takes and hands on, with the test as its worker."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from tests.drive.scenes import problem
from tests.drive.session import DEATH, FakeWorker, FakeWorkerSession, fake_worker_session, wait_until
from tests.drive.waiting import until
from workbench.checks.commands import CheckAfterSave
from workbench.checks.state import ChecksView
from workbench.live.commands import Interrupt, SetSeed, Step
from workbench.live.events import PagesCounted
from workbench.live.messages import CameraRequest, EnterRecording, Event, Load, TaskFailed
from workbench.live.process.supervisor import End
from workbench.machine.preferences import preferences
from workbench.task.description import TaskOptions


class CountingWorker(FakeWorker):
    """Counts what only a supervisor of a process needs."""

    interrupts = deaths_reset = 0

    def interrupt(self) -> None:
        self.interrupts += 1

    def reset_deaths(self) -> None:
        self.deaths_reset += 1


@contextmanager
def opened(
    folder: Path, task: str = "push.py", **more: Any
) -> Iterator[tuple[FakeWorkerSession, CountingWorker]]:
    made: list[CountingWorker] = []

    class Kept(CountingWorker):
        def __init__(self, *arguments: Any, **named: Any) -> None:
            super().__init__(*arguments, **named)
            made.append(self)

    with fake_worker_session(folder / "recordings", task=task, worker=Kept, **more) as fake:
        yield fake, made[0]


def test_the_work_of_a_session_continues_in_the_next_one(tmp_path: Path) -> None:
    with opened(tmp_path) as (fake, _):
        fake.play(1)
        fake.session.do(SetSeed(seed=9))
        watched = (CameraRequest("base_camera", "sensor", ("rgb",)),)
        fake.session.change(speed=2.0, selected_env=1, episode_end="pause", cameras=watched)
        kept = fake.session.kept_work()
    assert (kept.seed, kept.options.num_envs, kept.settings.speed) == (9, 3, 2.0)
    with opened(tmp_path, kept=replace(kept, options=TaskOptions(5, env_kwargs={"size": 2}))) as (fake, _):
        loads = [one for one in fake.greet() if isinstance(one, Load)]
        assert [one.options for one in loads] == [TaskOptions(5, seed=9, env_kwargs={"size": 2})]
        settings = fake.view.settings
        assert (settings.speed, settings.selected_env, settings.episode_end) == (2.0, 1, "pause")
        assert settings.cameras == (), "the next page asks for its pictures itself"
        assert fake.session.kept_work().seed == 9


def test_the_counter_of_changes_counts_only_changes(tmp_path: Path) -> None:
    with opened(tmp_path) as (fake, _):
        fake.load()
        session = fake.session
        before = session.wait(-1, 0.0)
        session.change()
        assert session.wait(before, 0.0) == before
        session.dispatch(PagesCounted(3))
        assert session.wait(before, 0.0) != before


def test_events_are_handed_on(tmp_path: Path) -> None:
    events: list[Event] = []
    with opened(tmp_path, on_event=events.append) as (fake, worker):
        fake.load()
        assert worker.deaths_reset == 1 and len(events) == 1
        fake.tell(TaskFailed(problem(), kept=True))
        assert [type(event) for event in events[1:]] == [TaskFailed]
        stopped = TaskFailed(replace(problem(), interrupted=True), kept=True)
        worker.load_pending = True
        fake.tell(stopped)
        assert len(events) == 2, "a newer version waits: nothing failed"
        worker.load_pending = False
        fake.tell(stopped)
        assert events[2:] == [stopped]
        fake.die()
        assert isinstance(events[-1], TaskFailed) and events[-1].kept and events[-1].problem.stage == "worker"
        fake.session.do(Interrupt())
        assert worker.interrupts == 1
    with opened(tmp_path, on_event=events.append) as (fake, _):
        fake.die()
        assert isinstance(events[-1], TaskFailed) and not events[-1].kept, "there is no version to return to"


def test_a_restored_version_whose_file_has_changed_meanwhile_is_stale(tmp_path: Path) -> None:
    file = tmp_path / "push.py"
    of_file: dict[str, Any] = {
        "file": str(file),
        "source_files": (str(file),),
        "source": {str(file): "a = 1\n"},
    }
    for text, stale in (("a = 1\n", False), ("a = 0\n", True), (None, True)):
        file.write_text("a = 1\n")
        with opened(tmp_path, str(file)) as (fake, _):
            fake.greet()
            fake.load(**of_file)
            if text is None:
                file.unlink()
            else:
                file.write_text(text)
            fake.die()
            fake.greet()
            fake.load(**of_file)
            assert fake.view.stale is stale


def test_whether_saves_are_checked_is_kept_for_later_runs(tmp_path: Path) -> None:
    with opened(tmp_path, check=True) as (fake, _):
        assert fake.view.of(ChecksView).after_each_save
        for on in (False, True):
            fake.session.do(CheckAfterSave(on=on))
            until(lambda on=on: preferences().check_after_save is on, "the stored choice")
            assert fake.view.of(ChecksView).after_each_save is on
    with opened(tmp_path) as (fake, _):
        assert not fake.view.of(ChecksView).after_each_save


def test_each_entered_recording_has_its_own_number(tmp_path: Path) -> None:
    with opened(tmp_path) as (fake, _):
        fake.load()
        numbers = [fake.session.enter_recording(cast(Any, "a run"), everywhere=True) for _ in range(2)]
        assert len({*numbers}) == 2
        assert [(one.number, one.env_idx) for one in fake.asked(EnterRecording)] == [
            (number, (0, 1, 2)) for number in numbers
        ]


def test_an_effect_that_fails_costs_only_itself(tmp_path: Path) -> None:
    with opened(tmp_path) as (fake, _):
        fake.load()
        fake.asked(object)

        class Deaf(Exception):
            pass

        def fails(request: object) -> None:
            raise Deaf("no worker")

        worker = cast(Any, fake.worker)
        send = worker.send
        worker.send = fails
        with pytest.raises(Deaf):
            fake.session.do(Step())
        worker.send = send
        fake.session.do(Step())
        assert fake.asked(object), "the next command is sent"


def test_the_log_can_be_cleared(tmp_path: Path) -> None:
    policy = tmp_path / "act.py"
    policy.write_text("def act(obs): return 0\n")
    lines: list[str] = []
    with opened(tmp_path, on_line=lambda line: lines.append(line.text)) as (fake, _):
        session = fake.session
        fake.load()
        session.change(action_source="policy", policy=f"{policy}:act")
        policy.write_text("def act(obs): return 1\n")
        wait_until(session, lambda view: view.printed.texts, "the line about the saved policy")
        until(lambda: lines, "the line in the terminal")
        session.clear_printed()
        assert session.view().printed.texts == ()


def test_a_worker_that_hands_over_repeats_no_earlier_problem(tmp_path: Path) -> None:
    told: list[Event] = []
    with fake_worker_session(tmp_path, on_event=told.append) as fake:
        fake.load()
        fake.tell(TaskFailed(problem(), kept=True))
        fake.die(replace(DEATH, end=End.HANDED_OVER))
        assert sum(isinstance(event, TaskFailed) for event in told) == 1
        fake.die()
        assert sum(isinstance(event, TaskFailed) for event in told) == 2

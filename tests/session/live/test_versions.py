"""What a save, a failure and the end of a worker ask for, with the real state and the real watcher; no worker."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.drive.waiting import until
from tests.session.moments import DEATH
from tests.ui.scenes import description, problem, step_of, table_scene
from workbench.jobs.task import Stepped, TaskOptions
from workbench.session.live.live_state import LiveState, SharedState
from workbench.session.live.versions import Versions
from workbench.session.process.supervisor import End
from workbench.session.protocol.messages import Load, Loaded, LoadFailed, Loading, Play, Request

GOOD, NEW = "x = 1\n", "x = 2\n"
FILE_WAITS = replace(DEATH, end=End.FILE_WAITS)
HANDED_OVER = replace(DEATH, end=End.HANDED_OVER)


class Open:
    """An open file, and what was asked for of it."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.sent: list[Request] = []
        self.replaced = self.saves = 0
        self.shared = SharedState(LiveState(str(file), TaskOptions(), 10**8))
        self.versions = Versions(self.shared, self.sent.append, self._replace, self._save)

    def _replace(self) -> None:
        self.replaced += 1

    def _save(self) -> None:
        self.saves += 1

    def runs(self, *beside: Path, text: str = GOOD) -> tuple[bool, bool]:
        """A worker says that this text was loaded, and the first moment comes."""
        geometry, poses = table_scene(1)
        files = (str(self.file), *map(str, beside))
        task = replace(description(geometry), file=files[0], source_files=files, source={files[0]: text})
        step = replace(step_of(poses), elapsed_steps=np.zeros(1, np.int32))
        with self.shared.changing() as state:
            restored, stale = self.versions.version_loaded(task)
            state.loaded(Loaded(task, step, {}), restored=restored, stale=stale)
            state.stepped(Stepped(step, np.ones(1, bool), snapshot=b"body", part_keys=(), number=0))
        self.versions.follow(task, stale)
        return restored, stale

    def loads(self) -> list[Load]:
        return [request for request in self.versions.first_requests() if isinstance(request, Load)]


@pytest.fixture
def one(tmp_path: Path) -> Iterator[Open]:
    file = tmp_path / "push.py"
    file.write_text(GOOD)
    one = Open(file)
    yield one
    one.versions.close()


def test_a_file_that_never_loaded_is_followed_and_one_beside_it_once_it_was_imported(one: Open) -> None:
    one.versions.start()
    beside = one.file.with_name("parts.py")
    beside.write_text(GOOD)
    one.file.write_text(NEW)
    until(lambda: one.sent, "the load of what was saved")
    assert one.saves == 1 and one.shared.state.now.stale
    one.runs(beside, text=NEW)
    assert not one.shared.state.now.stale
    one.sent.clear()
    one.file.write_text(GOOD)
    until(lambda: one.sent, "the load of the task's file")
    one.sent.clear()
    beside.write_text(NEW)
    until(lambda: one.sent, "the load for the module beside it")
    (load,) = one.sent
    assert isinstance(load, Load) and (load.source, load.snapshot, load.level) == (None, None, "auto")


def test_a_module_that_broke_before_the_task_was_whole_is_followed(one: Open) -> None:
    beside = one.file.with_name("parts.py")
    beside.write_text("x =\n")
    one.versions.start()
    one.loads()
    one.versions.failed(LoadFailed(replace(problem(), file=str(beside)), kept=False))
    assert one.sent == []
    beside.write_text(GOOD)
    until(lambda: one.sent, "the load for the module that was mended")


def test_each_worker_is_greeted_with_what_the_last_one_knew(one: Open) -> None:
    settings, load = one.versions.first_requests()
    assert settings == one.shared.state.settings()
    assert isinstance(load, Load) and (load.source, load.snapshot) == (None, None)
    one.runs()
    one.shared.state.wants_play = True
    one.versions.reload()
    assert one.versions.died(FILE_WAITS, "")[1]
    (_, load, play) = one.versions.first_requests()
    assert play == Play(True)
    assert isinstance(load, Load) and load.source is None and load.snapshot is not None


def test_what_fails_in_a_fresh_worker_gives_way_to_the_version_that_ran(one: Open) -> None:
    one.runs()
    one.versions.reload()
    one.versions.died(FILE_WAITS, "")
    (asked,) = one.loads()
    assert asked.source is None
    one.sent.clear()
    one.versions.began(Loading("", asked.number))
    one.versions.failed(LoadFailed(problem(), kept=False))
    (load,) = one.sent
    assert isinstance(load, Load) and load.source == {str(one.file): GOOD} and load.snapshot is not None
    one.file.write_text(NEW)
    assert one.runs() == (True, True), "brought back, and the file holds another"
    one.versions.failed(LoadFailed(problem(), kept=True))
    assert one.sent == [load], "what ran before still runs"


def test_the_end_of_a_worker_says_whether_there_is_a_version_to_come_back(one: Open) -> None:
    told, comes_back = one.versions.died(DEATH, "the last words")
    assert told is not None and not comes_back
    assert not one.shared.state.now.problem_at_run, "it is lost at the load that it began with"
    one.runs()
    told, comes_back = one.versions.died(DEATH, "")
    assert told is not None and comes_back and one.shared.state.now.problem_at_run
    one.versions.restart_worker()
    assert one.replaced == 1 and one.loads()[0].source is None, "the file as it is now"


def test_a_worker_that_ran_a_refused_version_is_followed_by_one_with_the_last_good_version(one: Open) -> None:
    one.runs()
    one.shared.state.wants_play = True
    one.versions.reload()
    (asked,) = one.sent
    assert isinstance(asked, Load)
    one.versions.began(Loading("", asked.number))
    one.versions.failed(LoadFailed(problem(), kept=True, spoiled="it ran"))
    told, comes_back = one.versions.died(HANDED_OVER, "")
    assert told is None and comes_back
    _, load, play = one.versions.first_requests()
    assert isinstance(load, Load) and load.source == {str(one.file): GOOD} and load.snapshot is not None
    assert play == Play(True)


def test_after_too_many_deaths_a_reload_starts_another_worker(one: Open) -> None:
    one.runs()
    one.versions.reload("rebuilt")
    (load,) = one.sent
    assert isinstance(load, Load) and load.level == "rebuilt" and one.replaced == 0
    one.versions.died(replace(DEATH, gives_up=True), "")
    one.versions.reload()
    assert one.sent == [load] and one.replaced == 1
    assert one.loads()[0].source is None


def test_how_another_worker_gets_the_version_that_runs(one: Open) -> None:
    assert one.versions.running_load() is None
    one.runs()
    again = one.versions.running_load()
    assert again is not None and again.source == {str(one.file): GOOD} and again.snapshot is None

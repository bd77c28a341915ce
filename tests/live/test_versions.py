"""What is loaded after a save, a failure or the end of a worker, along every fallback."""

# The views are of a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.scenes import description, problem, table_scene
from tests.drive.session import DEATH, FakeWorkerSession, fake_worker_session, stop_watching
from tests.drive.waiting import until
from workbench.live import load_attempts as recovery
from workbench.live.commands import PlayRun, RebuildScene, ReloadFile, RestartWorker
from workbench.live.load_attempts import Recovery
from workbench.live.messages import Load, Loading, NewProcessNeeded, Play, Settings, TaskFailed
from workbench.live.process.supervisor import End

GOOD, NEW = "x = 1\n", "x = 2\n"
FILE_WAITS = replace(DEATH, end=End.FILE_WAITS)
HANDED_OVER = replace(DEATH, end=End.HANDED_OVER)
IDLE = replace(DEATH, doing=None)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    file = tmp_path / "push.py"
    file.write_text(GOOD)
    return file


@pytest.fixture
def one(file: Path, tmp_path: Path) -> Iterator[FakeWorkerSession]:
    with fake_worker_session(tmp_path / "recordings", str(file)) as fake:
        fake.greet()
        yield fake


def runs(
    one: FakeWorkerSession, file: Path, text: str = GOOD, level: str | None = None, *beside: Path
) -> None:
    """The worker reports that this text was loaded, and sends the first moment."""
    if file.read_text() != text:
        stop_watching(one.session)  # a moment later the watcher would take the file on disk for a save
    files = (str(file), *map(str, beside))
    source = {str(file): text} | {str(module): module.read_text() for module in beside}
    one.load(level, file=files[0], source_files=files, source=source, source_hash=text)
    one.reset()
    one.asked(object)


def next_load(one: FakeWorkerSession) -> tuple[str, bool] | None:
    """The text that a new worker loads (``disk`` for the file's content), and whether at a moment."""
    loads = [request for request in one.greet() if isinstance(request, Load)]
    if not loads:
        return None
    (load,) = loads
    return ("disk" if load.source is None else next(iter(load.source.values())), load.snapshot is not None)


def saved(one: FakeWorkerSession) -> Load:
    loads: list[Load] = []
    until(lambda: loads.extend(one.asked(Load)) or loads, "the load of what was saved")
    return loads[-1]


def test_a_file_that_never_loaded_is_followed_and_its_modules_once_imported(
    one: FakeWorkerSession, file: Path
) -> None:
    beside = file.with_name("parts.py")
    beside.write_text(GOOD)
    file.write_text(NEW)
    load = saved(one)
    assert one.view.stale and load.any_task
    one.tell(Loading("", load.number))
    runs(one, file, NEW, None, beside)
    assert not one.view.stale
    beside.write_text(NEW)
    load = saved(one)
    assert (load.source, load.snapshot, load.level, load.any_task) == (None, None, "auto", False)
    assert one.view.stale


def test_a_module_that_failed_during_the_first_import_is_followed(one: FakeWorkerSession, file: Path) -> None:
    beside = file.with_name("parts.py")
    beside.write_text("x =\n")
    one.tell(Loading("", 1), TaskFailed(replace(problem(), file=str(beside)), kept=False))
    assert one.view.state == "error" and one.asked(Load) == []
    beside.write_text(GOOD)
    saved(one)


def test_a_new_worker_gets_the_state_of_the_last_one(one: FakeWorkerSession, file: Path) -> None:
    runs(one, file)
    one.session.change(speed=2.0)
    one.session.do(PlayRun())
    one.session.do(ReloadFile())
    one.die(FILE_WAITS)
    settings, load, play = one.greet()
    assert isinstance(settings, Settings) and settings.speed == 2.0 and play == Play(True)
    assert isinstance(load, Load) and load.source is None and load.snapshot is not None
    one.tell(Loading("", load.number))
    runs(one, file, NEW, "restarted")
    one.die()
    assert not any(isinstance(request, Play) for request in one.greet()), "a crash pauses"


def test_the_version_that_ran_is_restored_at_its_newest_moment_then_at_its_start_then_not_at_all(
    one: FakeWorkerSession, file: Path
) -> None:
    runs(one, file)
    one.die()
    assert next_load(one) == (GOOD, True)
    one.die()
    assert next_load(one) == (GOOD, False), "a moment that crashes the worker is not tried twice"
    one.die()
    assert next_load(one) is None and one.view.state == "error"
    file.write_text(NEW)
    assert saved(one).source is None


def test_after_a_first_version_crashes_a_save_is_awaited(one: FakeWorkerSession) -> None:
    one.tell(Loading("", 1))
    one.die()
    assert next_load(one) is None and not one.view.problem_at_run
    one.session.do(RestartWorker())
    one.die(replace(DEATH, end=End.ASKED))
    assert one.replaced == 1 and next_load(one) == ("disk", False)


@pytest.mark.parametrize("death", [DEATH, HANDED_OVER])
def test_a_new_version_that_crashes_or_is_refused_is_replaced_by_the_last_good_one(
    one: FakeWorkerSession, file: Path, death: object
) -> None:
    runs(one, file)
    one.session.do(PlayRun())
    file.write_text(NEW)
    one.tell(Loading("", saved(one).number))
    if death is HANDED_OVER:
        one.tell(TaskFailed(problem(), kept=True, spoiled="it ran"))
    one.die(death)  # type: ignore[arg-type]
    (_, load, *play) = one.greet()
    assert isinstance(load, Load) and load.source == {str(file): GOOD} and load.snapshot is not None
    assert play == ([Play(True)] if death is HANDED_OVER else []) and load.because == (
        "it ran" if play else ""
    )
    runs(one, file)
    assert one.view.stale and one.view.problem is not None, (
        "an old version runs, and the file has a newer one"
    )


def test_a_version_that_fails_in_a_fresh_worker_is_replaced_by_the_one_that_ran(
    one: FakeWorkerSession, file: Path
) -> None:
    runs(one, file)
    one.session.do(ReloadFile())
    one.tell(NewProcessNeeded("a class", True))
    one.die(HANDED_OVER)
    (load,) = [request for request in one.greet() if isinstance(request, Load)]
    assert (load.source, load.because, load.same_scene) == (None, "a class", True)
    one.asked(object)
    one.tell(Loading("", load.number), TaskFailed(problem(), kept=False))
    (load,) = one.asked(Load)
    assert load.source == {str(file): GOOD} and load.snapshot is not None and load.because == ""
    runs(one, file)
    one.tell(TaskFailed(problem(), kept=True))
    assert one.asked(Load) == [], "the last version still runs"


def test_a_save_survives_a_worker_that_dies_before_loading_it(one: FakeWorkerSession, file: Path) -> None:
    runs(one, file)
    one.die()
    assert next_load(one) == (GOOD, True)
    one.session.do(ReloadFile())
    one.die()
    assert next_load(one) == ("disk", True), "it died with the restored version"
    runs(one, file)
    one.die()
    assert next_load(one) == ("disk", True), "the load has not started yet"


def test_a_version_that_crashes_early_twice_is_replaced_by_the_one_before(
    one: FakeWorkerSession, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs(one, file)
    one.session.do(ReloadFile())
    one.tell(Loading("", 2))
    runs(one, file, NEW, "patched")
    one.die()
    assert next_load(one) == (NEW, True)
    monkeypatch.setattr(recovery, "PROVEN_SECONDS", -1.0)  # from now on the version counts as proven
    for _ in range(3):
        runs(one, file, NEW)
        one.die()
        assert next_load(one) == (NEW, True), "earlier crashes are forgotten"
    monkeypatch.undo()
    runs(one, file, NEW)
    one.die()
    assert next_load(one) == (NEW, True)
    runs(one, file, NEW)
    one.die()
    assert next_load(one) == (GOOD, True)
    for _ in range(4):
        runs(one, file)
        one.die(IDLE)
        assert next_load(one) == (GOOD, True), "no other version exists, and it made a step in between"
        runs(one, file)
        one.step()
    one.die(IDLE)
    assert next_load(one) == (GOOD, True)
    runs(one, file)
    one.die(IDLE)
    assert next_load(one) is None, "it died twice without a request"


def test_after_too_many_deaths_a_reload_starts_another_worker(one: FakeWorkerSession, file: Path) -> None:
    runs(one, file)
    one.session.do(RebuildScene())
    (load,) = one.asked(Load)
    assert load.level == "rebuilt" and one.replaced == 0
    one.die(replace(DEATH, gives_up=True))
    one.session.do(ReloadFile())
    assert one.asked(Load) == [] and one.replaced == 1 and next_load(one) == ("disk", True)


def test_a_version_that_is_loaded_again_has_to_prove_itself_again() -> None:
    """Otherwise a version that ran for an hour, and crashes since its last load, would be started for ever."""
    task, newest = description(table_scene(1)[0]), lambda: b"newest"
    now = Recovery().loaded(task, 0.0).loaded(task, 3600.0)
    for _ in range(2):
        now = now.died(True, True, 3601.0, newest)
    assert now.attempt == "nothing"
    ran_long = Recovery().loaded(task, 0.0)
    for hours in (1, 2):
        ran_long = ran_long.died(True, True, 3600.0 * hours, newest)
    assert ran_long.attempt == "moment"


@given(st.lists(st.sampled_from(["died", "handed over", "failed", "saved", "began", "loaded"]), max_size=40))
def test_the_number_of_restarts_is_limited(events: list[str]) -> None:
    """Between two saves only a limited number of processes is started, whatever happens to them."""
    task = description(table_scene(1)[0])
    good, new = ({"push.py": text} for text in (GOOD, NEW))
    newest = lambda: b"newest"  # noqa: E731
    now = Recovery().next_load(newest)[0]
    for source in (good, new):
        now, load = now.file_requested(newest)
        now = now.began(load.number).loaded(replace(task, source=source), 0.0)
    loads = 0
    for event in events:
        if event == "saved":
            now, _ = now.file_requested(newest)
            loads = 0
        elif event == "began":
            now = now.began(10**6)
        elif event == "loaded" and now.loading:
            now = now.loaded(replace(task, source=now.good_source or good), 0.0)
        elif event == "failed":
            now, _ = now.failed(False, newest)
        elif event in ("died", "handed over"):
            now = now.died(event == "died", True, 0.0, newest)
            if event == "died":
                now, next_one = now.next_load(newest)
                loads += next_one is not None
        assert loads <= 8
    now, last = now.began(10**6), None
    for _ in range(8):
        now, last = now.died(True, False, 0.0, newest).next_load(newest)
    assert last is None

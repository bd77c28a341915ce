"""What a new worker is asked for, along every way down."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.ui.scenes import description, table_scene
from workbench.session.live.versions import LoadInputs, Recovery, is_on_disk

GOOD, NEW = {"push.py": "good"}, {"push.py": "new"}
TASK = description(table_scene(1)[0])


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def ran(*versions: dict[str, str], clock: Clock | None = None) -> Recovery:
    """Each was loaded after the other, and the last has run."""
    moments: list[bytes] = []
    recovery = Recovery(lambda: moments[-1] if moments else None, clock or Clock())
    assert recovery.next_load() == LoadInputs(None, None, 1)
    for number, source in enumerate(versions or (GOOD,)):
        if number:
            recovery.began(recovery.file_requested().number)
        recovery.loaded(replace(TASK, source=source))
    moments += [b"first", b"newest"]
    return recovery


def test_what_ran_comes_back_at_its_newest_moment() -> None:
    recovery = ran()
    recovery.died(crashed=True)
    assert recovery.next_load() == LoadInputs(GOOD, b"newest", 0) and recovery.restoring


def test_a_moment_that_kills_is_not_tried_twice_and_then_the_version_neither() -> None:
    recovery = ran()
    recovery.died(crashed=True)
    recovery.next_load()
    recovery.died(crashed=True)
    assert recovery.next_load() == LoadInputs(GOOD, None, 0)
    recovery.died(crashed=True)
    assert recovery.next_load() is None


def test_a_file_that_kills_before_anything_ran_is_waited_for() -> None:
    recovery = Recovery(lambda: None)
    recovery.next_load()
    recovery.died(crashed=True)
    assert recovery.next_load() is None
    assert recovery.file_requested() == LoadInputs(None, None, 2)


@pytest.mark.parametrize("crashed", [True, False])
def test_a_new_version_that_kills_or_is_refused_gives_way_to_the_last_good_one(crashed: bool) -> None:
    recovery = ran()
    recovery.began(recovery.file_requested().number)
    recovery.died(crashed)
    assert recovery.next_load() == LoadInputs(GOOD, b"newest", 0)


def test_a_file_that_waits_is_loaded_at_the_newest_moment_and_if_it_fails_the_last_good_one_is() -> None:
    recovery = ran()
    number = recovery.file_requested().number
    recovery.died(crashed=False)
    assert recovery.next_load() == LoadInputs(None, b"newest", number) and not recovery.restoring
    recovery.began(number)
    assert recovery.failed(kept=False)
    assert recovery.next_load() == LoadInputs(GOOD, b"newest", 0) and recovery.restoring


def test_a_save_is_not_lost_with_the_worker_that_dies_before_it_takes_it() -> None:
    recovery = ran()
    recovery.died(crashed=True)
    recovery.next_load()
    number = recovery.file_requested().number
    recovery.died(crashed=True)  # at the version that was brought back
    assert recovery.next_load() == LoadInputs(None, b"newest", number)
    recovery.loaded(replace(TASK, source=GOOD))
    recovery.died(crashed=True)
    assert recovery.next_load() == LoadInputs(None, b"newest", number), "it has not begun yet"


def test_of_a_restart_the_file_is_loaded_as_it_is_now() -> None:
    recovery = ran()
    recovery.restart_requested()
    recovery.died(crashed=False)
    load = recovery.next_load()
    assert load is not None and (load.source, load.snapshot) == (None, b"newest")


def test_a_version_that_crashes_soon_and_again_gives_way_to_the_one_before() -> None:
    clock = Clock()
    recovery = ran(GOOD, NEW, clock=clock)
    for seconds in (3, 600, 3):
        clock.now += seconds
        recovery.died(crashed=True)
        assert recovery.next_load() == LoadInputs(NEW, b"newest", 0), "once, and once more after ten minutes"
        recovery.loaded(replace(TASK, source=NEW))
    clock.now += 3
    recovery.died(crashed=True)
    assert recovery.next_load() == LoadInputs(GOOD, b"newest", 0)
    for _ in range(9):
        recovery.loaded(replace(TASK, source=GOOD))
        recovery.died(crashed=True)
        assert recovery.next_load() == LoadInputs(GOOD, b"newest", 0), (
            "there is no other, and a person asked for it"
        )
    for comes_back in (True, False):
        recovery.loaded(replace(TASK, source=GOOD))
        recovery.died(crashed=True, idle=True)
        assert (recovery.next_load() is not None) is comes_back


def test_a_failure_that_leaves_the_version_before_asks_for_nothing() -> None:
    recovery = ran()
    recovery.began(recovery.file_requested().number)
    assert not recovery.failed(kept=True)
    assert not recovery.failed(kept=True), "one while it runs"


@given(st.lists(st.sampled_from(["died", "handed over", "failed", "saved", "began", "loaded"]), max_size=40))
def test_workers_do_not_die_for_ever(events: list[str]) -> None:
    """Between two saves only so many processes are started, whatever happens to them."""
    recovery = ran(GOOD, NEW)
    loads = 0
    for event in events:
        if event == "saved":
            recovery.file_requested()
            loads = 0
        elif event == "began":
            recovery.began(10**6)
        elif event == "loaded" and recovery.loading:
            recovery.loaded(replace(TASK, source=recovery.good_source or GOOD))
        elif event == "failed":
            recovery.failed(kept=False)
        elif event in ("died", "handed over"):
            recovery.died(crashed=event == "died", idle=True)
            loads += event == "died" and recovery.next_load() is not None
        assert loads <= 8
    recovery.began(10**6)
    for _ in range(8):
        recovery.died(crashed=True)
        last = recovery.next_load()
    assert last is None


def test_whether_a_text_is_still_on_disk(tmp_path: Path) -> None:
    file = tmp_path / "task.py"
    file.write_bytes(b"x = 1\r\n")
    assert is_on_disk({str(file): "x = 1\n"})
    assert not is_on_disk({str(file): "x = 2\n"})
    assert not is_on_disk({str(tmp_path / "gone.py"): ""})

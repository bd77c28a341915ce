"""What a new worker is asked for, along every way down."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from tests.ui.scenes import description, table_scene
from workbench.session.live.versions import LoadInputs, Recovery, is_on_disk

TASK = replace(description(table_scene(1)[0]), source={"push.py": "good"})


def ran() -> Recovery:
    moments: list[bytes] = []
    recovery = Recovery(lambda: moments[-1] if moments else None)
    assert recovery.next_load() == LoadInputs(None, None)
    recovery.loaded(TASK)
    moments += [b"first", b"newest"]
    return recovery


def test_what_ran_comes_back_at_its_newest_moment() -> None:
    recovery = ran()
    recovery.died(file_waits=False)
    assert recovery.next_load() == LoadInputs({"push.py": "good"}, b"newest") and recovery.restoring


def test_a_moment_that_kills_is_not_tried_twice_and_then_the_version_neither() -> None:
    recovery = ran()
    recovery.died(file_waits=False)
    recovery.next_load()
    recovery.died(file_waits=False)
    assert recovery.next_load() == LoadInputs({"push.py": "good"}, None)
    recovery.died(file_waits=False)
    assert recovery.next_load() is None


def test_a_file_that_kills_before_anything_ran_is_waited_for() -> None:
    recovery = Recovery(lambda: None)
    recovery.next_load()
    recovery.died(file_waits=False)
    assert recovery.next_load() is None
    assert recovery.file_requested() == LoadInputs(None, None)


def test_a_new_version_that_kills_gives_way_to_the_last_good_one() -> None:
    recovery = ran()
    recovery.file_requested()
    recovery.died(file_waits=False)
    assert recovery.next_load() == LoadInputs({"push.py": "good"}, b"newest")


def test_a_file_that_waits_is_loaded_at_the_newest_moment_and_if_it_fails_the_last_good_one_is() -> None:
    recovery = ran()
    recovery.died(file_waits=True)
    assert recovery.next_load() == LoadInputs(None, b"newest") and not recovery.restoring
    assert recovery.failed(kept=False)
    assert recovery.next_load() == LoadInputs({"push.py": "good"}, b"newest") and recovery.restoring


def test_a_failure_that_leaves_the_version_before_asks_for_nothing() -> None:
    recovery = ran()
    recovery.file_requested()
    assert not recovery.failed(kept=True)
    assert not recovery.failed(kept=True), "one while it runs"


@given(st.lists(st.sampled_from(["died", "waits", "failed", "asked"]), max_size=30))
def test_workers_do_not_die_for_ever(events: list[str]) -> None:
    recovery = ran()
    loads = 0
    for event in events:
        if event == "asked":
            recovery.restart_requested()
            loads = 0
        elif event == "failed":
            recovery.failed(kept=False)
        else:
            loads = 0 if event == "waits" else loads
            recovery.died(file_waits=event == "waits")
        loads += recovery.next_load() is not None
        assert loads <= 8
    for _ in range(4):
        recovery.died(file_waits=False)
        last = recovery.next_load()
    assert last is None


def test_whether_a_text_is_still_on_disk(tmp_path: Path) -> None:
    file = tmp_path / "task.py"
    file.write_bytes(b"x = 1\r\n")
    assert is_on_disk({str(file): "x = 1\n"})
    assert not is_on_disk({str(file): "x = 2\n"})
    assert not is_on_disk({str(tmp_path / "gone.py"): ""})

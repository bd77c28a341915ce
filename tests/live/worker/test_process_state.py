"""Which settings of the process a version has changed, and whose threads run."""

from __future__ import annotations

import os
import threading

import pytest
import torch

from workbench.live.worker.process_state import changed_settings, read_process_state, some_of, threads_of

VARIABLE = "WORKBENCH_TEST_VARIABLE"


def test_changed_removed_and_added_settings_are_named() -> None:
    before = {"a": 1, "b": 2, "os.environ['OLD']": "1"}
    now = {"a": 1, "b": 3, "c": 4, "os.environ['NEW']": "1"}
    assert changed_settings(before, now) == ["b", "os.environ['OLD']", "os.environ['NEW']"]
    assert changed_settings(now, now) == []
    assert [some_of(["a", "b", "c", "d"][:count]) for count in (1, 2, 4)] == ["a", "a, b", "a, b and 2 more"]


def test_what_a_task_does_to_the_process_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    before = read_process_state()
    assert changed_settings(before, read_process_state()) == []
    kind, mask = torch.get_default_dtype(), os.umask(0)
    try:
        torch.set_default_dtype(torch.float64)
        os.umask(0o7)
        monkeypatch.setenv(VARIABLE, "1")
        monkeypatch.setattr("math.sin", lambda x: x)
        found = {*changed_settings(before, read_process_state())}
    finally:
        torch.set_default_dtype(kind)
        os.umask(mask)
        monkeypatch.undo()
    wanted = {"torch.get_default_dtype()", "os.umask()", f"os.environ[{VARIABLE!r}]", "math.sin"}
    assert found == (wanted if mask != 0o7 else wanted - {"os.umask()"})
    assert changed_settings(before, read_process_state()) == []


def test_a_thread_is_that_of_a_file_if_it_runs_its_code_at_any_depth() -> None:
    begun, over = threading.Event(), threading.Event()
    space = {"begun": begun, "over": over}
    exec(compile("def work():\n    begun.set()\n    over.wait()\n", "/author/task.py", "exec"), space)
    thread = threading.Thread(target=space["work"], name="mine", daemon=True)  # type: ignore[arg-type]
    thread.start()
    begun.wait()
    try:
        (found,) = threads_of({"/author/task.py": ""})
        assert "mine" in found and threads_of({"/author/other.py": ""}) == []
    finally:
        over.set()
        thread.join()
    assert threads_of({"/author/task.py": ""}) == []

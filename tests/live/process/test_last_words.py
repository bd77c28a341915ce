"""Stacks of real processes, read by another process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from workbench.live.process.heartbeat import (
    author_place,
    busy_at,
    death_problem,
    fatal_error,
    hook_of,
    parse_stack,
)

TASK = """import faulthandler, sys, ctypes
def deep():
    {what}
def evaluate():
    deep()
evaluate()
"""


def dump_of(file: Path, what: str) -> str:
    file.write_text(TASK.format(what=what))
    done = subprocess.run([sys.executable, "-X", "faulthandler", str(file)], capture_output=True, text=True)
    return done.stderr


@pytest.mark.parametrize("name", ["task.py", "Äufgabe 工 'x'.py"])
def test_the_authors_line_is_found_for_any_file_name(child_process: None, tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    frames = parse_stack(dump_of(file, "faulthandler.dump_traceback(all_threads=False)"))
    assert [frame.name for frame in frames] == ["deep", "evaluate", "<module>"]
    assert author_place(frames, [str(file)])[:2] == (str(file), 3)
    assert hook_of(frames) == "evaluate"
    assert author_place(frames, ["/elsewhere.py"]) == (None, None, None)


def test_a_long_call_is_shown_with_the_text_that_runs(child_process: None, tmp_path: Path) -> None:
    file = tmp_path / "task.py"
    dump = dump_of(file, "faulthandler.dump_traceback(all_threads=False)")
    ran = file.read_text()
    file.write_text(ran.replace("faulthandler.dump_traceback", "edited_since"))
    busy = busy_at(9.0, "stepping", dump, [str(file)], False, texts={str(file): ran})
    assert (busy.file, busy.line) == (str(file), 3)
    assert "dump_traceback" in (busy.code or "") and "edited_since" not in busy.traceback


def test_a_crash_is_reported_with_its_kind(child_process: None, tmp_path: Path) -> None:
    file = tmp_path / "task.py"
    dump = dump_of(file, "ctypes.string_at(0)")
    assert fatal_error(dump) == "Segmentation fault"
    problem = death_problem("was killed by SIGSEGV", "stepping", dump, [str(file)], "last words", {})
    assert problem.message == "the worker process was killed by SIGSEGV (Segmentation fault) in evaluate"
    assert (problem.file, problem.line, problem.code) == (str(file), 3, "ctypes.string_at(0)")
    assert problem.traceback.startswith("Traceback") and problem.traceback.endswith("last words")

"""Stacks of real processes, read by another process."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from workbench.live.process.heartbeat import (
    Doing,
    author_place,
    busy_at,
    death_problem,
    fatal_error,
    hook_of,
    own_files_of,
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


STACK = """Fatal Python error: Segmentation fault

Thread 0x1 (most recent call first):
  File "/lab/other.py", line 1 in wrong

Current thread 0x2 (most recent call first):
  File "/usr/lib/torch.py", line 9 in native
  File "/lab/helper.py", line 2 in deep
  File "/lab/task.py", line 3 in evaluate
  File "/x/workbench/envs/task_env.py", line 4 in step
  File "/x/workbench/app/worker/main_loop.py", line 5 in run
"""
TEXTS = {"/lab/helper.py": "one\n  two  \n", "/lab/task.py": "1\n2\n3\n"}


def test_the_innermost_line_of_the_author_is_named_and_ours_are_left_out() -> None:
    busy = busy_at(9.0, "stepping", STACK, ["/lab/task.py", "/lab/helper.py"], False, texts=TEXTS)
    assert (busy.file, busy.line, busy.code, busy.doing) == ("/lab/helper.py", 2, "two", "in evaluate")
    files = re.findall(r'File "([^"]*)"', busy.traceback)
    assert files == ["/lab/task.py", "/lab/helper.py", "/usr/lib/torch.py"]
    outer = busy_at(9.0, "stepping", STACK, ["/lab/task.py"], False, texts=TEXTS)
    assert (outer.file, outer.line, outer.code) == ("/lab/task.py", 3, "3")
    gone = busy_at(9.0, "stepping", STACK, ["/lab/task.py"], False, texts={"/lab/task.py": "1\n"})
    assert (gone.line, gone.code) == (3, None), "the text is shorter now"


@pytest.mark.parametrize("dump", ["", STACK])
def test_slow_work_of_ours_is_told_from_that_of_a_hook(dump: str) -> None:
    def seen(doing: Doing, ignores: bool = False, held: bool = False) -> tuple[bool, ...]:
        busy = busy_at(9.0, doing, dump, [], ignores, held)
        return busy.drawing, busy.getting_ready, busy.ignores_interrupt, busy.held, busy.awaited

    ours = not dump
    assert seen("drawing") == (ours, False, False, False, False)
    assert seen("warming up") == seen("starting") == (False, ours, False, False, False)
    assert seen("stepping", ignores=True) == (False, False, True, False, False)
    assert seen("stepping", held=True) == (False, False, False, True, False)
    assert seen("waiting for a debugger", held=True) == (False, False, False, True, True)


def test_a_death_has_its_place_in_the_text_that_ran_and_its_last_words() -> None:
    problem = death_problem("was killed by SIGSEGV", "stepping", STACK, ["/lab/task.py"], "", TEXTS)
    assert (problem.stage, problem.file, problem.line, problem.code) == ("worker", "/lab/task.py", 3, "3")
    assert "printed" not in problem.traceback
    left = death_problem("ended with exit code 3", "loading", "os._exit(3)\n", ["/lab/task.py"], "bye", {})
    assert "os._exit(3)" in left.message and "loading" in left.message and left.file is None
    assert left.traceback.endswith("bye")
    idle = death_problem("was killed by SIGKILL", None, "", [], "", {})
    assert idle.message.endswith("SIGKILL") and idle.traceback == ""
    assert own_files_of(["/lab/a.py", "/lab/task.py"], Path("/lab/task.py")) == ["/lab/task.py", "/lab/a.py"]
    assert own_files_of(["/lab/a.py"], None) == ["/lab/a.py"]

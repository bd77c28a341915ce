"""Saving good and broken versions of the file under a running session."""

# The fixture hands over a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drive.session import save, step, wait_until
from workbench.app.session import Session
from workbench.live.commands import ReloadFile


def edited(text: str, hook: str, line: str) -> tuple[str, int]:
    """`text` with `line` inserted at the start of method `hook`; and the number of that line."""
    lines = text.splitlines()
    start = next(i for i, code in enumerate(lines) if code.strip().startswith(f"def {hook}("))
    body = start
    while not lines[body].rstrip().endswith(":"):
        body += 1
    body += 1
    if lines[body].strip().startswith('"""'):
        while not (
            lines[body].rstrip().endswith('"""') and (body > start + 1 or lines[body].count('"""') == 2)
        ):
            body += 1
        body += 1
    lines.insert(body, "        " + line)
    return "\n".join(lines) + "\n", body + 1


@pytest.fixture(scope="module")
def good(task_file: Path, session: Session) -> str:
    return task_file.read_text()


@pytest.fixture(autouse=True)
def good_again(session: Session, task_file: Path, good: str) -> Iterator[None]:
    yield
    save(session, task_file, good)


def test_a_good_edit_replaces_the_running_version(session: Session, task_file: Path, good: str) -> None:
    session.change(selected_env=1)
    before = session.view()
    text, _ = edited(good, "evaluate", "import torch as _t; self.note = _t.ones(self.num_envs)")
    text = text.replace('"success":', '"edited": self.note, "success":').replace(
        "success=", "edited=self.note, success=", 1
    )
    task_file.write_text(text)
    view = wait_until(session, lambda v: v.task_serial > before.task_serial, "the new version")
    assert "edited" in view.step.evaluate
    assert view.problem is None and not view.stale
    assert view.selected_env == 1 and view.seed == before.seed
    assert view.task.source_hash != before.task.source_hash
    task_file.write_text(good)
    wait_until(session, lambda v: v.task_serial > view.task_serial, "the old version again")


BROKEN = [
    ("evaluate", "1 / 0", "evaluate", "ZeroDivisionError"),
    ("compute_dense_reward", "raise ValueError('no reward')", "reward", "no reward"),
    ("_load_scene", "self.nothing_there", "build", "nothing_there"),
    ("_get_obs_extra", "assert False, 'obs'", "observation", "obs"),
    ("_initialize_episode", "breakpoint()", "reset", "--debug"),
    ("evaluate", "return {'success': __import__('torch').zeros((2, 1), dtype=bool)}", "returns", "evaluate"),
]


@pytest.mark.parametrize(
    ("hook", "line", "stage", "says"), BROKEN, ids=[f"{b[0]}-{b[1][:12]}" for b in BROKEN]
)
def test_a_broken_hook_is_shown_with_its_line_and_the_last_good_version_runs_on(
    session: Session, task_file: Path, good: str, hook: str, line: str, stage: str, says: str
) -> None:
    before = session.view().task_serial
    text, number = edited(good, hook, line)
    task_file.write_text(text)
    view = wait_until(session, lambda v: v.problem is not None, "the problem")
    assert view.problem.stage == stage and says in view.problem.message
    assert view.problem.file == str(task_file) and view.problem.line is not None
    if "return" not in line:
        assert (view.problem.line, view.problem.code) == (number, line)
        assert "Traceback" in view.problem.traceback
    assert view.stale and view.task_serial == before and view.refused is view.problem
    step(session)
    assert session.view().problem is not None, "the file is still broken"
    assert save(session, task_file, good).refused is None


@pytest.mark.parametrize(
    ("text", "stage", "line"),
    [("def broken(:\n    pass\n", "syntax", 1), ("x = 1\n", "import", None)],
    ids=["syntax", "no-task"],
)
def test_a_file_that_does_not_import_is_shown_with_its_line(
    session: Session, task_file: Path, good: str, text: str, stage: str, line: int | None
) -> None:
    task_file.write_text(text)
    view = wait_until(session, lambda v: v.problem is not None, "the problem")
    assert view.problem.stage == stage
    assert line is None or view.problem.line == line


def test_a_module_next_to_the_task_is_followed_too(session: Session, task_file: Path, good: str) -> None:
    beside = task_file.parent / "beside.py"
    beside.write_text("SHIFT = 1\n")
    before = session.view().task_serial
    imported = "from __future__ import annotations\nfrom beside import SHIFT  # noqa"
    task_file.write_text(good.replace("from __future__ import annotations", imported))
    view = wait_until(session, lambda v: v.task_serial > before, "the version with a module")
    assert str(beside) in view.task.source_files
    beside.write_text("SHIFT = 2\n")
    wait_until(session, lambda v: v.task_serial > view.task_serial, "the edited module")
    beside.write_text("SHIFT = \n")
    view = wait_until(session, lambda v: v.problem is not None, "the broken module")
    assert (view.problem.file, view.problem.line) == (str(beside), 1)


def test_a_file_that_becomes_a_link_to_itself_kills_no_worker(
    session: Session, task_file: Path, good: str
) -> None:
    before, worker = session.view(), session.worker_pid
    link = task_file.with_name("link.py")
    link.symlink_to(task_file)
    link.replace(task_file)
    view = wait_until(session, lambda v: v.problem is not None, "the banner")
    assert str(task_file) in view.problem.message
    link.write_text(good)
    link.replace(task_file)
    view = wait_until(session, lambda v: v.problem is None, "the banner's end")
    assert view.task.source_hash == before.task.source_hash and session.worker_pid == worker


def test_a_killed_worker_is_replaced_with_the_last_good_version(
    session: Session, task_file: Path, good: str
) -> None:
    before = session.view()
    os.kill(session.worker_pid, signal.SIGKILL)
    view = wait_until(session, lambda v: v.problem is not None and v.problem.stage == "worker", "the death")
    assert "SIGKILL" in view.problem.message
    view = wait_until(session, lambda v: v.task_serial > before.task_serial, "the version again")
    assert view.task.source_hash == before.task.source_hash
    session.do(ReloadFile())
    wait_until(session, lambda v: v.problem is None, "the banner's end")


def test_a_fixed_file_replaces_a_worker_that_hangs(session: Session, task_file: Path, good: str) -> None:
    before = session.view().task_serial
    text, _ = edited(good, "evaluate", "while True: pass")
    task_file.write_text(text)
    wait_until(session, lambda v: v.activity.startswith("trying"), "the hanging load")
    hanging = session.worker_pid
    task_file.write_text(good)
    view = wait_until(session, lambda v: v.task_serial > before, "the mended version")
    assert view.problem is None and session.worker_pid != hanging

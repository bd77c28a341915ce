"""Saving good and broken versions of the file under a running session."""

# The fixture hands over a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drive.session import save, step, wait_until
from workbench.app.session import Session


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
    [("def broken(:\n    pass\n", "syntax", 1), ("# to be written\n", "import", None)],
    ids=["syntax", "no-task"],
)
def test_a_file_of_which_no_code_ran_is_shown_with_its_line_and_costs_no_process(
    session: Session, task_file: Path, good: str, text: str, stage: str, line: int | None
) -> None:
    worker = session.worker_pid
    task_file.write_text(text)
    view = wait_until(session, lambda v: v.problem is not None, "the problem")
    assert (view.problem.stage, view.problem.line) == (stage, line)
    save(session, task_file, good)
    assert session.worker_pid == worker, session.view().reload


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

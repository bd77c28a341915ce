"""``workbench new``: its output, its questions in a terminal, and that the new task passes its checks."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.drive.commands import exit_code
from workbench.task.new_task import TEMPLATES


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = exit_code(*arguments)
    printed = capsys.readouterr()
    return code, printed.out, printed.err


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("template", [template.name for template in TEMPLATES])
def test_a_new_task_breaks_no_rule(
    place: Path, capsys: pytest.CaptureFixture[str], template: str, renderer: None
) -> None:
    code, out, _ = run(capsys, "new", "stack_two", "--from", template)
    assert code == 0 and out.splitlines() == [
        "stack_two.py has the task StackTwo-v1, class StackTwoEnv.",
        "Open it:  workbench open stack_two.py",
    ]
    code, out, _ = run(capsys, "check", "stack_two.py", "--seeds", "8", "--workers", "1", "--fail-on", "warn")
    assert code == 0 and "StackTwo-v1: " in out and ", 0 broken, " in out and "not decided" not in out


def test_the_first_template_is_the_default_and_an_existing_file_is_refused(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = run(capsys, "new")
    assert (code, out) == (2, "") and "workbench new" in err, "a name is asked for only in a terminal"
    assert run(capsys, "new", "first")[0] == 0
    text = (place / "first.py").read_text()
    assert text.startswith('"""The least that a task can be')
    code, out, err = run(capsys, "new", "first", "--from", "tabletop")
    assert (code, out) == (2, "") and err.startswith("first.py exists already and is not overwritten")
    assert (place / "first.py").read_text() == text


class Terminal:
    """``workbench new`` in a pseudo-terminal."""

    def __init__(self, folder: Path, *words: str) -> None:
        self._ours, theirs = os.openpty()
        self._printed = ""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "workbench.cli.main", "new", *words],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "NO_COLOR": "1", "TERM": "dumb"},
        )
        os.close(theirs)

    def says(self, words: str) -> str:
        """Wait until these words were printed; returns all output since the last call."""
        ends_at = time.monotonic() + 60
        while words not in self._printed:
            assert select.select([self._ours], [], [], ends_at - time.monotonic())[0], self._printed
            try:
                self._printed += os.read(self._ours, 4096).decode()
            except OSError:  # the process has ended
                break
        assert words in self._printed, self._printed
        printed, self._printed = self._printed, ""
        return printed

    def type(self, words: str) -> None:
        os.write(self._ours, words.encode())

    def close(self) -> int:
        code = self.process.wait(60)
        os.close(self._ours)
        return code


def test_in_a_terminal_template_and_name_are_asked_for_until_valid(place: Path, child_process: None) -> None:
    (place / "taken.py").write_text("mine")
    terminal = Terminal(place)
    printed = terminal.says("Enter: minimal): ")
    listed = [line.split(maxsplit=2) for line in printed.splitlines() if line[:2] == "  "]
    assert listed == [[str(n), one.name, one.about] for n, one in enumerate(TEMPLATES, 1)]
    terminal.type(f"{len(TEMPLATES) + 1}\n")
    assert f"Type a number from 1 to {len(TEMPLATES)}" in terminal.says("): ")
    terminal.type("2\n")
    terminal.says("Name of the task, such as stack_two: ")
    terminal.type("taken\n")
    terminal.says("taken.py exists already")
    terminal.type("push it\n")
    terminal.says("such as push_it.")
    terminal.type("push_it\n")
    terminal.says("Open it:  workbench open push_it.py")
    assert terminal.close() == 0
    assert "class PushItEnv(BaseEnv)" in (place / "push_it.py").read_text()
    assert "compute_dense_reward" in (place / "push_it.py").read_text()


def test_cancelling_the_questions_writes_no_file(place: Path, child_process: None) -> None:
    terminal = Terminal(place, "--from", "PickCube-v1")
    terminal.says("Name of the task")
    terminal.type("\x04")
    terminal.says("Nothing was written.")
    assert terminal.close() == 2 and list(place.iterdir()) == []

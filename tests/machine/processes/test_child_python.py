"""The workbench's Python processes do not import from the current folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from workbench.machine.processes.child_environment import child_environment, python_command
from workbench.machine.processes.own_path import without_current_folder

PACKAGE = Path(__file__).parents[3] / "workbench"


@pytest.mark.parametrize("python_path", [None, ":", "/nowhere::/elsewhere"])
def test_no_child_has_the_current_folder_on_its_path(
    child_process: None, python_path: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if python_path is not None:
        monkeypatch.setenv("PYTHONPATH", python_path)
    program = "import json, os, sys; print(json.dumps([os.path.abspath(entry) for entry in sys.path]))"
    (tmp_path / "shows_path.py").write_text(program)
    result = subprocess.run(
        python_command("-c", program), cwd=tmp_path, env=child_environment(), check=True, capture_output=True
    )
    path = json.loads(result.stdout)
    assert str(tmp_path.resolve()) not in path
    if python_path is not None and "/nowhere" in python_path:
        assert "/nowhere" in path, "entries of PYTHONPATH must stay"


def test_the_command_itself_leaves_the_current_folder_out(
    child_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    here = os.getcwd()
    assert without_current_folder([here, "/a", "", "."], "") == ["/a"]
    assert without_current_folder([here, "/a"], f"/a:{here}") == [here, "/a"], (
        "a current folder named in PYTHONPATH must stay"
    )
    assert without_current_folder([here, "/a"], ".:/a") == [here, "/a"]
    monkeypatch.chdir(PACKAGE.parent)
    assert without_current_folder([str(PACKAGE.parent), "/a"], "") == [str(PACKAGE.parent), "/a"]
    result = subprocess.run(
        [sys.executable, "-c", "import os, sys, workbench.cli.main; print(os.getcwd() in sys.path, '' in sys.path)"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": ":"}, check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert result.stdout.split() == ["False", "False"]


def test_a_deleted_current_folder_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    assert without_current_folder(["", "/a"], "") == ["", "/a"]

"""Every Python process of the workbench starts through one function, and none imports from the current folder."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from workbench.machine.processes.child_python import child_environment, python_command
from workbench.machine.processes.own_path import without_current_folder

PACKAGE = Path(__file__).parents[3] / "workbench"
ITSELF = PACKAGE / "machine" / "processes" / "child_python.py"
SHOWN = {
    PACKAGE / "machine" / "doctor.py",
    PACKAGE / "machine" / "maniskill_installed.py",
    PACKAGE / "authoring" / "loading" / "load.py",
    PACKAGE / "authoring" / "loading" / "reference.py",
}
"""They tell a person which interpreter this is."""
STARTERS = {
    ("sys", "executable"),
    ("sys", "_base_executable"),
    ("multiprocessing", None),
    ("multiprocessing.pool", None),
    ("multiprocessing.managers", None),
    ("multiprocessing.shared_memory", None),
    ("multiprocessing.process", None),
    ("multiprocessing.context", None),
    ("concurrent.futures", "ProcessPoolExecutor"),
    ("concurrent.futures.process", None),
    ("torch.multiprocessing", None),
}


def starters_in(text: str) -> set[str]:
    """Names in a module with which a Python process could be started past `child_python`."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if (alias.name, None) in STARTERS}
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                if {(node.module, None), (node.module, alias.name)} & STARTERS:
                    found.add(f"{node.module}.{alias.name}")
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if (node.value.id, node.attr) in STARTERS or node.attr == "ProcessPoolExecutor":
                found.add(f"{node.value.id}.{node.attr}")
    return found


def test_only_one_module_starts_python_processes() -> None:
    offenders = {
        str(path.relative_to(PACKAGE)): found
        for path in sorted(PACKAGE.rglob("*.py"))
        if path not in {ITSELF, *SHOWN} and (found := starters_in(path.read_text()))
    }
    assert not offenders


@pytest.mark.parametrize(
    "text",
    [
        "import sys\nsys.executable",
        "from sys import executable",
        "import multiprocessing",
        "from multiprocessing import get_context",
        "from concurrent.futures import ProcessPoolExecutor",
        "import concurrent.futures as f\nf.ProcessPoolExecutor()",
    ],
)
def test_that_rule_sees_each_way_to_start_one(text: str) -> None:
    assert starters_in(text)
    assert not starters_in("from multiprocessing.connection import Connection\nimport sys\nsys.path")


@pytest.mark.parametrize("python_path", [None, "", ":", ":/nowhere", "/nowhere:", "/nowhere::/elsewhere"])
def test_no_child_has_the_current_folder_on_its_path(
    child_process: None, python_path: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if python_path is not None:
        monkeypatch.setenv("PYTHONPATH", python_path)
    program = "import json, os, sys; print(json.dumps([os.path.abspath(entry) for entry in sys.path]))"
    (tmp_path / "shows_path.py").write_text(program)
    said = subprocess.run(
        python_command("-c", program), cwd=tmp_path, env=child_environment(), check=True, capture_output=True
    )
    path = json.loads(said.stdout)
    assert str(tmp_path.resolve()) not in path
    if python_path is not None and "/nowhere" in python_path:
        assert "/nowhere" in path, "what is named in PYTHONPATH stays"


def test_the_command_itself_leaves_the_current_folder_out(
    child_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    here = os.getcwd()
    assert without_current_folder([here, "/a", "", "."], "") == ["/a"]
    assert without_current_folder([here, "/a"], f"/a:{here}") == [here, "/a"], "named in PYTHONPATH"
    assert without_current_folder([here, "/a"], ".:/a") == [here, "/a"]
    monkeypatch.chdir(PACKAGE.parent)
    assert without_current_folder([str(PACKAGE.parent), "/a"], "") == [str(PACKAGE.parent), "/a"]
    said = subprocess.run(
        [sys.executable, "-c", "import os, sys, workbench.cli.main; print(os.getcwd() in sys.path, '' in sys.path)"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": ":"}, check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert said.stdout.split() == ["False", "False"]


def test_a_current_folder_that_is_gone_is_no_reason_to_fail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    assert without_current_folder(["", "/a"], "") == ["", "/a"]

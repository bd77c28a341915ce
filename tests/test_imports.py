"""Which part of the workbench may import which."""

from __future__ import annotations

import ast
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "workbench"
BELOW = {
    "ui": {"session", "jobs", "authoring", "recording", "core", "machine"},
    "session": {"jobs", "authoring", "recording", "core", "machine"},
    "jobs": {"authoring", "core", "machine"},
    "authoring": {"core", "machine"},
    "recording": {"jobs", "core", "machine"},
    "core": {"machine"},
    "machine": set(),
}
"""Each part, and those that it may import. Modules beside them are the commands, which nothing imports."""
OF_NO_PART = {"web_assets"}
"""Where the files of the page are."""


def imported(file: Path) -> Iterator[tuple[int, str]]:
    """Line and name below the package; also within functions, and of types alone."""
    for node in ast.walk(ast.parse(file.read_text())):
        names: list[str] = []
        if isinstance(node, ast.ImportFrom) and node.module == "workbench":
            names = [f"workbench.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        for name in names:
            if name.startswith("workbench."):
                yield getattr(node, "lineno", 0), name.split(".")[1]


@pytest.mark.parametrize("part", BELOW)
def test_imports_run_one_way(part: str) -> None:
    files = list((PACKAGE / part).rglob("*.py"))
    assert files
    wrong = [
        f"{file.relative_to(PACKAGE)}:{line} imports {name}"
        for file in files
        for line, name in imported(file)
        if name not in {part, *BELOW[part], *OF_NO_PART}
    ]
    assert wrong == []


def test_the_page_is_the_only_part_that_knows_viser() -> None:
    knowing = {
        file.relative_to(PACKAGE).parts[0]
        for file in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if (isinstance(node, ast.Import) and any(a.name.split(".")[0] == "viser" for a in node.names))
        or (isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "viser")
    }
    assert knowing == {"ui"}


TESTS = Path(__file__).parent


def test_nothing_is_imported_from_a_test() -> None:
    """Whoever changes a test would change others, and the file would be run for a helper of a line."""
    names = {file.stem for file in TESTS.rglob("*.py") if file.name.startswith("test_")}
    assert "test_imports" in names
    wrong = [
        f"{file.relative_to(TESTS)}:{node.lineno} imports {name}"
        for file in TESTS.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, (ast.Import, ast.ImportFrom))
        for name in [getattr(node, "module", None), *(alias.name for alias in node.names)]
        if name and set(name.split(".")) & names
    ]
    assert wrong == []


def test_nothing_that_a_run_wrote_lies_at_the_top(child_process: None) -> None:
    top = PACKAGE.parent
    if not (top / ".git").exists():
        pytest.skip("not a checkout")
    listed = subprocess.run(["git", "ls-files"], cwd=top, check=True, capture_output=True, text=True).stdout
    assert {path.split("/")[0] for path in listed.splitlines()} == {
        ".ci", ".gitignore", "Makefile", "README.md", "constraints.txt", "pyproject.toml", "tasks", "tests",
        "web_assets", "workbench",
    }  # fmt: skip

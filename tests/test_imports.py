"""Which folder of the workbench may import which."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import tomllib
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PACKAGE = Path(__file__).parents[1] / "workbench"
TESTS = Path(__file__).parent
ORDER: tuple[str, ...] = (
    *(
        "machine",
        "envs",
        "pictures",
        "source",
        "task",
        "jobs",
        "planning",
        "episodes",
        "actions",
        "page",
        "trust",
        "live",
    ),
    *(
        "record",
        "cameras",
        "checks",
        "hands",
        "library",
        "review",
        "rescore",
        "solve",
        "share",
        "sweep",
        "start",
        "app",
    ),
    "cli",
)
"""The folders, as the architecture page draws them: each imports only those before it."""


def modules() -> dict[str, Path]:
    """File of each module, by its slash-separated name in the package; without ``__init__``."""
    files = (file for file in PACKAGE.rglob("*.py") if file.name != "__init__.py")
    return {file.relative_to(PACKAGE).with_suffix("").as_posix(): file for file in files}


MODULES = modules()


@cache
def import_statements(file: Path) -> tuple[ast.Import | ast.ImportFrom, ...]:
    """Import statements, also in functions and for types only. Cached: parsing the whole package takes seconds."""
    return tuple(
        node
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
    )


def imported(file: Path) -> Iterator[tuple[int, str]]:
    """Line and slash-separated module name in the package, for each import."""
    for node in import_statements(file):
        names: list[str] = []
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "workbench":
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names if alias.name.split(".")[0] == "workbench"]
        for name in names:
            path = name.replace(".", "/").removeprefix("workbench/")
            if path not in MODULES:
                path = path.rsplit("/", 1)[0]
            if path in MODULES:
                yield node.lineno, path


@cache
def imports() -> dict[str, tuple[tuple[int, str], ...]]:
    """Imports of each module. A function: at import time every test process would parse the whole package."""
    return {module: tuple(imported(file)) for module, file in MODULES.items()}


def folder_of(module: str) -> str:
    """Folder of a module. Modules at the top of the package are the public ones (`workbench.commands`)."""
    return module.split("/")[0] if "/" in module else ""


def test_each_folder_imports_only_folders_before_it() -> None:
    assert {folder_of(module) for module in MODULES} == {"", *ORDER}
    wrong = [
        f"{module}:{line} imports {name}"
        for module in MODULES
        if (folder := folder_of(module))
        for line, name in imports()[module]
        if folder_of(name) not in ORDER[: ORDER.index(folder) + 1]
        and not (name == "commands" and folder in ("app", "cli"))
    ]
    assert wrong == []


def test_there_are_no_circular_imports() -> None:
    """Not even for types only."""
    done: set[str] = set()

    def reach(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, (
            f"circular import: {' imports '.join((*path[path.index(module) :], module))}"
        )
        if module not in done:
            for _, name in imports()[module]:
                reach(name, (*path, module))
            done.add(module)

    for module in MODULES:
        reach(module, ())
    assert "machine/loop" in done


def reached_from(*modules: str) -> set[str]:
    reached, waiting = set[str](), list(modules)
    while waiting:
        if (module := waiting.pop()) not in reached:
            reached.add(module)
            waiting += [name for _, name in imports()[module]]
    return reached


def test_state_jobs_and_workers_do_not_import_the_page() -> None:
    """So they run where viser cannot, and their tests need no page."""
    with_viser = {
        module
        for module, file in MODULES.items()
        for node in import_statements(file)
        for name in [getattr(node, "module", None) or "", *(alias.name for alias in node.names)]
        if name.split(".")[0] == "viser"
    }
    assert "app/live_page" in with_viser
    jobs = [module for module in MODULES if module.endswith("/job")]
    assert len(jobs) > 3
    assert not with_viser & reached_from(
        "app/session", "review/state", "app/worker/main_loop", "record/gym_wrapper", *jobs
    )


def test_every_imported_package_is_a_direct_dependency() -> None:
    """A package that only another dependency installs may be missing, as scipy without ManiSkill."""
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    ours = {canonicalize_name(Requirement(line).name) for line in project["dependencies"]}
    # From extras, and the workbench itself.
    ours |= {"mani-skill", "mani-skill-nightly", "debugpy", "ray", "maniskill-workbench"}
    brought_by = packages_distributions()
    names = {
        name.split(".")[0]
        for file in MODULES.values()
        for node in import_statements(file)
        for name in [getattr(node, "module", None), *(alias.name for alias in node.names)]
        if name and (isinstance(node, ast.Import) or name == node.module)
    }
    # pydevd is part of debugpy; rerun before 0.41 is in a folder that its metadata does not list.
    names -= {*sys.stdlib_module_names, "pydevd", "workbench", "rerun", "rerun_cli"}
    assert "scipy" in names
    wanting = {name for name in names if not ours & set(map(canonicalize_name, brought_by.get(name, ())))}
    assert wanting == set()


@pytest.mark.thorough
def test_nothing_is_imported_from_a_test() -> None:
    """A change of one test could affect others, and importing a helper would run the whole test file."""
    files = [*TESTS.rglob("*.py")]
    names = {file.stem for file in files if file.name.startswith("test_")}
    assert "test_imports" in names
    # Parsing the files would take seconds.
    statement = re.compile(r"^ *(?:from [\w.]+ )?import (?:\([^)]*\)|.*)", re.MULTILINE)
    wrong = [
        f"{file.relative_to(TESTS)}: {found}"
        for file in files
        for found in statement.findall(file.read_text())
        if names & {*re.findall(r"\w+", found)}
    ]
    assert wrong == []


def test_no_output_of_a_run_is_at_the_top_level(child_process: None) -> None:
    top = PACKAGE.parent
    if not (top / ".git").exists():
        pytest.skip("not a checkout")
    listed = subprocess.run(["git", "ls-files"], cwd=top, check=True, capture_output=True, text=True).stdout
    assert {path.split("/")[0] for path in listed.splitlines()} == {
        ".ci", ".gitignore", "Containerfile", "Makefile", "README.md", "constraints.txt", "pyproject.toml", "tasks", "tests",
        "web_assets", "workbench",
    }  # fmt: skip

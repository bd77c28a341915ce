"""Fixtures: task files for one test, and a process whose modules are restored afterwards."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from textwrap import dedent

import pytest

from tests.task.registered import TABLES, registered
from workbench.task import load

HEADER = """\
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import register_env
"""

Write = Callable[..., Path]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path.resolve()


@pytest.fixture
def write(folder: Path) -> Write:
    """Write a file in the author's folder; with `task=True` below the two imports that every task has."""

    def write_file(name: str, text: str, task: bool = False) -> Path:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text((HEADER if task else "") + dedent(text))
        return path

    return write_file


@pytest.fixture
def clean_process() -> Iterator[None]:
    """Undo what a test loaded: modules, finders and registrations are global to the process."""
    modules, finders, path = dict(sys.modules), list(sys.meta_path), list(sys.path)
    loads = dict(load._loads)
    tables = registered()
    yield
    for name in set(sys.modules) - set(modules):
        file = getattr(sys.modules[name], "__file__", None)
        # A test's own files, also helpers that a policy imported: another test may have one of the same name.
        if file is not None and file.startswith(tempfile.gettempdir()):
            del sys.modules[name]
    # A file of an installed package removes that package's modules while it is open.
    sys.modules.update(
        {name: module for name, module in modules.items() if sys.modules.get(name) is not module}
    )
    sys.meta_path[:], sys.path[:] = finders, path
    load._loads.clear()
    load._loads.update(loads)
    for table, before in zip(TABLES, tables, strict=True):
        table.clear()
        table.update(before)

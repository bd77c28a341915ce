"""Copying an installed task into a user's folder rewrites what depends on its location, and nothing else."""

from __future__ import annotations

import difflib
from pathlib import Path

import mani_skill.envs.tasks
import pytest

from workbench.task.copy import CannotCopy, copied_text, copy_task

TASKS = Path(mani_skill.envs.tasks.__path__[0])
TEXT = '''"""A task."""

from __future__ import annotations

import os
from ..base import Base, other
from . import sibling
from .deep.module import (
    name,
)


@register_env("Näh-Task-v1", max_episode_steps=5)
@utils.register_env(uid="Other", override=True)
class Task(Base):
    assets = f"{os.path.dirname(__file__)}/ä" + __file__
'''
COPIED = '''"""A task."""

from __future__ import annotations

import pack.sub.inner.task as installed_task  # its files are there
import os
from pack.sub.base import Base, other
from pack.sub.inner import sibling
from pack.sub.inner.deep.module import (
    name,
)


@register_env("MyNäh-Task2-v1", max_episode_steps=5)
@utils.register_env(uid="MyOther2", override=True)
class Task(Base):
    assets = f"{os.path.dirname(installed_task.__file__)}/ä" + installed_task.__file__
'''


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    inner = tmp_path / "site" / "pack" / "sub" / "inner"
    inner.mkdir(parents=True)
    for folder in (inner, inner.parent, inner.parent.parent):
        (folder / "__init__.py").touch()
    return inner / "task.py"


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_only_imports_ids_and_paths_of_its_own_are_rewritten(installed: Path, end: str) -> None:
    text, ids = copied_text(installed, TEXT.replace("\n", end), 2)
    assert text == COPIED.replace("\n", end)
    assert ids == (("Näh-Task-v1", "MyNäh-Task2-v1"), ("Other", "MyOther2"))


def test_a_copy_never_overwrites_a_file(installed: Path, tmp_path: Path) -> None:
    installed.write_text(TEXT)
    folder = tmp_path / "mine"
    with pytest.raises(CannotCopy, match="there is no folder"):
        copy_task(installed, folder)
    folder.mkdir()
    (folder / "task.py").write_text("mine")
    copied = copy_task(installed, folder)
    assert copied.file == folder / "task_2.py" and copied.file.read_text() == COPIED
    assert copy_task(installed, folder).file.name == "task_3.py"
    assert (folder / "task.py").read_text() == "mine"
    assert sorted(path.name for path in folder.iterdir()) == ["task.py", "task_2.py", "task_3.py"]


def test_every_maniskill_task_file_is_copied_with_few_changes_or_refused_with_a_reason() -> None:
    copied = refused = 0
    for file in sorted(TASKS.rglob("*.py")):
        text = file.read_text()
        if "register_env(" not in text or file.name == "__init__.py":
            continue
        try:
            new, ids = copied_text(file, text)
        except CannotCopy as reason:
            assert "line" in str(reason)
            refused += 1
            continue
        compile(new, str(file), "exec")
        assert ids and "from ." not in new
        changed = [line for line in difflib.ndiff(text.splitlines(), new.splitlines()) if line[:1] in "+-"]
        assert len(changed) <= 2 * (len(ids) + text.count("__file__") + text.count("from .") + 1)
        copied += 1
    assert copied > 40 and refused < 3, (copied, refused)

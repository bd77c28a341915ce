"""An author's file with the name of a library: imports still get the library, and the author is warned."""

from __future__ import annotations

import importlib
import sys

import pytest

from tests.drive.task_files import Write
from workbench.actions.policy import load_policy
from workbench.task.load import load_task

pytestmark = pytest.mark.thorough

TASK = """
@register_env("AuthorNamed-v1", max_episode_steps=5)
class NamedEnv(BaseEnv):
    pass
"""
NOT_IMPORTED = ("colorsys", "sched", "sympy", "jinja2")
"""Modules of the standard library and of our dependencies that are not imported yet."""


@pytest.fixture
def not_imported() -> tuple[str, ...]:
    for name in NOT_IMPORTED:
        for loaded in [key for key in sys.modules if key.partition(".")[0] == name]:
            del sys.modules[loaded]
    return NOT_IMPORTED


def plant(write: Write, *names: str) -> None:
    for name in names:
        write(f"{name}.py", "raise RuntimeError('the author\\'s')\n")


@pytest.mark.slow
def test_a_librarys_name_gives_the_library_wherever_it_is_imported(
    write: Write, not_imported: tuple[str, ...]
) -> None:
    plant(write, "numpy", *not_imported)
    path = write("push.py", "import numpy, helper\n" + TASK, task=True)
    helper = write("helper.py", "SIZE = 1\n")
    task = load_task(str(path))
    for name in not_imported:
        assert "RuntimeError" not in str(importlib.import_module(name).__file__)
        assert not str(importlib.import_module(name).__file__).startswith(str(path.parent))
    assert sys.modules[task.cls.__module__].helper.__file__ == str(helper), (
        "other names are found next to the file"
    )
    assert task.source_files == (path, helper)


@pytest.mark.parametrize("name", ["sapien", "torch", "numpy", "random", "sympy", "mani_skill", "workbench"])
def test_a_task_file_may_have_the_name_of_a_library(write: Write, name: str) -> None:
    library = sys.modules.get(name)
    path = write(f"{name}.py", f"import {name}\nSEEN = {name}\n" + TASK, task=True)
    task = load_task(str(path))
    assert task.file == path
    seen = sys.modules[task.cls.__module__].SEEN
    assert seen is not sys.modules[task.cls.__module__] and (library is None or seen is library)
    path.write_text(path.read_text() + "\nNEXT = 1\n")
    assert sys.modules[load_task(str(path)).cls.__module__].NEXT == 1


def test_a_policy_imports_modules_beside_it_but_never_in_place_of_a_library(
    write: Write, not_imported: tuple[str, ...], capsys: pytest.CaptureFixture
) -> None:
    plant(write, *not_imported)
    write("gains.py", "GAIN = 3\n")
    imports = "".join(f"import {name}\n" for name in not_imported)
    policy = write("own_policy.py", imports + "from gains import GAIN\ndef act(obs): return GAIN\n")
    before = list(sys.path), list(sys.meta_path)
    sys.modules.pop("gains", None)
    assert load_policy(f"{policy}:act")(None) == 3
    assert (sys.path, sys.meta_path) == before
    assert "colorsys.py has the name of a library" in capsys.readouterr().err
    load_policy(f"{policy}:act")
    assert "colorsys" not in capsys.readouterr().err, "the warning is printed once"
    del sys.modules["gains"]

"""``package.module:ClassName`` and ``--import`` are found without running code, and opened and watched like a file."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from mani_skill.utils.registration import REGISTERED_ENVS

from tests.drive.task_files import Write
from tests.task.refusal import refused
from workbench.task import library_names
from workbench.task.load import class_of_module, import_modules, load_task, undo_load
from workbench.task.problem import TaskError
from workbench.task.reference import (
    RecordedTask,
    followed_folder,
    named_file,
    reference_to_class,
    why_missing,
)

TASK = """
from lab_of_mine.robots.arm import REACH

@register_env("LabOfMine-v1", max_episode_steps=7)
class MinimalEnv(BaseEnv):
    reach = REACH

class OtherEnv(BaseEnv):
    pass
"""
REFERENCE = "lab_of_mine.tasks:MinimalEnv"


@pytest.fixture(autouse=True)
def undo_imports(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Undo imports, which would stay for the rest of the process."""
    monkeypatch.setattr(library_names, "_permanent_folder", False)
    names = set(sys.modules)
    yield
    for name in set(sys.modules) - names:
        if name.startswith("lab_of_mine"):
            del sys.modules[name]


@pytest.fixture(params=["package", "no __init__.py"])
def lab(request: pytest.FixtureRequest, write: Write, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package in the current folder."""
    if request.param == "package":
        for name in ("", "tasks/", "robots/"):
            write(f"lab_of_mine/{name}__init__.py", "")
    write("lab_of_mine/robots/arm.py", "REACH = 1\n")
    write("lab_of_mine/tasks/minimal.py", TASK, task=True)
    write("lab_of_mine/tasks/__init__.py", "from lab_of_mine.tasks.minimal import MinimalEnv\n")
    monkeypatch.chdir(folder)
    return folder / "lab_of_mine"


def test_a_module_is_found_without_importing_it(lab: Path) -> None:
    for file in lab.rglob("*.py"):
        file.write_text("raise SystemExit('it ran')\n")
    assert named_file(REFERENCE) == lab / "tasks" / "__init__.py"
    assert named_file("lab_of_mine.robots.arm:Arm") == lab / "robots" / "arm.py"
    assert followed_folder(REFERENCE) == lab
    assert why_missing(REFERENCE) is None
    assert not [name for name in sys.modules if name.startswith("lab_of_mine")]
    why = why_missing("lab_of_yours.tasks:MinimalEnv")
    assert why is not None and "there is no module lab_of_yours.tasks" in why and str(lab.parent) in why
    assert named_file("lab_of_mine.tasks.nowhere:MinimalEnv") is None


def test_the_class_opens_and_its_whole_package_is_watched(lab: Path) -> None:
    task = load_task(REFERENCE)
    minimal, arm = lab / "tasks" / "minimal.py", lab / "robots" / "arm.py"
    assert (task.env_id, task.class_name, task.max_episode_steps) == ("LabOfMine-v1", "MinimalEnv", 7)
    assert (task.file, task.followed, task.others) == (minimal, True, ("OtherEnv",))
    assert task.cls.__module__ == "lab_of_mine.tasks.minimal"
    assert {minimal, arm, lab / "tasks" / "__init__.py"} <= set(task.source_files)
    assert set(task.source_files) <= set(lab.rglob("*.py"))
    assert reference_to_class(REFERENCE, minimal, "OtherEnv") == "lab_of_mine.tasks.minimal:OtherEnv"

    arm.write_text("REACH = 2\n")
    again = load_task(REFERENCE)
    assert vars(again.cls)["reach"] == 2 and REGISTERED_ENVS["LabOfMine-v1"].cls is again.cls
    arm.write_text("REACH = \n")
    problem = refused(REFERENCE)
    assert (problem.stage, problem.file, problem.line) == ("syntax", str(arm), 1)
    assert REGISTERED_ENVS["LabOfMine-v1"].cls is again.cls
    assert sys.modules["lab_of_mine.tasks.minimal"] is sys.modules[again.cls.__module__]
    assert undo_load(again)


def test_the_current_folder_hides_no_library(
    write: Write, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("json", "torch", "colorsys"):
        write(f"{name}.py", "raise SystemExit('it ran')\n")
    write("mani_skill/envs/mine.py", TASK, task=True)
    write("lab_of_mine/__init__.py", "")
    write("lab_of_mine/robots/arm.py", "import colorsys\nREACH = 1\n")
    write("lab_of_mine/tasks.py", TASK, task=True)
    monkeypatch.chdir(folder)
    monkeypatch.delitem(sys.modules, "colorsys", raising=False)
    assert named_file("torch:MinimalEnv") != folder / "torch.py"
    assert why_missing("mani_skill.envs.mine:MinimalEnv") is not None
    import_modules(("lab_of_mine.tasks",))
    assert load_task("LabOfMine-v1").cls is class_of_module("lab_of_mine.tasks", "MinimalEnv")
    assert not str(sys.modules["colorsys"].__file__).startswith(str(folder))


def test_an_import_provides_the_ids_that_the_package_registers(lab: Path) -> None:
    problem = refused("LabOfMine-v1")
    assert "--import" in problem.message
    import_modules(("lab_of_mine.tasks",))
    task = load_task("LabOfMine-v1")
    assert (task.class_name, task.file, task.followed) == ("MinimalEnv", lab / "tasks" / "minimal.py", False)


def test_a_recording_triggers_no_import(lab: Path) -> None:
    for named in (
        RecordedTask(REFERENCE),
        RecordedTask("LabOfMine-v1", REFERENCE),
        RecordedTask("LabOfMine-v1"),
    ):
        with pytest.raises(TaskError) as caught:
            load_task(named)
        assert "--import" in caught.value.problem.message
    assert not [name for name in sys.modules if name.startswith("lab_of_mine")]

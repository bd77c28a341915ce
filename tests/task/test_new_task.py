"""New tasks from templates and installed tasks: their names, refusals, and that no file is overwritten."""

from __future__ import annotations

import ast
import os
from pathlib import Path

import pytest

from workbench.machine.folders import example_tasks
from workbench.task.find import TaskFile, read_task_file
from workbench.task.load import load_task
from workbench.task.new_task import (
    MAX_NAME_CHARACTERS,
    TEMPLATES,
    CannotBegin,
    Template,
    fill_blank_file,
    is_blank,
    why_not_name,
    write_new_task,
)

pytestmark = pytest.mark.thorough


@pytest.mark.parametrize("template", TEMPLATES, ids=lambda template: template.name)
def test_a_template_is_an_example_with_only_the_names_changed(tmp_path: Path, template: Template) -> None:
    made = write_new_task("stack_two", template.name, tmp_path)
    assert (made.env_id, made.class_name, made.reference) == ("StackTwo-v1", "StackTwoEnv", "stack_two.py")
    (example,) = (file for file in example_tasks() if file.name == template.example)
    before = read_task_file(example)
    assert before is not None
    text = made.file.read_text()
    ((old_id,), (old_class,)) = before.ids, before.classes
    assert old_id not in text and old_class not in text
    assert text.replace("StackTwo-v1", old_id).replace("StackTwoEnv", old_class) == example.read_text()
    assert read_task_file(made.file) == TaskFile(made.file, ("StackTwo-v1",), ("StackTwoEnv",))
    loaded = load_task(str(made.file))
    assert (loaded.env_id, loaded.class_name) == ("StackTwo-v1", "StackTwoEnv")


def test_a_copied_maniskill_task_has_its_class_renamed_everywhere(tmp_path: Path) -> None:
    made = write_new_task("lift_it", "PickCube-v1", tmp_path)
    task = read_task_file(made.file)
    assert task is not None and task.classes[0] == "LiftItEnv" and task.ids[0] == "LiftIt-v1"
    tree = ast.parse(made.file.read_text())
    assert "PickCubeEnv" not in {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    # The file also has tasks for other robots; the last of them would be opened by default.
    assert len(task.ids) > 1 and made.reference == "lift_it.py:LiftItEnv"
    assert all(uid.startswith("LiftIt") for uid in task.ids)
    loaded = load_task(f"{made.file}:LiftItEnv")
    assert (loaded.env_id, loaded.replaced) == ("LiftIt-v1", ())


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("push-it", "such as push_it."),
        ("../push", "such as push."),
        ("class", "such as stack_two."),
        ("a" * (MAX_NAME_CHARACTERS + 1), f"at most {MAX_NAME_CHARACTERS}"),
        ("torch", "is the name of a library"),
        ("queue", "such as queue_task."),
        ("taken", "taken.py exists already"),
        ("workbench_minimal", "already an id of minimal.py"),
        ("HERE", "HERE-v1, which is already an id of mine.py"),
    ],
)
def test_a_name_that_is_invalid_or_taken_is_refused_with_what_to_do(
    tmp_path: Path, name: str, why: str
) -> None:
    (tmp_path / "taken.py").write_text("mine")
    (tmp_path / "mine.py").write_text("@register_env('HERE-v1')\nclass Task(BaseEnv): ...\n")
    assert why in why_not_name(name, tmp_path)
    with pytest.raises(CannotBegin) as refused:
        write_new_task(name, "minimal", tmp_path)
    assert why in str(refused.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.py", "taken.py"]
    assert (tmp_path / "taken.py").read_text() == "mine"


def test_a_file_that_appears_at_the_last_moment_is_not_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sync = os.fsync

    def saved_meanwhile(descriptor: int) -> None:
        sync(descriptor)
        (tmp_path / "push.py").write_text("mine")

    monkeypatch.setattr(os, "fsync", saved_meanwhile)
    with pytest.raises(CannotBegin, match="push.py exists already"):
        write_new_task("push", "minimal", tmp_path)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize(
    ("content", "blank"),
    [(b"", True), (b"\n  # a\n\t\n", True), (b"pass", False), (b'"""A task."""', False), (b"\xff", False)],
)
def test_only_a_file_of_comments_and_blank_lines_is_filled(
    tmp_path: Path, content: bytes, blank: bool
) -> None:
    file = tmp_path / "my-first.py"
    file.write_bytes(content)
    assert is_blank(file) == blank and not is_blank(tmp_path / "gone.py")
    if blank:
        fill_blank_file(file)
        assert read_task_file(file) == TaskFile(file, ("MyFirst-v1",), ("MyFirstEnv",))
        assert file.read_bytes().startswith(content.rstrip())
    else:
        with pytest.raises(CannotBegin, match="no longer empty"):
            fill_blank_file(file)
        assert file.read_bytes() == content


def test_a_filled_file_gets_an_id_that_no_other_task_has(tmp_path: Path) -> None:
    # ManiSkill has Empty-v1.
    for name, env_id in (("empty.py", "MyEmpty-v1"), ("my_empty.py", "MyMyEmpty-v1")):
        (tmp_path / name).touch()
        fill_blank_file(tmp_path / name)
        task = read_task_file(tmp_path / name)
        assert task is not None and task.ids == (env_id,)

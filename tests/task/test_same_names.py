"""Helper modules of one name in the folders of a task and of a policy."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.drive.task_files import Write
from workbench.actions.policy import load_policy
from workbench.task.load import load_task

TASK = """
    import helper

    @register_env("{name}-v1")
    class Task(BaseEnv):
        WHERE = helper.WHERE

        def later(self):
            import helper
            return helper.WHERE
"""
POLICY = "import helper\n\ndef act(obs):\n    return helper.WHERE\n"


def where(task: Path) -> tuple[str, str]:
    """What the task's import gave as it was loaded, and what an import gives now."""
    cls = load_task(str(task)).cls
    return cls.WHERE, cls.later(None)  # type: ignore[attr-defined]


@pytest.mark.parametrize("policy_first", [True, False])
def test_a_task_and_a_policy_each_import_the_helper_of_their_own_folder(
    write: Write, policy_first: bool
) -> None:
    for folder in ("task", "lab", "other"):
        write(f"{folder}/helper.py", f"WHERE = {folder!r}\n")
    task = write("task/push.py", TASK.format(name="SameNames"), task=True)
    policy = write("lab/act.py", POLICY)
    if policy_first:
        assert load_policy(f"{policy}:act")(None) == "lab"
    assert where(task) == ("task", "task")
    assert load_policy(f"{policy}:act")(None) == "lab"
    assert where(task) == ("task", "task"), "the next load of the task"
    act = load_policy(f"{policy}:act")
    assert load_task(str(task)).cls.later(None) == "task" and act(None) == "lab"  # type: ignore[attr-defined]
    other = write("other/pull.py", TASK.format(name="OtherSameNames"), task=True)
    assert where(other) == ("other", "other")


def test_a_helper_that_only_the_policy_has_stays_loaded(write: Write) -> None:
    write("lab/only_mine.py", "WHERE = 'lab'\n")
    act = write(
        "lab/act.py", "def act(obs):\n    import only_mine\n    return only_mine.WHERE\nimport only_mine\n"
    )
    policy = load_policy(f"{act}:act")
    assert policy(None) == "lab" and sys.modules["only_mine"].WHERE == "lab"

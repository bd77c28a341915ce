"""A file with several tasks: one that works is opened, and the others can be chosen even after a failure."""

# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from pathlib import Path

import pytest

from tests.drive.session import TASKS, wait_until
from workbench.app.session import Session
from workbench.live.commands import ChooseClass
from workbench.live.messages import Load
from workbench.live.worker.reload import load_version
from workbench.task.description import TaskOptions
from workbench.task.open import open_task
from workbench.task.problem import TaskError

OPTIONS = TaskOptions(num_envs=2, env_kwargs={"render_backend": "none"})
BROKEN = '    def _load_scene(self, options):\n        raise ValueError("no cubes")\n'


def tasks(*names: str, broken: tuple[str, ...]) -> str:
    """The text of a file that registers these tasks in this order, with a common base class."""
    text = (TASKS / "minimal.py").read_text()
    text = text.replace('@register_env("WorkbenchMinimal-v1", max_episode_steps=50)\n', "")
    for name in names:
        text += f'\n\n@register_env("Several{name}-v1", max_episode_steps=9)\nclass {name}(MinimalEnv):\n'
        text += BROKEN if name in broken else "    pass\n"
    return text


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path.resolve() / "several.py"


def test_the_first_that_opens_is_opened_and_named(file: Path) -> None:
    file.write_text(tasks("OneEnv", "TwoEnv", "ThreeEnv", "FourEnv", broken=("FourEnv", "ThreeEnv")))
    opened, report = load_version(Load(str(file), OPTIONS, any_task=True), None)
    opened.env.close()
    task = opened.description
    assert report is None and (task.chosen, task.env_id, task.in_place_of) == (
        "TwoEnv",
        "SeveralTwoEnv-v1",
        "FourEnv",
    )
    assert sorted(task.others) == ["FourEnv", "MinimalEnv", "OneEnv", "ThreeEnv"]
    (notice,) = task.notices
    assert notice.startswith("FourEnv was tried first and failed") and "no cubes" in notice
    assert f"{file}:" in notice and "TwoEnv" in notice


def test_if_the_requested_task_fails_the_others_are_named_and_none_is_opened(file: Path) -> None:
    file.write_text(tasks("OneEnv", "TwoEnv", broken=("TwoEnv",)))
    for reference, any_task in ((str(file), False), (f"{file}:TwoEnv", True)):
        with pytest.raises(TaskError) as caught:
            load_version(Load(reference, OPTIONS, any_task=any_task), None)
        assert caught.value.classes[0] == "TwoEnv" and set(caught.value.classes[1:]) == {
            "OneEnv",
            "MinimalEnv",
        }
        problem = caught.value.problem
        assert "no cubes" in problem.message and "TwoEnv" in problem.message
        assert "OneEnv" in problem.message and "several.py:" in problem.message
        assert problem.file == str(file) and problem.line is not None
    with pytest.raises(TaskError, match="also has .*OneEnv.*name one"):
        open_task(str(file), OPTIONS)


@pytest.mark.slow
def test_the_task_chooser_stays_while_the_chosen_task_fails(
    child_process: None, file: Path, tmp_path: Path
) -> None:
    file.write_text(tasks("OneEnv", "TwoEnv", broken=("TwoEnv",)))
    session = Session(f"{file}:TwoEnv", OPTIONS, recordings=tmp_path / "recordings")
    try:
        view = wait_until(session, lambda v: v.problem is not None, "the failure")
        assert view.task is None and view.choices[0] == "TwoEnv" and "OneEnv" in view.choices

        session.do(ChooseClass(name="OneEnv"))
        view = wait_until(session, lambda v: v.task is not None, "the one that works")
        assert view.task.chosen == view.choices[0] == "OneEnv" and view.problem is None

        session.do(ChooseClass(name="TwoEnv"))
        view = wait_until(session, lambda v: v.problem is not None, "the failure again")
        assert view.task.chosen == "OneEnv" and view.choices[0] == "TwoEnv"

        session.do(ChooseClass(name="OneEnv"))
        view = wait_until(session, lambda v: v.problem is None, "the one that works again")
        assert view.task.chosen == view.choices[0] == "OneEnv"

        session.do(ChooseClass(name="TwoEnv"))
        wait_until(session, lambda v: v.problem is not None and v.choices[0] == "TwoEnv", "the failure")
        file.write_text(tasks("OneEnv", "TwoEnv", broken=()))
        view = wait_until(session, lambda v: v.task.chosen == "TwoEnv", "the fixed task")
        assert view.problem is None
    finally:
        session.close()

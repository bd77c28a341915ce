"""What a person is told to do about a task that cannot be opened as it was asked for."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.session.conftest import TASKS
from workbench.authoring.problem import TaskError
from workbench.session.messages import Load, TaskOptions
from workbench.session.open_task import open_task
from workbench.session.reload import load_version

KWARGS = {"render_backend": "none"}
FOR_ONE = "        lifted = float(self.cube.pose.p[:, 2]) > 0.1\n"
WRONG = "        lifted = self.cuube\n"


def written(folder: Path, line: str) -> Path:
    file = folder / "lift.py"
    text = (TASKS / "minimal.py").read_text()
    head, hook, rest = text.partition("    def evaluate(self):\n")
    file.write_text(head + hook + line + rest)
    return file


def test_a_task_that_is_written_for_one_env_is_told_the_option(tmp_path: Path) -> None:
    file = written(tmp_path, FOR_ONE)
    for several in (
        lambda: open_task(str(file), TaskOptions(4, env_kwargs=KWARGS)),
        lambda: load_version(Load(str(file), TaskOptions(4, env_kwargs=KWARGS)), None),
    ):
        with pytest.raises(TaskError) as caught:
            several()
        problem = caught.value.problem
        assert "it fails with 4 envs and runs with one: --num-envs 1" in problem.message
        assert (problem.file, problem.code) == (str(file), FOR_ONE.strip())
    open_task(str(file), TaskOptions(1, env_kwargs=KWARGS)).env.close()


def test_what_fails_with_one_env_too_is_not_told_so(tmp_path: Path) -> None:
    for num_envs in (1, 4):
        with pytest.raises(TaskError) as caught:
            open_task(str(written(tmp_path, WRONG)), TaskOptions(num_envs, env_kwargs=KWARGS))
        assert "--num-envs" not in caught.value.problem.message

"""What a person is told to do about a task that cannot be opened as it was requested."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.drive.session import TASKS
from workbench.authoring.problem import TaskError
from workbench.jobs.open_task import open_task
from workbench.jobs.task import TaskOptions
from workbench.session.protocol.messages import Load
from workbench.session.worker.reload import Running, load_version

KWARGS = {"render_backend": "none"}
FOR_ONE = "        lifted = float(self.cube.pose.p[:, 2]) > 0.1\n"
FIRST_ROW = '        return {"success": self.cube.pose.p[:1, 2] > 0.1}\n'
GOOD = "        lifted = self.cube.pose.p[:, 2] > 0.1\n"
WRONG = "        lifted = self.cuube\n"


def written(folder: Path, line: str) -> Path:
    file = folder / "lift.py"
    text = (TASKS / "minimal.py").read_text()
    head, hook, rest = text.partition("    def evaluate(self):\n")
    file.write_text(head + hook + line + rest)
    return file


@pytest.mark.parametrize(("line", "code"), [(FOR_ONE, FOR_ONE), (FIRST_ROW, "    def evaluate(self):\n")])
def test_a_task_that_is_written_for_one_env_is_told_the_option(line: str, code: str, tmp_path: Path) -> None:
    file = written(tmp_path, line)
    for several in (
        lambda: open_task(str(file), TaskOptions(4, env_kwargs=KWARGS)),
        lambda: load_version(Load(str(file), TaskOptions(4, env_kwargs=KWARGS)), None),
    ):
        with pytest.raises(TaskError) as caught:
            several()
        problem = caught.value.problem
        assert "--num-envs 1" in problem.message
        assert (problem.file, problem.code) == (str(file), code.strip())
    open_task(str(file), TaskOptions(1, env_kwargs=KWARGS)).env.close()


def test_a_default_dtype_that_the_file_changed_is_told_where_no_line_of_it_fails(tmp_path: Path) -> None:
    file = written(tmp_path, GOOD)
    file.write_text(f"import torch\n\ntorch.set_default_dtype(torch.float64)\n{file.read_text()}")
    before = torch.get_default_dtype()
    try:
        with pytest.raises(TaskError) as caught:
            open_task(str(file), TaskOptions(1, env_kwargs=KWARGS))
    finally:
        torch.set_default_dtype(before)
    problem = caught.value.problem
    assert problem.line is None and "default dtype is torch.float64" in problem.message
    with pytest.raises(TaskError) as caught:
        open_task(str(written(tmp_path, WRONG)), TaskOptions(1, env_kwargs=KWARGS))
    assert "dtype" not in caught.value.problem.message


def test_what_fails_with_one_env_too_is_not_told_so(tmp_path: Path) -> None:
    for num_envs in (1, 4):
        with pytest.raises(TaskError) as caught:
            open_task(str(written(tmp_path, WRONG)), TaskOptions(num_envs, env_kwargs=KWARGS))
        assert "--num-envs" not in caught.value.problem.message


def test_a_save_that_works_with_one_env_alone_is_told_the_option_too(tmp_path: Path) -> None:
    request = Load(str(written(tmp_path, GOOD)), TaskOptions(4, env_kwargs=KWARGS))
    opened, _ = load_version(request, None)
    running = Running(request, opened, opened.first)
    try:
        for line, told in ((FOR_ONE, True), (WRONG, False), (FOR_ONE, True)):
            file = written(tmp_path, line)
            with pytest.raises(TaskError) as caught:
                load_version(request, running)
            problem = caught.value.problem
            assert ("--num-envs 1" in problem.message) is told
            assert (problem.file, problem.code) == (str(file), line.strip())
        written(tmp_path, GOOD + "        lifted = lifted & True\n")
        again, report = load_version(request, running)
        assert again.env.env is opened.env.env and report is not None and report.level == "patched"
    finally:
        opened.env.close()


def test_who_chose_a_task_of_a_file_is_not_told_to_choose_one(tmp_path: Path) -> None:
    file = written(tmp_path, GOOD)
    text = file.read_text()
    head, _, body = text.partition("@register_env")
    other = body.replace(GOOD, WRONG)
    names = [
        line.split("(")[0].removeprefix("class ") for line in body.splitlines() if line.startswith("class ")
    ]
    other = "@register_env" + other.replace(f"class {names[0]}", "class Wrong").replace('("', '("Wrong', 1)
    file.write_text(f"{text}\n\n{other}")
    options = TaskOptions(1, env_kwargs=KWARGS)
    request = Load(f"{file}:{names[0]}", options)
    opened, _ = load_version(request, None)
    running = Running(request, opened, opened.first)
    try:
        # Chosen by a person, and then what the file's name alone stands for.
        for task, told in ((f"{file}:Wrong", False), (str(file), True)):
            with pytest.raises(TaskError) as caught:
                load_version(Load(task, options), running)
            assert ("choose it as Task" in caught.value.problem.message) is told
            assert "cuube" in caught.value.problem.message
    finally:
        opened.env.close()

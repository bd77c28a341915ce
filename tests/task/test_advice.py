"""Advice given for a task that cannot be opened as requested."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.drive.session import TASKS
from workbench.envs.assets import MissingAssets
from workbench.live.messages import Load
from workbench.live.panels.env_options import TITLE
from workbench.live.worker.reload import load_version
from workbench.task.description import TaskOptions
from workbench.task.open import open_task
from workbench.task.problem import TaskError

pytestmark = pytest.mark.thorough

KWARGS = {"render_backend": "none"}
FOR_ONE = "        lifted = float(self.cube.pose.p[:, 2]) > 0.1\n"
FIRST_ROW = '        return {"success": self.cube.pose.p[:1, 2] > 0.1}\n'

WRONG = "        lifted = self.cuube\n"


def written(folder: Path, line: str) -> Path:
    file = folder / "lift.py"
    text = (TASKS / "minimal.py").read_text()
    head, hook, rest = text.partition("    def evaluate(self):\n")
    file.write_text(head + hook + line + rest)
    return file


def test_a_task_written_for_one_env_gets_advice_to_use_one_env(tmp_path: Path) -> None:
    file = written(tmp_path, FOR_ONE)
    for several in (
        lambda: open_task(str(file), TaskOptions(4, env_kwargs=KWARGS)),
        lambda: load_version(Load(str(file), TaskOptions(4, env_kwargs=KWARGS)), None),
    ):
        with pytest.raises(TaskError) as caught:
            several()
        problem = caught.value.problem
        assert "--num-envs 1" in problem.message and TITLE in problem.message
        assert (problem.file, problem.code) == (str(file), FOR_ONE.strip())
    open_task(str(file), TaskOptions(1, env_kwargs=KWARGS)).env.close()


@pytest.mark.parametrize(("line", "num_envs"), [(WRONG, 1), (WRONG, 4), (FIRST_ROW, 4)])
def test_a_mistake_that_one_env_does_not_mend_gets_no_such_advice(
    line: str, num_envs: int, tmp_path: Path
) -> None:
    """With one env, a value of the first env only has the right shape by chance."""
    with pytest.raises(TaskError) as caught:
        open_task(str(written(tmp_path, line)), TaskOptions(num_envs, env_kwargs=KWARGS))
    assert "--num-envs" not in caught.value.problem.message


def test_a_missing_asset_gets_no_advice_to_open_a_base_class(tmp_path: Path) -> None:
    file = tmp_path / "base.py"
    text = (TASKS / "minimal.py").read_text().replace("MinimalEnv(BaseEnv)", "Scene(BaseEnv)")
    head, registered, rest = text.partition('@register_env("WorkbenchMinimal-v1", max_episode_steps=50)\n')
    assert registered
    needs = '@register_env("NeedsAnAsset-v1", max_episode_steps=9, asset_download_ids=["ycb"])\n'
    file.write_text(f"{head}{rest}\n\n{needs}class Kitchen(Scene):\n    pass\n")
    with pytest.raises(TaskError) as caught:
        open_task(str(file), TaskOptions(1, env_kwargs=KWARGS))
    assert isinstance(caught.value.__cause__, MissingAssets)
    assert "Scene" not in caught.value.problem.message

"""A constructor that does not call its parent's is reported at its ``def``, on the page and by `workbench.make`."""

from __future__ import annotations

from pathlib import Path

import pytest

import workbench
from workbench.envs.broken_rule import RuleWarning
from workbench.task.description import TaskOptions
from workbench.task.open import open_task
from workbench.task.problem import TaskError

HEADER = """
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots.panda.panda import Panda
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv
from mani_skill.utils.registration import register_env
"""
FORGOTTEN = """
@register_env("Forgotten-v1", max_episode_steps=50, override=True)
class Forgotten(PushCubeEnv):
    def __init__(self, *args, noise=0.1, **kwargs):  # the fault
        self.noise = noise
"""
BASE = """
class Base(PushCubeEnv):
    def __init__(self, *args, **kwargs):  # the fault
        self.base = True

@register_env("Forgotten-v1", max_episode_steps=50, override=True)
class Forgotten(Base):
    def __init__(self, *args, noise=0.1, **kwargs):
        self.noise = noise
        super().__init__(*args, **kwargs)
"""
LOST = """
@register_env("Forgotten-v1", max_episode_steps=50, override=True)
class Forgotten(PushCubeEnv):
    def __init__(self, *args, noise=0.1, **kwargs):  # the fault
        self.noise = noise
        super().__init__(render_backend="none")
"""
ROBOT = """
@register_agent(override=True)
class Arm(Panda):
    uid = "arm_of_a_test"

    def __init__(self, *args, **kwargs):  # the fault
        self.tool = None

@register_env("Forgotten-v1", max_episode_steps=50, override=True)
class Forgotten(PushCubeEnv):
    SUPPORTED_ROBOTS = ["arm_of_a_test"]

    def __init__(self, *args, **kwargs):
        super().__init__(*args, robot_uids="arm_of_a_test", **kwargs)
"""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            FORGOTTEN,
            "Forgotten.__init__ ends without super().__init__(*args, **kwargs), so nothing was built",
        ),
        (BASE, "Base.__init__ ends without super().__init__(*args, **kwargs), so nothing was built"),
        (ROBOT, "Arm.__init__ ends without super().__init__(*args, **kwargs), so the robot was not loaded"),
    ],
    ids=["task", "base", "robot"],
)
@pytest.mark.parametrize("rules", ["warn", "off"])
def test_a_wrong_constructor_is_reported_at_its_def(
    text: str, words: str, rules: str, tmp_path: Path
) -> None:
    file = tmp_path / "task.py"
    file.write_text(HEADER + text)
    options = TaskOptions(3, "cpu", env_kwargs={"render_backend": "none"}, rules=rules)  # type: ignore[arg-type]
    with pytest.raises(TaskError) as caught:
        open_task(str(file), options)
    problem = caught.value.problem
    assert words in problem.message and (problem.stage, problem.file) == ("build", str(file))
    assert "# the fault" in (problem.code or "")
    if text in (FORGOTTEN, ROBOT):
        with pytest.raises(RuntimeError) as made:
            workbench.make(file, 3, backend="cpu", render_backend="none")
        assert words in str(made.value) and f"{file}:{problem.line}" in str(made.value)


def test_a_constructor_that_drops_num_envs_is_opened_with_one_env_and_reported(tmp_path: Path) -> None:
    file = tmp_path / "task.py"
    file.write_text(HEADER + LOST)
    with pytest.warns(RuleWarning, match="num_envs"):
        opened = open_task(str(file), TaskOptions(3, "cpu", env_kwargs={"render_backend": "none"}))
    line = (HEADER + LOST)[: (HEADER + LOST).index("# the fault")].count("\n") + 1
    assert opened.env.num_envs == 1
    assert any(f"{file}:{line}" in notice for notice in opened.description.notices)
    opened.env.close()

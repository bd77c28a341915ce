"""A robot's file on a real env: it moves, and a save brings the robot in anew."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from workbench.core.env import actions
from workbench.jobs.task import TaskOptions
from workbench.session.protocol.messages import Load
from workbench.session.worker.reload import Running, load_version

ROBOT = """
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots import Panda

@register_agent()
class MyPanda(Panda):
    uid = "my_panda"
    arm_stiffness = 1e3
"""


def test_a_robot_stands_in_the_scene_and_is_built_anew_by_a_save(tmp_path: Path) -> None:
    file = tmp_path / "my_panda.py"
    file.write_text(ROBOT)
    request = Load(str(file), TaskOptions(num_envs=2, env_kwargs={"render_backend": "none"}))
    opened, _ = load_version(request, None)
    try:
        assert opened.description.env_id == "Empty-v1" and opened.description.source_files == (str(file),)
        assert opened.env.env.agent.uid == "my_panda"
        assert opened.description.env_kwargs["robot_uids"] == "my_panda"
        rng = np.random.default_rng(0)
        action = actions.random_action(opened.env.parts, 2, rng)
        last = opened.env.step(action)
        assert (last.elapsed_steps == 1).all()
        file.write_text(ROBOT.replace("1e3", "5e2"))
        again, report = load_version(request, Running(request, opened, last))
        try:
            assert report is not None and report.level == "rebuilt" and "robot" in report.reason
            assert again.env.env.agent.arm_stiffness == 5e2  # pyright: ignore[reportAttributeAccessIssue]
            np.testing.assert_allclose(again.first.poses, last.poses, atol=1e-6)
        finally:
            again.env.close()
    finally:
        opened.env.close()

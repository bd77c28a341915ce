"""A robot file on a real env: the robot moves, and a save rebuilds it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from workbench.envs import action_vector as actions
from workbench.episodes.reader import reading
from workbench.episodes.reader.scan import scan_folder
from workbench.live.messages import Load
from workbench.live.worker.reload import Running, load_version
from workbench.record.job import record
from workbench.record.job_worker import RecordOptions
from workbench.rescore.replay_recordings import rescore
from workbench.task.description import TaskOptions
from workbench.task.open import open_task

ROBOT = """
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots import Panda

@register_agent()
class MyPanda(Panda):
    uid = "my_panda"
    arm_stiffness = 1e3
"""


def test_a_robot_stands_in_the_scene_and_is_rebuilt_by_a_save(tmp_path: Path) -> None:
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


@pytest.mark.slow
@pytest.mark.usefixtures("child_process")
def test_a_recording_of_a_robot_file_has_no_return_and_reports_scene_and_length(tmp_path: Path) -> None:
    file = tmp_path / "my_panda.py"
    file.write_text(ROBOT.replace("my_panda", "its_panda"))
    options = TaskOptions(num_envs=2, env_kwargs={"render_backend": "none"})
    what = RecordOptions(str(file), tmp_path / "out", episodes=2, pictures=False, options=options)
    notices: list[str] = []
    written = record(what, on_notice=notices.append).written
    assert [(one.steps, one.total_reward, one.success) for one in written] == [(200, None, None)] * 2
    shown, limit = notices
    assert "MyPanda" in shown and "Empty-v1" in shown and "200" in limit
    few = replace(what, out=tmp_path / "few", episodes=1, max_steps=3)
    (one,) = record(few, on_notice=notices.append).written
    assert one.steps == 3 and notices[2:] == [shown]
    rows = [
        row
        for _, entries in reading.read_rows(few.out, scan_folder(few.out).found.values())
        for row, _ in entries
    ]
    assert [(row.length, row.total_reward) for row in rows] == [(3, None)]
    opened = open_task(str(file), replace(options, num_envs=1))
    try:
        parts = list(rescore(opened, reading.find_all_sources((few.out,))))
    finally:
        opened.env.close()
    (verdict,) = (verdict for part in parts for verdict in part.verdicts)
    assert not verdict.why_not and not verdict.differs and verdict.has == ()

"""A file with a robot and no task: the robot is shown in an empty scene, a message says so, and a save rebuilds it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mani_skill.agents.registration import REGISTERED_AGENTS

from tests.drive.task_files import Write
from tests.task.refusal import refused
from workbench.envs import action_vector as actions
from workbench.episodes.reader import reading
from workbench.episodes.reader.scan import scan_folder
from workbench.live.messages import Load
from workbench.live.worker.reload import Running, load_version
from workbench.record.job import record
from workbench.record.job_worker import RecordOptions
from workbench.rescore.replay_recordings import rescore
from workbench.task.description import TaskOptions
from workbench.task.load import load_task, undo_load
from workbench.task.open import open_task

ROBOTS = """
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots import Panda, PandaWristCam

@register_agent()
class TallPanda(Panda):
    uid = "tall_panda"

@register_agent()
class SmallPanda(Panda):
    uid = "small_panda"
    size = 1
"""


def test_a_robot_file_opens_in_an_empty_scene_with_a_message(write: Write) -> None:
    file = write("arms.py", ROBOTS)
    task = load_task(str(file))
    assert (task.env_id, task.chosen, task.others) == ("Empty-v1", "SmallPanda", ("TallPanda",))
    assert task.default_kwargs == {"robot_uids": "small_panda"}
    assert (task.file, task.followed) == (file, True)
    (notice,) = task.notices
    assert "SmallPanda, with the uid 'small_panda'" in notice
    assert (
        f"type in {file.parent}: workbench open PickCube-v1 --import arms --env robot_uids=small_panda"
        in notice
    )
    other = load_task(f"{file}:TallPanda")
    assert (other.chosen, other.default_kwargs) == ("TallPanda", {"robot_uids": "tall_panda"})
    assert not undo_load(task) and undo_load(other)


@pytest.mark.parametrize("text", ["raise SystemExit\n", "1 / 0\n"])
def test_a_version_that_fails_keeps_the_previous_robot(write: Write, text: str) -> None:
    file = write("arms.py", ROBOTS)
    load_task(str(file))
    before = REGISTERED_AGENTS["small_panda"].agent_cls
    file.write_text(ROBOTS + text)
    refused(file)
    assert REGISTERED_AGENTS["small_panda"].agent_cls is before
    file.write_text(ROBOTS.replace("size = 1", "size = 2"))
    load_task(str(file))
    assert vars(REGISTERED_AGENTS["small_panda"].agent_cls)["size"] == 2


# --- on a real env ---

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

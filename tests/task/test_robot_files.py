"""A file with a robot and no task: the robot is shown in an empty scene, and a message says so."""

from __future__ import annotations

import pytest

from tests.drive.task_files import Write
from tests.task.refusal import refused
from workbench.task.load import load_task, undo_load

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
    from mani_skill.agents.registration import REGISTERED_AGENTS

    file = write("arms.py", ROBOTS)
    load_task(str(file))
    before = REGISTERED_AGENTS["small_panda"].agent_cls
    file.write_text(ROBOTS + text)
    refused(file)
    assert REGISTERED_AGENTS["small_panda"].agent_cls is before
    file.write_text(ROBOTS.replace("size = 1", "size = 2"))
    load_task(str(file))
    assert vars(REGISTERED_AGENTS["small_panda"].agent_cls)["size"] == 2

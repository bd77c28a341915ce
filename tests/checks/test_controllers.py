"""The rule for controllers that do not declare which drive targets they set."""

from __future__ import annotations

import pytest

from tests.checks.checked import Checked, the_finding

pytestmark = pytest.mark.thorough

CLASS = '@register_env("WorkbenchPushCube-v1", max_episode_steps=50)\n'
OWN_CONTROLLER = """
from gymnasium import spaces
from mani_skill.agents.controllers.base_controller import BaseController, ControllerConfig
from mani_skill.agents.registration import register_agent


class Still(BaseController):
    FLAGS

    def _initialize_action_space(self):
        self.single_action_space = spaces.Box(-1, 1, (1,), np.float32)

    def set_drive_property(self):
        for joint in self.joints:
            joint.set_drive_properties(1e3, 1e2)

    def set_action(self, action):
        pass


class StillConfig(ControllerConfig):
    controller_cls = Still


@register_agent(override=True)
class StillPanda(Panda):
    uid = "still_panda"

    @property
    def _controller_configs(self):
        return {"still": StillConfig(joint_names=["panda_joint1"])}


"""
FLAGS = "sets_target_qpos = sets_target_qvel = False"


def test_a_controller_that_declares_no_targets_is_reported_at_its_class(checked: Checked) -> None:
    bare = OWN_CONTROLLER.replace("FLAGS", "pass")
    finding = the_finding(
        checked("controller-targets", (CLASS, bare + CLASS), seeds=1, robot_uids="still_panda")
    )
    assert finding.code == "class Still(BaseController):"
    assert "lacks sets_target_qpos and sets_target_qvel" in finding.message


def test_a_controller_that_declares_its_targets_is_not_reported(checked: Checked) -> None:
    declared = OWN_CONTROLLER.replace("FLAGS", FLAGS)
    result = checked("controller-targets", (CLASS, declared + CLASS), seeds=1, robot_uids="still_panda")
    assert result.state == "kept"

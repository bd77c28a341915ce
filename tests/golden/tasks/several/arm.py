"""The robot of the golden recording whose task has several modules."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers import PDJointPosControllerConfig
from mani_skill.agents.registration import register_agent


@register_agent()
class GoldenArm(BaseAgent):
    uid = "golden_arm"
    urdf_path = str(Path(__file__).parent / "pusher.urdf")

    @property
    def _controller_configs(self) -> dict[str, Any]:
        joints = ["forward", "sideways"]
        return {
            "pd_joint_delta_pos": PDJointPosControllerConfig(
                joints, -0.02, 0.02, stiffness=1e3, damping=1e2, force_limit=50, use_delta=True
            )
        }

"""A task whose ``evaluate`` returns every type that ManiSkill passes on, and types that change between steps."""

from __future__ import annotations

from pathlib import Path

TEXT = """
import numpy as np
import torch
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv
from mani_skill.utils.registration import register_env


class Mute:
    def __repr__(self):
        raise ValueError("nothing to be said")


@register_env("OddEntries-v1", max_episode_steps=6, override=True)
class OddEntriesEnv(PushCubeEnv):
    def evaluate(self):
        n, step = self.num_envs, int(self._elapsed_steps[0])
        away = torch.linalg.norm(self.obj.pose.p[:, :2] - self.goal_region.pose.p[:, :2], dim=1)
        entries = {
            "success": away < 0.05,
            "away": away,
            "best": None if step < 3 else 0.25 * step,
            "phase": "reach" if step < 2 else "push",
            "stage": 2,
            "progress": away.mean(),
            "stats": {"mean": {"away": away.mean()}, "each": away[:, None].repeat(1, 2), "empty": {}},
            "goal": self.goal_region.pose.p[0, :2],
            "words": ["cube %d" % i for i in range(n)],
            "half": away.to(torch.bfloat16),
            "mute": Mute(),
            "map": torch.zeros(300, 300),
            7: "seven",
            "stats/each": "another of that name",
            "complex": away + 1j,
            "learnt": away.clone().requires_grad_(),
            "array": np.full(n, 2),
            "text <b>": "line\\nand \\x00 \\ud800",
            "turns": away if step % 2 else away.mean(),
        }
        if step % 3 == 1:
            entries["sometimes"] = "now"
        return entries

    def compute_dense_reward(self, obs, action, info):
        reward = super().compute_dense_reward(obs, action, info)
        info["reward_terms"] = {"all": reward, "mean": reward.mean(), "note": "none"}
        return reward
"""


def write_task(folder: Path) -> Path:
    """Write the task as a file in `folder`."""
    file = folder / "odd_entries.py"
    file.write_text(TEXT)
    return file

"""Bodies inside each other are found in their env, deepest first, and bodies that nothing moves are known."""

# ManiSkill annotates an env's members as the widest thing they may be.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

from __future__ import annotations

import pytest
import sapien
import torch
from mani_skill.utils.structs.pose import Pose

from tests.envs.by_hand import box, by_hand
from tests.envs.stock_env import Bare, batch_of
from workbench.envs.overlaps import first_substep, immovable, overlaps_of, overlaps_to_report

pytestmark = pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")


class Inside(Bare):
    """A box is 1 cm in a second one in env 1, 3 cm in env 2; a third is 1 mm in the floor, and a lamp stands in a wall."""

    def _load_scene(self, options: dict) -> None:
        box(self, "floor", [3, 3, 0.1], sapien.Pose([0, 0, -0.1]), "static")
        box(self, "wall", pose=sapien.Pose([2, 0, 0.5]), kind="static")
        box(self, "lamp", pose=sapien.Pose([2, 0, 0.56]), kind="kinematic")
        self.one = box(self, "one", pose=sapien.Pose([-1, 0, 1]))
        box(self, "other", pose=sapien.Pose([-1, 0, 1.2]))
        box(self, "low", pose=sapien.Pose([1, 0, 0.049]))
        by_hand(self, 2, "fixed")
        self.free = by_hand(self, 1, "free", fixed=False)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        height = torch.tensor([0.8, 1.11, 1.13])[env_idx]
        self.one.set_pose(Pose.create_from_pq(torch.stack([0 * height - 1, 0 * height, height], dim=1)))
        self.free.set_pose(sapien.Pose([0, 2, 1]))


def test_overlaps_are_those_of_the_env_with_their_depth() -> None:
    env = batch_of(Inside, 3)
    env.reset(seed=0)
    first_substep(env)
    for number, depth in enumerate([None, 0.01, 0.03]):
        found = overlaps_of(env, number)
        depths = [overlap.depth for overlap in found]
        assert depths == sorted(depths, reverse=True)
        of = {overlap.bodies: overlap.depth for overlap in found}
        assert of["floor", "low"] == pytest.approx(1e-3, abs=2e-4)
        assert not any("link" in name for pair in of for name in pair), "joints hold the links of a chain"
        expected = {} if depth is None else {("one", "other"): pytest.approx(depth, abs=2e-4)}
        assert {pair: d for pair, d in of.items() if "one" in pair} == expected
        [reported] = [overlaps_to_report(env)[number]]
        assert {overlap.bodies: overlap.depth for overlap in reported} == expected
    env.close()


def test_what_no_contact_moves() -> None:
    env = batch_of(Inside, 2)
    assert immovable(env) == {"floor", "wall", "lamp", "fixed/base"}
    env.close()

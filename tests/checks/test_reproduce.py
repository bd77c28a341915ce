"""Rules for running in any order and for reproducible runs, each with a task that breaks it and one that keeps it."""

from __future__ import annotations

import pytest

from tests.checks.checked import Checked, the_finding

pytestmark = pytest.mark.thorough

DRAWN = "torch.rand((b, 2))"
GOAL_POSE = "self.goal.set_pose(Pose.create_from_pq(p=goal, q=[1, 0, 0, 0]))"
SIZE = "builder.add_box_collision(half_size=[CUBE_HALF_SIZE] * 3)"


def test_a_partial_reset_that_fails(checked: Checked) -> None:
    finding = the_finding(checked("runs", (DRAWN, "torch.rand((self.num_envs, 2))"), seeds=4))
    assert finding.degree == "stop" and finding.code.startswith("cube[:, :2] = ")


def test_unseeded_random_numbers(checked: Checked) -> None:
    finding = the_finding(
        checked("same-seed", (DRAWN, "torch.tensor(np.random.rand(b, 2)).float()"), seeds=4)
    )
    assert finding.degree == "stop" and "np.random.rand() is not seeded" in finding.message
    assert "actors/cube" in finding.message and "np.random.rand" in finding.code


def test_random_numbers_are_reported_at_the_hook_that_draws_them(checked: Checked) -> None:
    noisy = '"cube_height": height,', '"cube_height": height + torch.rand(self.num_envs),'
    finding = the_finding(checked("same-seed", noisy, seeds=4))
    assert finding.function == "evaluate" and finding.code.startswith('"cube_height": height + torch.rand')
    assert "torch.rand() is not seeded" in finding.message


def test_a_value_that_only_the_first_reset_draws(checked: Checked) -> None:
    edits = (
        (DRAWN, "self.drawn()"),
        (
            "    def evaluate(self)",
            "    def drawn(self):\n"
            "        self.count = getattr(self, 'count', 0) + 1\n"
            "        return torch.full((1, 2), 0.01 * self.count)\n\n"
            "    def evaluate(self)",
        ),
    )
    assert "actors/cube" in the_finding(checked("same-seed", *edits, seeds=4)).message


def test_a_goal_that_is_missing_in_the_state(checked: Checked) -> None:
    kept = (
        (GOAL_POSE, "self.goal_pos[env_idx] = goal"),
        (
            'self.goal = builder.build_kinematic(name="goal")',
            "self.goal_pos = torch.zeros((self.num_envs, 3))",
        ),
        ("self.goal.pose.p[:, :2]", "self.goal_pos[:, :2]"),
        ("self.goal.pose.p", "self.goal_pos"),
    )
    finding = the_finding(checked("state-restores", *kept, seeds=4))
    assert "evaluate()['cube_to_goal']" in finding.message and finding.function == "_initialize_episode"


def test_random_pushes_in_a_step(checked: Checked) -> None:
    pushed = (
        "    def evaluate(self)",
        "    def _before_control_step(self):\n"
        "        self.push = torch.rand(self.num_envs)\n\n"
        "    def evaluate(self)",
    )
    begun = GOAL_POSE, f"{GOAL_POSE}\n            self.push = torch.zeros(self.num_envs)"
    noisy = '"cube_height": height,', '"cube_height": height + self.push,'
    finding = the_finding(checked("actions-replay", pushed, begun, noisy, seeds=4))
    assert "cube_height" in finding.message and finding.function == "_before_control_step"
    assert finding.code == "self.push = torch.rand(self.num_envs)"


def test_sizes_that_depend_on_the_number_of_envs(checked: Checked) -> None:
    many = (
        """for i in range(self.num_envs):
            size = {}
            each = self.scene.create_actor_builder()
            each.add_box_collision(half_size=[size] * 3)
            each.initial_pose = sapien.Pose(p=[0.4, 0.4, 0.5])
            each.set_scene_idxs([i])
            each.build_static(name=f"box_{{i}}")
        """
        + SIZE
    )
    finding = the_finding(
        checked("same-for-any-batch", (SIZE, many.format("0.02 + 0.01 * float(torch.rand(1))")), seeds=4)
    )
    assert "seed 2023" in finding.message and finding.function == "_load_scene"
    drawn = many.format("0.02 + 0.01 * self._batched_episode_rng[i].rand()")
    assert checked("same-for-any-batch", (SIZE, drawn), seeds=4).state == "kept"

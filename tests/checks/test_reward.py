"""Rules for rewards, each with a task that breaks it and one that keeps it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.checks.checked import EXAMPLE, Checked, CheckedRules, check_rules, the_finding

pytestmark = pytest.mark.thorough


def test_a_sparse_reward_above_one(checked: Checked) -> None:
    sparse = (
        "    def compute_normalized_dense_reward",
        "    def compute_sparse_reward(self, obs, action, info):\n        return 2.0 - info['cube_to_goal'] * 0\n\n"
        "    def compute_normalized_dense_reward",
    )
    finding = the_finding(checked("reward-normalized", sparse, reward_mode="sparse"))
    assert "goes from 2 to 2" in finding.message and finding.function == "compute_sparse_reward"
    assert checked("reward-normalized", reward_mode="sparse").state == "kept"


def test_a_reward_that_is_nan_in_states_that_random_actions_do_not_reach(checked: Checked) -> None:
    # The cube is within a millimetre of the goal only if it is placed there.
    nan = "reward = reach + push + torch.sqrt((info['cube_to_goal'] - 0.001).sign())\n"
    finding = the_finding(checked("reward-finite", ("reward = reach + push\n", nan)))
    assert "goal" in finding.message
    assert finding.function == "compute_dense_reward"


def test_a_normalized_reward_that_is_not_proportional(checked: Checked) -> None:
    edit = (
        "self.compute_dense_reward(obs, action, info) / 3",
        "(self.compute_dense_reward(obs, action, info) / 3).sqrt()",
    )
    finding = the_finding(checked("reward-ratio", edit))
    assert "no single constant" in finding.message and finding.function == "compute_normalized_dense_reward"


def test_success_that_earns_less_than_the_approach(checked: Checked) -> None:
    finding = the_finding(
        checked("reward-order", ('reward[info["success"]] = 3', 'reward[info["success"]] = 0.5'))
    )
    assert "0.1667 " in finding.message and finding.function == "compute_dense_reward"


OUT_OF_REACH = '"success": (distance < GOAL_RADIUS)', '"success": (self.elapsed_steps > 1000)'


def test_success_that_pays_less_is_found_without_a_successful_episode(checked: Checked) -> None:
    edit = 'reward[info["success"]] = 3', 'reward[info["success"]] = 0.5'
    finding = the_finding(checked("reward-order", OUT_OF_REACH, edit))
    assert 'is 0.1667 wherever info["success"] is true' in finding.message
    more = 'reward[info["success"]] = 3', 'reward[info["success"]] = 5'
    assert (
        "to 1.67 in states with success"
        in the_finding(checked("reward-normalized", OUT_OF_REACH, more)).message
    )


def test_the_reward_of_success_is_not_known_without_a_success(checked_rules: CheckedRules) -> None:
    rules = "reward-order", "reward-needs-success", "success-flickers"
    for result in checked_rules(rules, OUT_OF_REACH).values():
        assert result.state == "not_known" and "episode succeeds" in result.why
    without = (
        ('"success": (distance < GOAL_RADIUS) & (height.abs() < 0.005),', ""),
        ('reward[info["success"]] = 3', ""),
    )
    assert {one.state for one in checked_rules(rules, *without).values()} == {"not_applicable"}


def test_reward_rules_do_not_apply_to_a_task_without_a_reward(checked_rules: CheckedRules) -> None:
    rules = ("reward-finite", "reward-changes", "reward-order", "reward-needs-success", "reward-normalized",
             "reward-rows", "reward-flat")  # fmt: skip
    results = checked_rules(rules, seeds=4, reward_mode="none")
    assert {rule: result.state for rule, result in results.items()} == dict.fromkeys(rules, "not_applicable")


IN_TIME = '"success": (distance < GOAL_RADIUS) & (height.abs() < 0.005)', '"success": self.elapsed_steps == 7'


def test_a_reward_is_compared_with_the_success_of_its_own_step(tmp_path: Path) -> None:
    """Success lasts one step; the largest reward is at that step, or at the step before or after it."""
    rules, most = ("reward-needs-success", "reward-order"), 'reward[info["success"]] = 3'
    for step in (6, 7, 8):
        paid = f"{most[:-1]}1\n        reward[self.elapsed_steps == {step}] = 3"
        text = EXAMPLE.read_text().replace(*IN_TIME).replace(most, paid)
        assert text.count("elapsed_steps ==") == 2
        (tmp_path / "task.py").write_text(text)
        results = check_rules(rules, str(tmp_path / "task.py"), num_envs=4, seeds=4, render_backend="none")
        for rule in rules:
            messages = [finding.message for finding in results[rule].findings]
            assert len(messages) == (step != 7) and all(
                f"(step {step} of seed " in one for one in messages
            ), messages

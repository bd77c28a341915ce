"""Rules of the reward, each with a task that breaks it and one that keeps it."""

from __future__ import annotations

from tests.checks.checked import Checked, the_finding


def test_a_reward_that_is_nan(checked: Checked) -> None:
    edit = "reward = reach + push\n", "reward = reach + push + torch.sqrt(0.7 - reach) * 0\n"
    finding = the_finding(checked("reward-finite", edit))
    assert "nan" in finding.message and finding.function == "compute_dense_reward"
    assert checked("reward-finite").state == "kept"


def test_a_reward_that_never_changes(checked: Checked) -> None:
    edit = "reward = reach + push\n", "reward = torch.ones_like(reach)\n"
    assert "at each of" in the_finding(checked("reward-changes", edit)).message
    assert checked("reward-changes").state == "kept"


def test_a_normalized_reward_above_one(checked: Checked) -> None:
    edit = (
        "self.compute_dense_reward(obs, action, info) / 3",
        "5 * self.compute_dense_reward(obs, action, info)",
    )
    finding = the_finding(checked("reward-normalized", edit))
    assert finding.function == "compute_normalized_dense_reward" and finding.count > 1
    assert checked("reward-normalized").state == "kept"

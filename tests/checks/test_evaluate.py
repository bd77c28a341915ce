"""Rules for the entries of ``evaluate``, each with a task that breaks it and one that keeps it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.checks.checked import Checked, the_finding
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv
from workbench.task.problem import Problem, TaskError

pytestmark = pytest.mark.thorough


def test_an_entry_that_is_nearly_success(checked: Checked) -> None:
    finding = the_finding(
        checked("entry-name", ('"success": (dist', '"succes": (dist'), ('info["success"]', 'info["succes"]'))
    )
    assert "'succes'" in finding.message and finding.code.startswith('"succes"')


class Raises:
    """An actor whose policy raises before its first step."""

    kind, seeds, lengths = "given", (0, 1), (5, 5)

    def begin(self, task: TaskEnv, episodes: Sequence[int]) -> StepResult:
        raise TaskError(Problem("policy", "no such joint", "policy.py", 3, "act()", ""))

    def next_action(self, task: TaskEnv, step: int) -> NDArray[np.float32]:
        raise AssertionError("no episode begins")


def test_a_breach_that_was_found_before_a_policy_raised_counts(checked: Checked) -> None:
    edit = '"cube_height": height', '"cube_height": torch.log(height - 1)'
    result = checked("entries-finite", edit, num_envs=2, seeds=2, actors=[Raises()])
    finding = the_finding(result)
    assert "not finite in 2 of 2 random episodes, first at step 0 of seed 0" in finding.message
    assert finding.code.startswith('"cube_height"') and finding.degree == "warn"
    assert result.problem is not None and result.problem.message == "no such joint"


def test_a_comment_with_a_reason_silences_a_finding(checked: Checked) -> None:
    easy = '"success": (distance < 1) & (height.abs() < 0.005),'
    edit = '"success": (distance < GOAL_RADIUS) & (height.abs() < 0.005),'
    why = "begins where another task ends"
    result = checked("success-at-reset", (edit, f"{easy}  # workbench: off[success-at-reset] {why}"))
    assert result.state == "silenced" and result.silenced[0].reason == why and not result.findings
    assert (
        checked("success-at-reset", (edit, f"{easy}  # workbench: off[success-at-reset]")).state == "broken"
    )
    assert (
        checked("success-at-reset", (edit, f"{easy}  # workbench: off[reward-rows] {why}")).state == "broken"
    )


def test_an_entry_without_a_row_per_env(checked: Checked) -> None:
    finding = the_finding(checked("info-rows", ('"cube_height": height', '"cube_height": height.mean()')))
    assert "'cube_height'" in finding.message and finding.code.startswith('"cube_height"')

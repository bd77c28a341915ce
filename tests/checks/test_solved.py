"""Rules on planned episodes: off by default, and not judged where no plan can be made."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.checks.checked import check_rule
from workbench.checks.job_items import CheckOptions, count_rules, degrees_of_request
from workbench.checks.rule_table import SOLVE_RULES, degree_of_each
from workbench.planning.verdicts import VERDICTS

TASKS = Path(__file__).parents[2] / "tasks"


def test_planning_rules_are_off_by_default() -> None:
    assert set(VERDICTS) == SOLVE_RULES
    assert {degree_of_each()[rule] for rule in SOLVE_RULES} == {"off"}
    assert {degree_of_each(solve=True)[rule] for rule in SOLVE_RULES} == {"warn"}
    selected = degree_of_each(["reward-flat"])
    assert selected["reward-flat"] == "warn" and selected["reward-stuck"] == "off"
    assert degree_of_each(ignore=["reward-flat"], solve=True)["reward-flat"] == "off"
    counted = [count_rules(degrees_of_request(CheckOptions("x", solve=solve))) for solve in (False, True)]
    assert counted[1] - counted[0] == len(SOLVE_RULES)
    with pytest.raises(ValueError, match="use --solve"):
        degrees_of_request(CheckOptions("x", actions="solve"))


@pytest.mark.parametrize(
    ("name", "state", "why"),
    [
        ("different_objects", "not_known", "different in each env"),
        ("minimal", "not_applicable", "maximises the reward"),
    ],
)
def test_a_task_that_cannot_be_planned_is_not_judged_with_the_reason(name: str, state: str, why: str) -> None:
    given = {"reward_mode": "none"} if name == "minimal" else {}
    result = check_rule(
        "reward-flat", str(TASKS / f"{name}.py"), num_envs=2, seeds=1, render_backend="none", **given
    )
    assert result.state == state and why in result.why

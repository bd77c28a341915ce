"""Each task of ``tasks/broken`` breaks the rule that it is there to show, and no other that stops a task."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.checks.checked import check_rules
from workbench.checks.rules import RULES

FOLDER = Path(__file__).parents[2] / "tasks" / "broken"
BROKEN = {
    "lift_cube": "entry-name",
    "push_to_square": "success-at-reset",
    "roll_straight": "reward-finite",
    "touch_cube": "camera-sees",
}


@pytest.mark.parametrize("name", BROKEN)
def test_its_rule_is_broken_and_no_other_that_stops(name: str, renderer: None) -> None:
    results = check_rules(RULES, str(FOLDER / f"{name}.py"), num_envs=4, seeds=4)
    broken = {rule for rule, result in results.items() if result.state == "broken"}
    assert BROKEN[name] in broken
    assert {rule for rule in broken if RULES[rule].degree == "stop"} <= {BROKEN[name]}
    assert not [result for result in results.values() if result.state == "failed"]

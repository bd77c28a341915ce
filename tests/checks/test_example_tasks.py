"""The README's example task keeps every rule."""

from __future__ import annotations

from pathlib import Path

from tests.checks.checked import check_rules
from workbench.checks.rule_table import RULES, SOLVE_RULES

TASKS = Path(__file__).parents[2] / "tasks"
NOT_APPLICABLE = {
    *("hull-fills-hollow", "heavy-mesh", "reconfigures", "hidden-objects", "hidden-goal"),
    *("rows-lost", "rows-rewritten", "success-and-fail", "success-flickers", "id-taken"),
}
"""Rules that do not apply to the example, or need states that random episodes do not reach."""


def test_the_example_breaks_no_rule(renderer: None) -> None:
    """tests/test_every_command.py checks the other examples with the command and its options."""
    file = TASKS / "push_cube.py"
    results = check_rules(RULES.keys() - SOLVE_RULES - {"id-taken"}, str(file), num_envs=4, seeds=4)
    assert [result for result in results.values() if result.state in ("broken", "failed")] == []
    kept = {rule for rule, result in results.items() if result.state == "kept"}
    assert kept >= RULES.keys() - SOLVE_RULES - NOT_APPLICABLE

"""Each example task keeps every rule."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.checks.checked import check_rules
from workbench.checks.rules import RULES, SOLVE_RULES

EXAMPLES = sorted((Path(__file__).parents[2] / "tasks").glob("*.py"))
NOT_ASKED = {
    *("hull-fills-hollow", "heavy-mesh", "reconfigures", "hidden-objects", "hidden-goal"),
    *("rows-lost", "rows-rewritten", "success-and-fail", "success-flickers", "id-taken"),
}
"""Of the quick one: it has nothing of the kind, or no random episode comes there."""


@pytest.mark.parametrize(
    "file",
    [file if file.stem == "push_cube" else pytest.param(file, marks=pytest.mark.slow) for file in EXAMPLES],
    ids=lambda file: file.stem,
)
def test_no_rule_is_broken_by_it(file: Path, renderer: None) -> None:
    quick = file.stem == "push_cube"
    results = check_rules(
        RULES.keys() - SOLVE_RULES - {"id-taken"}, str(file), num_envs=4, seeds=4 if quick else 8
    )
    assert [result for result in results.values() if result.state in ("broken", "failed")] == []
    if quick:
        kept = {rule for rule, result in results.items() if result.state == "kept"}
        assert kept >= RULES.keys() - SOLVE_RULES - NOT_ASKED

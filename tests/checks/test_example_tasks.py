"""Each example task keeps every rule."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.checks.checked import check_rules
from workbench.checks.rules import RULES, SOLVE_RULES

EXAMPLES = sorted((Path(__file__).parents[2] / "tasks").glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.stem)
def test_no_rule_is_broken_by_it(file: Path, renderer: None) -> None:
    results = check_rules(RULES.keys() - SOLVE_RULES, str(file), num_envs=4, seeds=8)
    assert [result for result in results.values() if result.state in ("broken", "failed")] == []

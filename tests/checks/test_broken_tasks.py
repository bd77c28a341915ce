"""The small tasks in ``tasks/broken``: each breaks one rule of resets, and no other that stops."""

from __future__ import annotations

from pathlib import Path

import pytest

from workbench.authoring.loading.load import load_task, undo_load
from workbench.checks import placement, reproduce, scene
from workbench.checks.checkup import Checkup
from workbench.checks.rules import RULES, degree_of_each
from workbench.checks.run import GROUPS, RuleResult, core_results, run_group

BROKEN = Path(__file__).parents[2] / "tasks" / "broken"
OURS = {**scene.CHECKS, **placement.CHECKS, **reproduce.CHECKS}


def check_all(file: Path) -> list[RuleResult]:
    degrees = degree_of_each()
    loaded = load_task(str(file))
    checkup = Checkup(loaded, num_envs=4, seeds=4)
    try:
        results = [result for group in GROUPS for result in run_group(group, checkup, degrees)]
        return results + list(core_results(checkup.findings, degrees))
    finally:
        checkup.close()
        undo_load(loaded)


@pytest.mark.parametrize(
    ("name", "rule", "line"),
    [
        ("slide_block", "overlap-at-reset", "self.block.set_pose("),
        ("match_arrow", "quaternion-order", "self.arrow.set_pose("),
        ("calm_reach", "batch-of-reset", "self.travelled = torch.zeros(self.num_envs)"),
        ("knock_can", "same-seed", "can[:, :2] = torch.tensor(np.random.uniform("),
    ],
)
def test_its_mistake_is_found_and_nothing_else(name: str, rule: str, line: str) -> None:
    results = check_all(BROKEN / f"{name}.py")
    assert [each.rule for each in results if each.state == "broken" and each.rule in OURS] == [rule]
    (finding,) = next(each for each in results if each.rule == rule).findings
    assert finding.code.startswith(line)
    stops = {
        each.rule
        for each in results
        if each.state in ("broken", "failed") and RULES[each.rule].degree == "stop"
    }
    assert stops <= {rule}
    assert not [each for each in results if each.state == "failed"]

"""What a user does with a task, on every example, template and built-in task: the real commands, with default options."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.sweeps.every_command import EXAMPLES, FROM_TEMPLATES, built_in, walk
from tests.sweeps.upstream_faults import faults_of
from workbench.checks.rules import RULES as ALL_RULES
from workbench.checks.rules import SOLVE_RULES

WITHOUT_SUCCESS, WITHOUT_REWARD, SEVERAL_ROBOTS = "swing_up", "Empty-v1", "two_robots"
NO_TABLE, FAILS_IN_PARTIAL_RESETS = "template minimal", "MS-HopperHop-v1"
QUICK = (WITHOUT_SUCCESS, WITHOUT_REWARD, SEVERAL_ROBOTS, NO_TABLE, FAILS_IN_PARTIAL_RESETS)
RULES = ALL_RULES.keys() - SOLVE_RULES
NO_PLAN: dict[str, str] = {
    "different_objects": "builds another body in each env",
    WITHOUT_REWARD: "has no reward",
}
"""Tasks that ``solve`` refuses with exit code 2, and why."""


def marked(task: str) -> object:
    return task if task in QUICK else pytest.param(task, marks=pytest.mark.slow)


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("task", [marked(task) for task in (*EXAMPLES, *FROM_TEMPLATES, *built_in())])
def test_a_task_can_be_opened_checked_recorded_rescored_exported_and_solved(
    task: str, tmp_path: Path, child_process: None
) -> None:
    fails_upstream = any(fault.stage == "partial reset" for fault in faults_of(task).values())
    for ran in walk(task, tmp_path):
        assert ran.code in (0, 1) or (ran.command == "solve" and task in NO_PLAN and ran.code == 2), ran.err
        if ran.command in ("open", "check"):
            states = {one["rule"]: one["state"] for one in ran.told["rules"]}
            assert states.keys() == RULES and ran.rules("failed") == {}
            if task not in built_in():
                assert ran.broken == []
            elif not fails_upstream:
                assert states["runs"] == "kept"
        elif ran.command != "solve":
            assert ran.code == 0 or (ran.command == "record" and fails_upstream), ran.err

"""Every command on every example, template and built-in task."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pytest

from tests.sweeps.every_command import EXAMPLES, FROM_TEMPLATES, Ran, built_in, fails_in_partial_resets, walk
from workbench.checks.rule_table import RULES as ALL_RULES
from workbench.checks.rule_table import SOLVE_RULES

WITHOUT_SUCCESS, WITHOUT_REWARD, SEVERAL_ROBOTS = "swing_up", "Empty-v1", "two_robots"
NO_TABLE, FAILS_IN_PARTIAL_RESETS = "template minimal", "MS-HopperHop-v1"
QUICK = (WITHOUT_SUCCESS, WITHOUT_REWARD, SEVERAL_ROBOTS, NO_TABLE)
RULES = ALL_RULES.keys() - SOLVE_RULES
BUILT_IN_SAMPLES = WITHOUT_REWARD, FAILS_IN_PARTIAL_RESETS, "PickCube-v1"
DRAWN = {"TableTopFreeDraw-v1", "DrawSVG-v1"}
"""Excluded: each takes two minutes for its hundreds of bodies; DrawTriangle-v1 is similar and included."""
LIKE_ANOTHER = {
    "MS-AntWalk-v1",
    "MS-HumanoidRun-v1",
    "MS-HumanoidWalk-v1",
    *(f"RotateValveLevel{level}-v1" for level in (1, 3, 4)),
    *(f"TriFingerRotateCubeLevel{level}-v1" for level in range(1, 4)),
}
"""Excluded: a target speed or a difficulty level sets them apart from a task that is included. `envs/test_every_task.py` opens them too."""
IN_PROCESSES = (
    *"cameras custom_scene different_objects obs_history own_robot push_cube swing_up two_robots".split(),
    *BUILT_IN_SAMPLES,
)
"""Tasks that are also tested in processes, with default options."""
WALKED = [
    *FROM_TEMPLATES,
    *(one for one in EXAMPLES if one not in IN_PROCESSES),
    *(one for one in built_in() if one not in DRAWN | LIKE_ANOTHER),
]
OTHER_BODIES_IN_EACH_ENV = (
    "different_objects",
    "PegInsertionSide-v1",
    "SO100GraspCube-v1",
    "RotateSingleObjectInHandLevel1-v1",
    *(f"RotateValveLevel{level}-v1" for level in range(5)),
)
NO_PLAN = WITHOUT_REWARD, *OTHER_BODIES_IN_EACH_ENV
"""Tasks that ``solve`` refuses with exit code 2."""


@pytest.mark.timeout(300)
# Some of ManiSkill's own tasks break warning rules.
@pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")
@pytest.mark.parametrize(
    "task", [*QUICK, *(pytest.param(one, marks=pytest.mark.slow) for one in WALKED if one not in QUICK)]
)
def test_every_command_works_with_each_kind_of_task(
    task: str, tmp_path: Path, renderer: None, child_process: None
) -> None:
    """Uses few envs, seeds and rollouts, all in this process."""
    require_success(task, walk(task, tmp_path, quick=True))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("task", IN_PROCESSES)
def test_a_task_can_be_opened_checked_recorded_rescored_exported_and_solved(
    task: str, tmp_path: Path, child_process: None
) -> None:
    """Runs the commands in processes with default options, as users do. For all built-in tasks this would take two hours;
    `python -m tests.sweeps.every_command` does it."""
    # The Checks tab checks the same as the command.
    require_success(task, walk(task, tmp_path, checks=task in (WITHOUT_SUCCESS, FAILS_IN_PARTIAL_RESETS)))


def require_success(task: str, walked: Iterable[Ran]) -> None:
    for ran in walked:
        assert ran.code in (0, 1) or (ran.command == "solve" and task in NO_PLAN and ran.code == 2), ran.err
        if ran.output is not None and ran.command in ("open", "check"):
            states = {one["rule"]: one["state"] for one in ran.output["rules"]}
            assert states.keys() == RULES and ran.rules("failed") == {}
            if task not in built_in():
                assert ran.broken == []
            elif not fails_in_partial_resets(task):
                assert states["runs"] == "kept"
        elif ran.command != "solve":
            assert ran.code == 0, ran.err

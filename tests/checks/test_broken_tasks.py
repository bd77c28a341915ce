"""Each task in ``tasks/broken`` breaks the rule that it demonstrates, and no other rule that stops a task."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.checks.checked import check_rules, the_finding
from workbench.checks.rule_table import RULES, SOLVE_RULES

FOLDER = Path(__file__).parents[2] / "tasks" / "broken"
BROKEN = {
    "calm_reach": ("batch-of-reset", "self.travelled = torch.zeros(self.num_envs)"),
    "gather_blocks": ("unknown-name", "builder.inital_pose ="),
    "hover_over_cube": ("foreign-device", "wanted = self.cube.pose.p + torch.tensor("),
    "knock_can": ("same-seed", "can[:, :2] = torch.tensor(np.random.uniform("),
    "lift_cube": ("entry-name", ""),
    "match_arrow": ("quaternion-order", "self.arrow.set_pose("),
    "nudge_ball": ("device-copies", "near = [1 - min(each.item(), 1)"),
    "push_to_square": ("success-at-reset", ""),
    "roll_straight": ("reward-finite", ""),
    "slide_block": ("overlap-at-reset", "self.block.set_pose("),
    "tip_block": ("loop-over-envs", "for i in range(self.num_envs):"),
    "touch_cube": ("camera-sees", ""),
}
"""The broken rule of each task, and the beginning of the line of its finding."""
WHEN_SOLVED = {"reach_ball": ("reward-exploited", "def compute_dense_reward(")}
"""The same for rules that need planned episodes."""
ALSO_BROKEN = {
    "calm_reach": {"rows-rewritten"},
    "push_to_square": {"reward-changes"},
    "gather_blocks": {"initial-pose", "robot-pose", "overlap-at-load"},
    "knock_can": {"unseeded-random", "actions-replay"},
    "nudge_ball": {"loop-over-envs"},
}
"""Other rules that the same mistake breaks."""
QUICK = {"knock_can"}
"""Tasks of the quick tests; the other files in this folder test every rule."""


def test_every_small_task_is_listed() -> None:
    assert {file.stem for file in FOLDER.glob("*.py")} == BROKEN.keys() | WHEN_SOLVED.keys()


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in BROKEN]
)
def test_a_broken_task_breaks_its_rule_at_its_line_and_no_other(name: str, renderer: None) -> None:
    rule, line = BROKEN[name]
    results = check_rules(RULES.keys() - SOLVE_RULES, str(FOLDER / f"{name}.py"), num_envs=4, seeds=4)
    assert the_finding(results[rule]).code.startswith(line)
    broken = {each for each, result in results.items() if result.state == "broken"}
    assert broken - {rule} <= ALSO_BROKEN.get(name, set())
    assert not [result for result in results.values() if result.state == "failed"]


@pytest.mark.slow
@pytest.mark.timeout(1200)  # it plans for eight seeds
@pytest.mark.parametrize("name", WHEN_SOLVED)
def test_a_broken_task_breaks_its_planning_rule_and_no_other(name: str) -> None:
    rule, line = WHEN_SOLVED[name]
    # With fewer seeds none is solved, and then the reward of success is unknown.
    file = str(FOLDER / f"{name}.py")
    results = check_rules(SOLVE_RULES, file, num_envs=4, seeds=8, render_backend="none")
    finding = the_finding(results[rule])
    assert finding.code.startswith(line) and "without success" in finding.message
    # The number of solved seeds depends on floating-point details of the CPU.
    assert re.match(r"planning solved [1-8] of 8 seeds", results[rule].notes[0])
    broken = {each for each, result in results.items() if result.state in ("broken", "failed")}
    # The reward also does not keep the hand at the ball.
    assert broken <= {rule, "success-lost"}


@pytest.mark.slow
def test_the_fixed_version_breaks_no_planning_rule() -> None:
    # With fewer seeds the result notes that they are too few.
    file = str(FOLDER / "fixed" / "reach_ball.py")
    results = check_rules(SOLVE_RULES, file, num_envs=4, seeds=8, render_backend="none")
    states = {rule: result.state for rule, result in results.items()}
    assert states.pop("failing-pays") == "not_applicable"  # it has no `fail`
    assert set(states.values()) == {"kept"}, states
    assert results["reward-exploited"].notes[0].startswith("planning solved 8 of 8 seeds")

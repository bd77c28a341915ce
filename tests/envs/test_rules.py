"""The rules' default degrees, and the list of broken rules."""

# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import linecache
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import torch
from mani_skill.utils.structs.pose import Pose

from tests.drive.envs import CPU, PICK_CUBE, batched
from workbench.envs.broken_rule import MAX_PLACES, BrokenRule, BrokenRules, RuleWarning, frames_of_the_task
from workbench.envs.gpu_rules import Finding, degrees_of, fails, silence_of

N = 3


def test_only_writes_to_other_envs_and_missing_rows_stop_by_default() -> None:
    stops = {rule for rule, degree in degrees_of(None).items() if degree == "stop"}
    assert stops == {
        "other-env-written",
        "rows-lost",
        "evaluate-rows",
    }
    assert {degree for rule, degree in degrees_of(None).items() if rule not in stops} == {"warn"}


def _raised(env: Any) -> Pose:
    pose = env.cube.pose.raw_pose.clone()
    pose[:, 2] += 0.05
    return Pose.create(pose)


# --- the list of broken rules -----------------------------------------------------------------------


def broken_rules() -> BrokenRules:
    return BrokenRules(degrees_of("warn"), lambda finding: None)


def test_a_rule_broken_at_each_step_is_one_row_with_a_count() -> None:
    rules = broken_rules()
    for rules.step in range(5):
        rules.report_breach("not-applied", f"lost in step {rules.step}", None, ("task.py", 7, "lift"))
    (row,) = rules.rows
    assert (row.count, row.first_step, row.message) == (5, 0, "lost in step 0")
    assert (row.file, row.line, row.function) == ("task.py", 7, "lift")


def test_steps_are_counted_from_where_the_task_begins() -> None:
    rules = broken_rules()
    rules.step = 7  # steps of the trial before the task begins
    rules.report_breach("not-applied", "lost", None, ("task.py", 7, "lift"))
    rules.begin()
    rules.step += 2
    rules.report_breach("not-applied", "lost", None, ("task.py", 9, "drop"))
    assert [(row.line, row.first_step) for row in rules.rows] == [(7, 0), (9, 2)]


def test_rows_are_bounded_and_the_rest_is_counted() -> None:
    rules, serial = broken_rules(), 0
    for line in range(3 * MAX_PLACES):
        rules.report_breach("not-applied", "lost", None, ("task.py", line, "lift"))
        assert rules.serial > serial
        serial = rules.serial
    assert len(rules.rows) == MAX_PLACES and rules.more == 2 * MAX_PLACES
    rules.report_breach("not-applied", "lost", None, ("task.py", 0, "lift"))
    assert rules.rows[0].count == 2 and rules.more == 2 * MAX_PLACES, "a place that is kept is still counted"


def test_after_an_edit_rows_that_are_not_broken_again_are_removed() -> None:
    rules = broken_rules()
    with rules.during("step"):
        rules.report_breach("not-applied", "lost", None, ("task.py", 7, "lift"))
    with rules.during("reset"):
        rules.report_breach("rows-rewritten", "drawn", None, ("task.py", 9, "draw"), subject="target")
    rules.edited(lambda row: ("task.py", (row.line or 0) + 1))
    assert [(row.rule, row.line) for row in rules.rows] == [("not-applied", 8), ("rows-rewritten", 10)]
    with pytest.raises(ZeroDivisionError), rules.during("step"):
        raise ZeroDivisionError  # a step that did not finish confirms nothing
    with rules.during("reset", confirms=False):
        pass
    assert len(rules.rows) == 2
    with rules.during("step"):
        pass
    assert [row.rule for row in rules.rows] == ["rows-rewritten"]
    with rules.during("reset"):
        rules.report_breach("rows-rewritten", "drawn", None, ("task.py", 10, "draw"), subject="target")
    assert rules.rows[0].count == 2


def test_a_comment_silences_its_line_until_the_file_is_edited(tmp_path: Path) -> None:
    file = tmp_path / "task.py"
    file.write_text("x = 1  # workbench: off[not-applied] the GPU is far\ny = 2\n")
    rules = broken_rules()
    for line in (1, 1, 2):
        rules.report_breach("not-applied", "lost", None, (str(file), line, "lift"))
    assert [(row.line, row.count) for row in rules.rows] == [(2, 1)]
    assert [(finding.line, silence.reason) for finding, silence in rules.silenced] == [(1, "the GPU is far")]
    rules.edited(lambda row: (str(file), row.line or 0))
    assert rules.silenced == () and [row.line for row in rules.rows] == [2]


SILENCED = """\
# workbench: off[not-applied] above the class
class Task:
    @decorated
    def lift(self):  # workbench: off[rows-lost, not-applied] in the whole function
        x = 1
        # workbench: off[stepped-in-reset] alone above
        y = 2
        z = 3

    def drop(self):
        a = 1  # workbench: off[rows-lost]
        b = 2  # workbench: off[rows-lost] not of the next line
        c = 3
"""


@pytest.mark.parametrize(
    ("line", "rules"),
    [
        (1, {"not-applied"}),
        (2, {"not-applied"}),
        (3, {"rows-lost", "not-applied"}),  # the decorator belongs to its function
        (5, {"rows-lost", "not-applied"}),
        (7, {"rows-lost", "not-applied", "stepped-in-reset"}),
        (8, {"rows-lost", "not-applied"}),
        (10, set()),
        (11, set()),  # without a reason a comment silences nothing
        (12, {"rows-lost"}),
        (13, set()),
    ],
)
def test_a_comment_silences_its_line_the_next_if_alone_and_the_whole_function(
    tmp_path: Path, line: int, rules: set[str]
) -> None:
    file = tmp_path / "task.py"
    file.write_text(SILENCED)
    every = ("not-applied", "rows-lost", "stepped-in-reset", "link-pose-set")
    assert {rule for rule in every if silence_of(str(file), line, rule)} == rules
    assert silence_of(None, line, "rows-lost") is silence_of("<string>", line, "rows-lost") is None


@pytest.mark.parametrize(
    ("fail_on", "failing"), [("stop", ["stop"]), ("warn", ["stop", "warn"]), ("never", [])]
)
def test_findings_of_a_degree_make_a_command_fail(fail_on: Any, failing: list[str]) -> None:
    assert [degree for degree in ("stop", "warn", "off") if fails(cast(Any, degree), fail_on)] == failing


def test_a_row_takes_the_exact_line_once_it_is_known_and_keeps_it(tmp_path: Path) -> None:
    file = tmp_path / "task.py"
    file.write_text("first\nsecond\nthird\n")
    rules = broken_rules()

    def breach(line: int, exact: bool) -> Finding:
        place = (str(file), line, "draw")
        if exact:
            frame = compile("\n" * (line - 1) + "frames = here()", str(file), "exec")
            known: dict[str, Any] = {"__name__": "task", "here": frames_of_the_task}
            exec(frame, known)
            rules.report_breach("rows-rewritten", "drawn", known["frames"], subject="target")
        else:
            rules.report_breach("rows-rewritten", "drawn", None, place, subject="target")
        (row,) = rules.rows
        return row

    assert [(row.line, row.code, row.count) for row in [breach(1, False)]] == [(1, "first", 1)]
    for number, line in enumerate((2, 3)):
        row = breach(line, True)
        assert (row.line, row.code, row.count) == (2, "second", 2 + number)
    assert breach(1, False).line == 2
    rules.edited(lambda row: (str(file), 3))
    (row,) = rules.rows
    assert (row.line, row.code) == (3, "third")
    assert row.key != replace(row, code="second").key and row.key == replace(row, line=9, count=1).key


def test_a_rule_that_is_off_reports_nothing_and_one_that_stops_names_its_line() -> None:
    rules = BrokenRules({"rows-lost": "off", "not-applied": "stop", "evaluate-rows": "off"}, lambda _: None)
    rules.report_breach("rows-lost", "lost", None, ("task.py", 7, "lift"))
    rules.returned("evaluate-rows", "evaluate", "is wrong", None)
    assert rules.rows == ()
    with pytest.raises(BrokenRule) as caught:
        rules.report_breach("not-applied", "lost", None, ("task.py", 7, "lift"))
    assert (caught.value.rule, caught.value.place) == ("not-applied", ("task.py", 7, "lift"))


def test_each_of_several_lost_writes_is_reported() -> None:
    def lose(self: Any) -> None:
        self.cube.set_pose(_raised(self))
        self.goal_site.set_pose(_raised(self))

    found: list[Finding] = []
    task = type("LosesTwo", (PICK_CUBE,), {"_before_control_step": lose})
    env: Any = batched(task, N, on_finding=found.append)
    env.step(np.zeros((N, 8), np.float32))
    env.close()
    assert [("'cube'" in finding.message, "'goal_site'" in finding.message) for finding in found] == [
        (True, False),
        (False, True),
    ]


def test_make_uses_the_rules_default_degrees_unless_given_one() -> None:
    import workbench

    class Lifts(PICK_CUBE):
        def _before_control_step(self) -> None:
            self.cube.set_pose(_raised(self))  # the fault

    class Writes(PICK_CUBE):
        def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
            super()._initialize_episode(env_idx, options)
            self.scene.px.cuda_rigid_body_data.torch()[self.cube._body_data_index, 2] += 0.1

    env = workbench.make(Lifts, 2, **CPU)
    env.reset(seed=0)
    with pytest.warns(RuleWarning, match="physics never sees it") as warned:
        for _ in range(3):
            env.step(env.action_space.sample())
    (warning,) = [warning for warning in warned if warning.category is RuleWarning]
    assert warning.filename == __file__ and "# the fault" in linecache.getline(__file__, warning.lineno)
    env.close()
    env = workbench.make(Writes, 2, **CPU)
    env.reset(seed=0)
    with pytest.raises(BrokenRule, match="--rules warn"):
        env.reset(options={"env_idx": torch.tensor([1])})
    env.close()
    for rules, caught in (("warn", 1), ("off", 0)):
        env = workbench.make(Writes, 2, rules=cast(Any, rules), **CPU)
        env.reset(seed=0)
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            env.reset(options={"env_idx": torch.tensor([1])})
        assert sum(warning.category is RuleWarning for warning in warned) == caught
        env.close()

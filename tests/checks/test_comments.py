"""Reports on silencing comments that have no effect."""

from __future__ import annotations

from workbench.checks.results import RuleResult, Silenced
from workbench.checks.silencing import comments_without_effect
from workbench.envs.gpu_rules import Finding

FILE = "/home/me/task.py"
TASKS = """
class Base(BaseEnv):
    def evaluate(self):  # workbench: off[success-at-reset] for all
        pass

class Mine(Base):
    def evaluate(self):
        x = 1  # workbench: off[reward-finite, success-at-reset] since then

class Other(Base):
    x = 2  # workbench: off[reward-finite] of the other

class Helper:
    y = 3  # workbench: off[reward-finite] of a helper
"""


def silenced(rule: str, line: int) -> RuleResult:
    finding = Finding(rule, "warn", "a message", FILE, 4, "pass", "evaluate", 1, 0)
    return RuleResult(rule, "silenced", silenced=(Silenced(finding, "for all", line),))


def ineffective(*results: RuleResult) -> list[tuple[int, str]]:
    found = comments_without_effect({FILE: TASKS}, results, "Mine", ["Other"])
    return [(one.line, one.message.split("]")[0]) for one in found]


def test_a_comment_without_a_reason_or_a_rule_is_reported() -> None:
    text = (
        "x = 1  # workbench: off[reward-rows]\n"
        "y = 2  # workbench: off[reward-row] one env only\n"
        "z = 3  # workbench: off[] because\n"
        "w = 4  # workbench: off[reward-rows, same-seed] one env only\n"
        "v = 5  # workbench: off[nothing_like_it] one env only\n"
    )
    found = comments_without_effect({"a.py": text})
    assert [(one.line, one.message) for one in found] == [
        (1, "off[reward-rows] silences nothing until a reason follows it"),
        (2, "no rule is called reward-row (did you mean reward-rows?)"),
        (3, "the comment names no rule: write an id in the brackets, such as off[reward-rows]"),
        (5, "no rule is called nothing_like_it"),
    ]


def test_a_comment_whose_rule_has_no_finding_there_is_reported() -> None:
    kept = RuleResult("reward-finite", "kept")
    assert ineffective(kept) == [(8, "off[reward-finite"), (14, "off[reward-finite")]
    assert ineffective(kept, silenced("success-at-reset", 3)) == [
        (8, "off[reward-finite, success-at-reset"),
        (14, "off[reward-finite"),
    ]


def test_an_undecided_rule_does_not_judge_a_comment() -> None:
    for state in ("failed", "not_known", "not_applicable"):
        assert ineffective(RuleResult("reward-finite", state)) == []
    assert ineffective() == []


def test_a_comment_in_a_base_class_of_another_file_is_judged_and_one_of_another_task_there_is_not() -> None:
    base = """
class Push(BaseEnv):
    x = 1  # workbench: off[reward-finite] of all

class Pull(Push):
    y = 2  # workbench: off[reward-finite] of the other
"""
    mine = "from base import Push\n\nclass Mine(base.Push):\n    z = 3  # workbench: off[reward-finite] of mine\n"
    sources = {"mine.py": mine, "base.py": base, "broken.py": "def (:  # workbench: off[reward-finite] so\n"}
    found = comments_without_effect(sources, [RuleResult("reward-finite", "kept")], "Mine")
    assert [(one.file, one.line) for one in found] == [("mine.py", 4), ("base.py", 3)]

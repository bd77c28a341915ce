"""Which silencing comments are told of, and which silence something."""

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


def told(*results: RuleResult) -> list[tuple[int, str]]:
    found = comments_without_effect({FILE: TASKS}, results, "Mine", ["Other"])
    return [(one.line, one.message.split("]")[0]) for one in found]


def test_a_comment_that_lacks_a_reason_or_names_no_rule_is_told() -> None:
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
        (3, "the comment names no rule, as in off[reward-rows]"),
        (5, "no rule is called nothing_like_it"),
    ]


def test_a_comment_whose_rule_found_nothing_there_is_told() -> None:
    kept = RuleResult("reward-finite", "kept")
    assert told(kept) == [(8, "off[reward-finite"), (14, "off[reward-finite")]
    assert told(kept, silenced("success-at-reset", 3)) == [
        (8, "off[reward-finite, success-at-reset"),
        (14, "off[reward-finite"),
    ]


def test_a_rule_that_was_not_decided_says_nothing_of_a_comment() -> None:
    for state in ("failed", "not_known", "not_applicable"):
        assert told(RuleResult("reward-finite", state)) == []
    assert told() == []

"""The findings that the Checks tab lists, and their order."""

from __future__ import annotations

from workbench.checks.finding_cards import cards, count, summary
from workbench.checks.results import RuleResult
from workbench.checks.state import ChecksView
from workbench.envs.gpu_rules import Degree, Finding


def finding(
    rule: str, degree: Degree = "warn", line: int = 24, count: int = 12, first_step: int = 3
) -> Finding:
    return Finding(
        rule, degree, "a message", "/home/me/task.py", line, f"code {line}", "lift", count, first_step
    )


STOPS, WARNS, PLAYED = finding("success-at-reset", "stop"), finding("reward-changes"), finding("not-applied")
DONE = ChecksView(
    "done",
    results=(
        RuleResult("reward-changes", "broken", (WARNS, finding("reward-changes", line=30))),
        RuleResult("success-at-reset", "broken", (STOPS,)),
        RuleResult("entry-name", "kept"),
        RuleResult("camera-sees", "not_applicable", why="it has no camera"),
    ),
)


def test_stopping_findings_come_first_and_findings_are_grouped_by_rule() -> None:
    shown = cards(DONE, [PLAYED])
    assert [card.rule.id for card in shown] == ["success-at-reset", "reward-changes", "not-applied"]
    assert [len(card.rows) for card in shown] == [1, 2, 1] and count(shown) == 4
    assert summary(DONE, shown) == "1 stop, 3 warn, 1 kept, 1 not applicable"


def test_a_breach_seen_while_playing_is_counted_in_one_row() -> None:
    (played,) = cards(ChecksView(), [PLAYED])
    assert played.rows[0].played == "while playing 10 times and more, first at step 3"
    of_check = ChecksView("done", results=(RuleResult("not-applied", "broken", (PLAYED,)),))
    (both,) = cards(of_check, [PLAYED])
    assert len(both.rows) == 1 and both.rows[0].played


def test_an_outlier_seen_by_check_and_play_is_one_finding() -> None:
    exact, at_hook = finding("entries-finite", line=30), finding("entries-finite", line=24)
    of_check = ChecksView("done", results=(RuleResult("entries-finite", "broken", (exact,)),))
    (card,) = cards(of_check, [at_hook])
    (row,) = card.rows
    assert row.finding == exact and row.played.endswith("first at step 3: a message")
    before = ChecksView("checking", before=(exact,))
    (card,) = cards(before, [at_hook])
    assert [row.finding for row in card.rows] == [at_hook] and not card.old


def test_a_rule_that_is_broken_while_playing_is_not_counted_as_kept() -> None:
    kept = ChecksView("done", results=(RuleResult("not-applied", "kept"), RuleResult("entry-name", "kept")))
    assert summary(kept, cards(kept, [PLAYED])) == "1 warn, 1 kept"


def test_findings_of_the_previous_version_come_last_and_are_counted() -> None:
    view = ChecksView(
        "checking", before=(STOPS,), results=(RuleResult("reward-changes", "broken", (WARNS,)),)
    )
    shown = cards(view)
    assert [(card.rule.id, card.old) for card in shown] == [
        ("reward-changes", False),
        ("success-at-reset", True),
    ]
    assert count(shown) == 2 and summary(view, shown) == "1 warn, 1 of the previous version"

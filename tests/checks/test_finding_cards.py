"""The findings that the Checks tab lists, and their order."""

from __future__ import annotations

from dataclasses import replace

import pytest

from workbench.checks.finding_cards import cards, count, summary, times, undecided, without_finding
from workbench.checks.results import RuleResult
from workbench.checks.rule_table import RULES
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


def test_a_card_is_old_only_if_all_its_findings_are() -> None:
    old = finding("reward-changes", "stop", line=30)
    view = ChecksView(
        "checking", before=(old, WARNS, STOPS), results=(RuleResult("reward-changes", "broken", (WARNS,)),)
    )
    mixed, stops = cards(view)
    assert (mixed.rule.id, mixed.degree, mixed.old, [row.old for row in mixed.rows]) == (
        "reward-changes",
        "stop",
        False,
        [False, True],
    )
    assert (stops.rule.id, stops.old) == ("success-at-reset", True)
    # Playing shows at once that the finding is still there.
    assert [card.old for card in cards(view, [STOPS])] == [False, False]
    kept = replace(
        view, results=(RuleResult("success-at-reset", "kept"), RuleResult("reward-changes", "kept"))
    )
    assert [result.rule for result in without_finding(kept, cards(kept))] == [
        "success-at-reset",
        "reward-changes",
    ]
    assert [result.rule for result in without_finding(kept, cards(kept, [STOPS]))] == ["reward-changes"]


def test_each_finding_while_playing_is_added_to_its_own_row() -> None:
    first, second = finding("not-applied", line=30, count=2), finding("not-applied", line=40, count=7)
    view = ChecksView("done", results=(RuleResult("not-applied", "broken", (first, second)),))
    (card,) = cards(view, [replace(second, count=3, first_step=0), finding("not-applied", line=50, count=1)])
    assert [row.finding.line for row in card.rows] == [30, 40, 50]
    assert [row.played.partition(",")[0] for row in card.rows] == [
        "",
        "while playing 3 times",
        "while playing once",
    ]
    assert card.rows[1].played.endswith("from the start") and card.rows[2].played.endswith(" step 3")
    # A finding of a rule that the table does not have, as of another version of the workbench, is left out.
    assert cards(ChecksView(), [finding("no-such-rule")]) == []


def test_the_summary_counts_each_rule_and_each_finding_once() -> None:
    states = ("kept", "silenced", "silenced", "not_known", "not_applicable", "failed")
    rest = [RuleResult(rule, state) for rule, state in zip(RULES, states, strict=False)]  # type: ignore[arg-type]
    view = replace(DONE, results=(*DONE.results, *rest), before=(finding("not-applied"),))
    assert summary(view, cards(view)) == (
        "1 stop, 2 warn, 2 kept, 2 silenced, 1 not known, 2 not applicable, 1 failed, 1 of the previous version"
    )
    assert summary(ChecksView(), []) == ""


def test_undecided_rules_are_grouped_by_state_and_reason() -> None:
    results = (
        RuleResult("camera-sees", "not_applicable", why="it has no camera"),
        RuleResult("reward-order", "not_known", why="no success"),
        RuleResult("camera-size", "not_applicable", why="it has no camera"),
        RuleResult("runs", "kept"),
        RuleResult("reward-flat", "not_known", why="one env"),
        RuleResult("success-flickers", "not_known", why="no success"),
    )
    assert [(each.state, each.why, each.rules) for each in undecided(results)] == [
        ("not known", "no success", ("reward-order", "success-flickers")),
        ("not known", "one env", ("reward-flat",)),
        ("not applicable", "it has no camera", ("camera-sees", "camera-size")),
    ]


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (1, "once"),
        (2, "2 times"),
        (9, "9 times"),
        (10, "10 times and more"),
        (99, "90 times and more"),
        (100, "100 times and more"),
        (12345, "10 000 times and more"),
    ],
)
def test_only_the_first_digit_of_a_large_count_is_shown(count: int, text: str) -> None:
    assert times(count) == text

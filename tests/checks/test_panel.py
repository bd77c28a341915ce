"""The Checks tab: its texts, its folding, and the commands that it sends to the session."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.drive.live import Live
from tests.drive.scenes import running
from workbench.checks.commands import (
    CheckAfterSave,
    CheckNow,
    ChooseSeeds,
    ShowSolved,
    SolveSeeds,
    StopChecks,
    StopProfile,
    StopSolving,
    TimeStep,
    ToggleRule,
    ToggleVerdict,
)
from workbench.checks.panel import AFTER_SAVE, CHECK_NOW, REST, STOP_CHECKS, findings_mark, status_html
from workbench.checks.profile import ProfileView
from workbench.checks.profile_panel import PROFILE, STOP_PROFILE, milliseconds, share_text
from workbench.checks.results import HookTime, LineTime, RuleResult, StepProfile, failed
from workbench.checks.state import ChecksView
from workbench.envs.gpu_rules import Finding
from workbench.live.messages import RulesBroken
from workbench.planning.seeds_report import SolvedSeed, SolveReport
from workbench.planning.verdicts import RewardVerdict
from workbench.solve.seeds import SeedsView
from workbench.solve.seeds_panel import SOLVE, STOP_SOLVING
from workbench.task.problem import Problem

FOUND = Finding(
    "success-at-reset", "stop", "success in <b> 8 of 8 seeds", "/home/me/push.py", 88, "x < <i>", "evaluate", 8, 0
)  # fmt: skip
RESULTS = (
    RuleResult("success-at-reset", "broken", (FOUND,)),
    RuleResult("reward-changes", "kept"),
    RuleResult("camera-sees", "not_applicable", why="it has no camera"),
)
DONE = ChecksView("done", 5, RESULTS, total=3, seconds=2.0)


class Checks:
    def __init__(self, live: Live) -> None:
        self.live = live
        self.serial = 100

    def draw(self, checks: ChecksView = DONE, **changes: Any) -> str:
        """Draw the checks; returns the list's HTML."""
        self.serial += 1
        self.view = running(4, checks=replace(checks, serial=self.serial), **changes)
        self.live.show(self.view)
        return self.live.html("wb-checks")

    def again(self) -> str:
        self.live.again()
        return self.live.html("wb-checks")

    @property
    def tab(self) -> str:
        return next(label for label in self.live.folders() if label.startswith("Checks"))

    @property
    def marked(self) -> int:
        mark = findings_mark(self.view)
        return 0 if mark is None else mark.count


@pytest.fixture
def checks(live_page: Live) -> Checks:
    return Checks(live_page)


def test_a_finding_has_rule_degree_line_code_and_message_as_text_and_the_tab_counts_it(
    checks: Checks,
) -> None:
    assert checks.draw(ChecksView()) == "" and checks.tab == "Checks" and checks.marked == 0
    text = checks.draw()
    for words in ("success-at-reset", ">stop<", "push.py:88", "in evaluate", "x &lt; &lt;i&gt;",
                  "in &lt;b&gt; 8 of 8 seeds", 'data-copy="# workbench: off[success-at-reset] "'):  # fmt: skip
        assert words in text
    assert "1 stop, 1 kept, 1 not applicable" in checks.live.html() and "2 rules without a finding" in text
    with_failed = (*RESULTS, RuleResult("entry-name", "failed", why="our own mistake"))
    assert "2 rules without a finding" in checks.draw(replace(DONE, results=with_failed))
    checks.draw()
    assert checks.tab == "Checks 1" and checks.marked == 1
    assert "push.py:88" in checks.live.html("wb-rules-mark")
    code = replace(FOUND, message="`evaluate` gives `a<b>`, and ` alone")
    text = checks.draw(replace(DONE, results=(RuleResult("success-at-reset", "broken", (code,)),)))
    assert "<code>evaluate</code> gives <code>a&lt;b&gt;</code>, and ` alone" in text
    checks.draw(replace(DONE, results=RESULTS[1:]))
    assert checks.tab == "Checks" and checks.marked == 0 and "wb-rules-mark" not in checks.live.html()


def test_a_comment_that_silences_nothing_is_listed_with_its_line(checks: Checks) -> None:
    text = (
        "x = 1  # workbench: off[reward-changes] <b>long</b> ago\ny = 2  # workbench: off[reward-change] so\n"
    )
    task = running(4).task
    assert task is not None
    task = replace(task, source={"/home/me/push.py": text})
    html = checks.draw(replace(DONE, state="checking"), task=task)
    assert "push.py:2" in html and "push.py:1" not in html, "the comment's rule may not be checked yet"
    assert "push.py:1" in checks.draw(DONE, task=task)


def test_the_reason_and_the_kept_rules_are_unfolded_and_folded_by_a_press(checks: Checks) -> None:
    why = "no tried episode succeeds"
    unknown = [RuleResult(rule, "not_known", why=why) for rule in ("reward-order", "success-flickers")]
    view = replace(DONE, results=(*RESULTS, *unknown))
    assert "<b>Why</b>" not in checks.draw(view)
    for key in ("success-at-reset", REST):
        checks.live.ask(ToggleRule(rule=key))
    text = checks.again()
    assert "<b>Why</b>" in text and "it has no camera" in text and text.count(why) == 1
    checks.live.ask(ToggleRule(rule=REST))
    assert "it has no camera" not in checks.again() and "<b>Why</b>" in checks.again()


def test_a_rule_whose_check_failed_is_shown_with_its_place_and_traceback(checks: Checks) -> None:
    problem = Problem("worker", "KeyError: <none>", "workbench/checks/x.py", 12, "x[y]", "Traceback <1>")
    text = checks.draw(replace(DONE, results=(*RESULTS, failed("reward-finite", problem))))
    assert (
        'data-rule="reward-finite"' in text and "KeyError: &lt;none&gt;, at workbench/checks/x.py:12" in text
    )
    assert 'data-copy="Traceback &lt;1&gt;"' in text


@pytest.mark.parametrize(
    ("checks", "says"),
    [
        (ChecksView("loading", waits=True), "waiting for other work"),
        (ChecksView("checking", results=RESULTS, total=58, looks_at="rewards"), "3 of 58 rules"),
        (
            ChecksView("stopped", results=RESULTS, total=58, why="stopped by the user"),
            "stopped by the user: 3 of 58 rules",
        ),
        (ChecksView("failed", why="the process died"), "the process died"),
    ],
)
def test_one_line_shows_the_progress(checks: ChecksView, says: str) -> None:
    assert says in status_html(checks, [])


@pytest.mark.parametrize("before", [(), (FOUND,)])
def test_a_version_that_is_not_checked_names_the_choice_that_turned_checks_off(
    before: tuple[Finding, ...],
) -> None:
    on, off = (status_html(ChecksView(before=before, after_each_save=each), []) for each in (True, False))
    assert AFTER_SAVE in off and AFTER_SAVE not in on


def test_only_a_running_check_can_be_stopped(checks: Checks) -> None:
    checks.draw(ChecksView("checking", total=58))
    assert not checks.live.shows(CHECK_NOW)
    checks.live.press(STOP_CHECKS)
    checks.draw()
    checks.live.press(CHECK_NOW)
    checks.live.set(AFTER_SAVE, False)
    assert checks.live.asked == [StopChecks(), CheckNow(), CheckAfterSave(on=False)]


def test_findings_while_playing_are_added_to_and_removed_from_the_same_list(checks: Checks) -> None:
    played = Finding("not-applied", "warn", "the pose was set", None, None, "", "", 1, 0)
    odd = Finding(
        "bodies-stay", "warn", "cube dropped 0.9 m", "/home/me/push.py", 70, "def it", "reset", 40, 2
    )
    text = checks.draw(DONE, rules=RulesBroken((played,), more=5), rules_serial=1, odd=(odd,))
    assert text.index("success-at-reset") < text.index("not-applied") and "None" not in text
    for words in (
        "5 times at further lines",
        "bodies-stay",
        "push.py:70",
        "40 times and more, first at step 2",
    ):
        assert words in text
    assert checks.marked == 3
    text = checks.draw()
    assert "bodies-stay" not in text and "not-applied" not in text


def test_only_the_first_findings_of_a_rule_are_listed_and_all_are_counted(checks: Checks) -> None:
    many = tuple(replace(FOUND, line=80 + k, code=f"x = {k}") for k in range(7))
    text = checks.draw(replace(DONE, results=(RuleResult("success-at-reset", "broken", many),)))
    assert "push.py:84" in text and "push.py:85" not in text and "and 2 more" in text
    assert checks.tab == "Checks 7" and checks.marked == 7
    text = checks.draw(replace(DONE, results=(RuleResult("success-at-reset", "broken", many[:5]),)))
    assert "push.py:84" in text and "more" not in text


def test_the_mark_names_the_worst_line_and_says_whether_a_run_stops(checks: Checks) -> None:
    nowhere = replace(FOUND, file=None, line=None)
    warned = replace(FOUND, rule="reward-changes", degree="warn", line=12, code="y")
    broken = RuleResult("reward-changes", "broken", (warned,))
    for view, expected in (
        (
            replace(DONE, results=(broken, RuleResult("success-at-reset", "broken", (nowhere,)))),
            (2, "push.py:12 and 1 more", True, False),
        ),
        (replace(DONE, results=(broken,)), (1, "push.py:12", False, False)),
        (ChecksView("checking", before=(warned, FOUND)), (2, "push.py:88 and 1 more", True, True)),
        (
            ChecksView("checking", before=(FOUND,), results=(broken,)),
            (2, "push.py:12 and 1 more", True, False),
        ),
        (
            replace(DONE, results=(RuleResult("success-at-reset", "broken", (nowhere,)),)),
            (1, "", True, False),
        ),
    ):
        mark = findings_mark(running(1, checks=view))
        assert mark is not None and (mark.count, mark.newest, mark.stops, mark.old) == expected


@pytest.mark.parametrize(
    ("share", "text"), [(0.5, "50 %"), (0.012, "1 %"), (0.01, "1 %"), (0.0094, "0.9 %"), (0.0, "0.0 %")]
)
def test_a_small_share_of_a_step_is_more_than_none(share: float, text: str) -> None:
    assert share_text(share) == text


@pytest.mark.parametrize(
    ("time", "text"),
    [(123.4, "123 ms"), (10.0, "10 ms"), (9.94, "9.9 ms"), (1.0, "1.0 ms"), (0.034, "0.034 ms")],
)
def test_times_of_a_step_have_two_digits(time: float, text: str) -> None:
    assert milliseconds(time) == text


PROFILED = StepProfile(
    64,
    200,
    21.0,
    (HookTime("evaluate", 10.5, 0.5), HookTime("physics", 5.2, 0.25)),
    (LineTime("evaluate", "/home/me/push.py", 88, "x < <i>", 7.35, 0.35),),
)


def test_a_step_profile_is_requested_and_shown_by_hook_and_line(checks: Checks) -> None:
    checks.draw()
    checks.live.press(PROFILE)
    checks.draw(profile=ProfileView("running", 1))
    assert not checks.live.shows(PROFILE)
    checks.live.press(STOP_PROFILE)
    assert checks.live.asked == [TimeStep(), StopProfile()]
    few = tuple(LineTime("evaluate", "/home/me/push.py", 90 + k, "x", 0.05, 0.004) for k in range(9))
    checks.draw(profile=ProfileView("done", 2, replace(PROFILED, lines=(*PROFILED.lines, *few))))
    text = checks.live.html("wb-profile")
    for words in (
        "21 ms",
        "64 envs",
        "200 steps",
        "50 %",
        "push.py:88",
        "x &lt; &lt;i&gt;",
        "35 %",
        "push.py:93",
    ):
        assert words in text
    assert "push.py:94" not in text, "lines that take almost no time are left out"
    assert [int(width) for width in re.findall(r"width: (\d+)", text)] == [50, 25, 35, 0, 0, 0, 0]
    assert "previous" not in text
    checks.draw(profile=ProfileView("stopped", 3, PROFILED, stale=True))
    assert "previous" in checks.live.html()
    checks.draw(profile=ProfileView("failed", 4, why="no agent"))
    assert "no agent" in checks.live.html() and not checks.live.html("wb-profile")


# --- Solve many seeds ------------------------------------------------------------------------------

REPORT = SolveReport(
    (
        SolvedSeed(0, 8, 13, 9.25, 3.2, "", Path("/r/seed0.rrd")),
        SolvedSeed(1, 0, 50, 21.5, 12.5, "earned <0.9> a step without success", Path("/r/seed1.rrd")),
    ),
    (RewardVerdict("reward-exploited", "1 of 2 episodes earned more", (1,)),),
    20.0,
    False,
    2,
)
SEEDS = SeedsView("done", 4, REPORT, total=2)


def test_seeds_are_solved_as_typed_and_stopped(checks: Checks) -> None:
    checks.draw(seeds=SeedsView())
    assert not checks.live.shows(STOP_SOLVING)
    checks.live.set("Seeds", 12)
    checks.live.press(SOLVE)
    checks.draw(seeds=SeedsView("solving", 2, total=12, done=0.6, activity="seed 0 at step 30 of 50"))
    html = checks.live.html()
    assert "0 of 12 seeds" in html and "seed 0 at step 30 of 50" in html and "width: 5%" in html
    assert not checks.live.shows(SOLVE, "button") and checks.live.field("Seeds").off
    checks.live.press(STOP_SOLVING)
    assert checks.live.asked == [ChooseSeeds(seeds=12), SolveSeeds(), StopSolving()]
    checks.draw(seeds=SeedsView("failed", 3, why="the task failed", total=12))
    assert "the task failed" in checks.live.html() and checks.live.shows(SOLVE, "button")


def test_each_seed_has_a_row_that_opens_its_recording_and_verdicts_are_cards(server: Any) -> None:
    looked_at: list[Path] = []
    live = Live(server, on_look=looked_at.append)
    live.show(running(1, seeds=SEEDS))
    html = live.html()
    assert "1 of 2 seeds" in html and "earned &lt;0.9&gt; a step without success" in html and "21.5" in html
    live.ask(ShowSolved(seed=1))
    assert looked_at == [Path("/r/seed1.rrd")]
    assert 'data-rule="reward-exploited"' in html and "(seeds 1)" in html and "<b>Fix</b>" not in html
    live.ask(ToggleVerdict(rule="reward-exploited"))
    live.again()
    assert "<b>Fix</b>" in live.html()
    third = replace(REPORT.seeds[0], seed=2)
    report = replace(REPORT, wanted=9, seeds=(*REPORT.seeds, third))
    live.show(running(1, seeds=SeedsView("stopped", 5, report, total=9, stale=True)))
    assert "3 of 9 seeds" in live.html() and "of the previous version" in live.html()

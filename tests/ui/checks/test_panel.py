"""The Checks tab: what it says, folds, and asks the session for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import pytest

from tests.drive.panels import Clock, Panels
from tests.ui.scenes import running
from workbench.authoring.problem import Problem
from workbench.checks.results import HookTime, LineTime, RuleResult, StepProfile, failed
from workbench.core.rules import Finding
from workbench.machine.kept_choices import kept_choices
from workbench.session.checks.checks import ChecksView
from workbench.session.checks.profile import ProfileView
from workbench.session.protocol.messages import RulesBroken
from workbench.ui.checks.panel import (
    AFTER_SAVE,
    CHECK_NOW,
    REST,
    STOP_CHECKS,
    ChecksPanel,
    FindingsMark,
    findings_mark,
    status_html,
)
from workbench.ui.checks.step_profile import PROFILE, STOP_PROFILE, StepProfilePanel, profile_html

FOUND = Finding(
    "success-at-reset",
    "stop",
    "success in <b> 8 of 8 seeds",
    "/home/me/push.py",
    88,
    "x < <i>",
    "evaluate",
    8,
    0,
)
RESULTS = (
    RuleResult("success-at-reset", "broken", (FOUND,)),
    RuleResult("reward-changes", "kept"),
    RuleResult("camera-sees", "not_applicable", why="it has no camera"),
)
DONE = ChecksView("done", 5, RESULTS, total=3, seconds=2.0)


class RecordedSession:
    """Stands where the session stands for a panel, and notes what it was asked."""

    def __init__(self) -> None:
        self.asked: list[object] = []
        self.checks = self.profiler = self
        self.view = DONE

    def check_now(self) -> None:
        self.asked.append("check")

    def profile_step(self) -> None:
        self.asked.append("profile")

    def stop(self) -> None:
        self.asked.append("stop")

    def check_after_each_save(self, wanted: bool) -> None:
        self.asked.append(wanted)


@dataclass
class Shown:
    panel: ChecksPanel
    profile: StepProfilePanel
    session: RecordedSession
    panels: Panels
    clock: Clock
    mark: FindingsMark | None = None

    def draw(self, checks: ChecksView, **changes: Any) -> None:
        self.clock.passes()
        view = running(4, checks=checks, **changes)
        for part in (self.panel, self.profile):
            part.draw(view)
        self.mark = findings_mark(view)


@pytest.fixture
def shown(panels: Panels, clock: Clock) -> Shown:
    session = cast(Any, RecordedSession())
    with (tab := panels.server.gui.add_tab_group().add_tab("Checks")):
        panel = ChecksPanel(panels.server, session, tab)
        profile = StepProfilePanel(panels.server, session)
    return Shown(panel, profile, session, panels, clock)


def test_it_says_what_a_check_is_before_the_first(shown: Shown) -> None:
    shown.draw(ChecksView())
    assert "Not checked so far" in shown.panels.html() and shown.panels.shows(CHECK_NOW)
    assert not shown.panels.shows(STOP_CHECKS) and shown.mark is None
    assert "Checks" in shown.panels.folders()


def test_a_comment_that_silences_nothing_is_listed_with_its_line(shown: Shown) -> None:
    text = (
        "x = 1  # workbench: off[reward-changes] <b>long</b> ago\ny = 2  # workbench: off[reward-change] so\n"
    )
    task = running(4).task
    assert task is not None
    task = replace(task, source={"/home/me/push.py": text})
    shown.draw(replace(DONE, state="checking"), task=task)
    html = shown.panels.html("wb-check-comment")
    assert "no rule is called reward-change (did you mean reward-changes?)" in html and "push.py:2" in html
    assert "silenced nothing" not in html, "its rule may not be checked yet"
    shown.draw(DONE, task=task)
    html = shown.panels.html("wb-check-comment")
    assert "off[reward-changes] silenced nothing in this check" in html and "push.py:1" in html


def test_a_finding_has_rule_degree_line_code_and_message_escaped_and_the_tab_counts_it(shown: Shown) -> None:
    shown.draw(DONE)
    text = shown.panels.html("wb-checks")
    for words in (
        "success-at-reset",
        ">stop<",
        "push.py:88",
        "in evaluate",
        "x &lt; &lt;i&gt;",
        "in &lt;b&gt; 8 of 8 seeds",
        'data-copy="# workbench: off[success-at-reset] "',
    ):
        assert words in text
    assert "3 rules checked in 2.0 s" in shown.panels.html()
    assert "1 stop, 1 kept, 1 not applicable" in shown.panels.html()
    assert "Checks 1" in shown.panels.folders()
    assert shown.mark is not None and shown.mark.count == 1
    shown.draw(replace(DONE, serial=6, results=RESULTS[1:]))
    assert "Checks" in shown.panels.folders() and shown.mark is None


def test_what_a_message_has_between_backticks_is_code_and_the_rest_is_as_it_is(shown: Shown) -> None:
    finding = replace(FOUND, message="`evaluate` gives `a<b>`, and ` alone")
    shown.draw(replace(DONE, results=(RuleResult("success-at-reset", "broken", (finding,)),)))
    assert "<code>evaluate</code> gives <code>a&lt;b&gt;</code>, and ` alone" in shown.panels.html()


def test_why_and_the_rules_without_a_finding_are_folded_out_by_a_press(shown: Shown) -> None:
    shown.draw(DONE)
    assert "Episodes end before the policy acts" not in shown.panels.html("wb-checks")
    shown.panels.press("fold success-at-reset")
    shown.panels.press(f"fold {REST}")
    shown.draw(DONE)
    text = shown.panels.html("wb-checks")
    assert "<b>Why</b>" in text and "reward-changes" in text
    assert "<td>not applicable</td><td>it has no camera" in text
    shown.panels.press(f"fold {REST}")
    shown.draw(DONE)
    assert "it has no camera" not in shown.panels.html("wb-checks")


def test_a_rule_whose_check_failed_is_shown_with_its_place_and_traceback(shown: Shown) -> None:
    problem = Problem("worker", "KeyError: <none>", "workbench/checks/x.py", 12, "x[y]", "Traceback <1>")
    shown.draw(replace(DONE, results=(*RESULTS, failed("reward-finite", problem))))
    text = shown.panels.html("wb-checks")
    assert (
        'data-rule="reward-finite"' in text and "KeyError: &lt;none&gt;, at workbench/checks/x.py:12" in text
    )
    assert 'data-copy="Traceback &lt;1&gt;"' in text and "1 failed" in shown.panels.html()


def test_rules_that_are_not_known_are_listed_by_their_reason(shown: Shown) -> None:
    why = "no tried episode succeeds"
    unknown = [RuleResult(rule, "not_known", why=why) for rule in ("reward-order", "success-flickers")]
    view = replace(DONE, results=(*RESULTS, *unknown))
    shown.draw(view)
    shown.panels.press(f"fold {REST}")
    shown.draw(view)
    text = shown.panels.html("wb-checks")
    assert text.count(why) == 1 and "reward-order" in text and "success-flickers" in text
    assert "2 not known" in shown.panels.html()


@pytest.mark.parametrize(
    ("checks", "says"),
    [
        (ChecksView("off"), "--rules off"),
        (ChecksView("loading"), "loading this version in the background"),
        (ChecksView("loading", waits=True), "waiting for other work"),
        (ChecksView("checking", results=RESULTS, total=58, looks_at="rewards"), "3 of 58 rules checked"),
        (
            ChecksView("stopped", results=RESULTS, total=58, why="stopped by hand"),
            "stopped by hand: 3 of 58 rules",
        ),
        (ChecksView("failed", why="the process died"), "the process died"),
        (ChecksView("none", before=(FOUND,)), "of an earlier one"),
    ],
)
def test_one_line_says_how_far_it_is(checks: ChecksView, says: str) -> None:
    assert says in status_html(checks, [])


def test_only_what_runs_can_be_stopped_and_the_choice_is_kept(shown: Shown) -> None:
    shown.draw(ChecksView("checking", total=58))
    assert not shown.panels.shows(CHECK_NOW)
    shown.panels.press(STOP_CHECKS)
    shown.draw(DONE)
    shown.panels.press(CHECK_NOW)
    shown.panels.set(AFTER_SAVE, False)
    assert shown.session.asked == ["stop", "check", False]
    assert not kept_choices().check_after_save
    shown.panels.set(AFTER_SAVE, True)
    assert kept_choices().check_after_save and shown.session.asked[3:] == [True]


def test_rules_seen_while_playing_are_rows_of_the_same_list(shown: Shown) -> None:
    played = Finding("not-applied", "warn", "the pose was set", None, None, "", "", 1, 0)
    shown.draw(DONE, rules=RulesBroken((played,), more=5), rules_serial=1)
    text = shown.panels.html("wb-checks")
    assert text.index("success-at-reset") < text.index("not-applied")
    assert "while playing once, from the start" in text and "5 times at further lines" in text
    assert "None" not in text and shown.mark is not None and shown.mark.count == 2


def test_outliers_are_rows_of_the_same_list(shown: Shown) -> None:
    file, message = "/home/me/push.py", "cube dropped 0.9 m, in env 3"
    odd = Finding("bodies-stay", "warn", message, file, 70, "def it", "_initialize_episode", 40, 2)
    shown.draw(DONE, odd=(odd,))
    text = shown.panels.html("wb-checks")
    for words in ("bodies-stay", "push.py:70", "cube dropped 0.9 m", "40 times and more, first at step 2"):
        assert words in text
    assert shown.mark is not None and shown.mark.count == 2
    shown.draw(DONE)
    assert "bodies-stay" not in shown.panels.html("wb-checks")


PROFILED = StepProfile(
    64,
    200,
    21.0,
    (HookTime("evaluate", 10.5, 0.5), HookTime("physics", 5.2, 0.25)),
    (LineTime("evaluate", "/home/me/push.py", 88, "x < <i>", 7.35, 0.35),),
)


def test_where_a_step_goes_is_asked_for_and_shown_by_hook_and_line(shown: Shown) -> None:
    shown.draw(DONE)
    shown.panels.press(PROFILE)
    shown.draw(DONE, profile=ProfileView("running", 1))
    assert not shown.panels.shows(PROFILE)
    shown.panels.press(STOP_PROFILE)
    assert shown.session.asked == ["profile", "stop"]
    shown.draw(DONE, profile=ProfileView("done", 2, PROFILED))
    text = shown.panels.html("wb-profile")
    for words in (
        "21 ms",
        "64 envs",
        "200 steps",
        "evaluate",
        "50 %",
        "push.py:88",
        "x &lt; &lt;i&gt;",
        "35 %",
    ):
        assert words in text
    assert "of the version before" not in text
    assert "of the version before" in profile_html(ProfileView("done", 3, PROFILED, stale=True))


def test_lines_that_take_next_to_nothing_are_left_out_but_for_the_first() -> None:
    lines = tuple(LineTime("evaluate", "/home/me/push.py", 90 + k, "x", 0.05, 0.004) for k in range(9))
    text = profile_html(ProfileView("done", 1, replace(PROFILED, lines=(*PROFILED.lines, *lines))))
    assert "0.4 %" in text and "push.py:93" in text and "push.py:94" not in text


def test_a_profile_that_failed_says_why() -> None:
    assert "no agent" in profile_html(ProfileView("failed", why="no agent"))

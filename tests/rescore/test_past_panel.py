"""Rescoring of the past with the new code, on the Reward tab."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.drive.live import Live
from tests.drive.panels import Panels
from tests.drive.scenes import running
from workbench.live.events import MomentShown
from workbench.live.past import TimelineView
from workbench.live.timeline_commands import (
    ChooseRescoredCurve,
    NextDifference,
    PreviousDifference,
    ShowRescored,
    StopRescoring,
    TurnRescored,
)
from workbench.page.widgets.line_chart import MAX_POINTS, SELECTED_COLOUR
from workbench.rescore.past_panel import chart_data
from workbench.rescore.past_scores import PastRun, RescoredCurve
from workbench.rescore.result_parts import MAX_ROWS, RECORD_COLOUR
from workbench.rescore.state import RescoreView
from workbench.rescore.verdict import Verdict
from workbench.task.problem import Problem

STOP = "Stop rescoring"


def episode(env: int = 0, **changes: Any) -> Verdict[PastRun]:
    """The verdict on an episode of fifty moments that differs at its fifth step."""
    run = PastRun(env, 0, 10 * env + np.arange(50))
    reward = {"first_difference": 5, "look_at": 5, "differing": ("reward",), "largest": 0.25}
    return replace(
        Verdict(run, length=49, returns=(1.0, 2.0), metres=0.0, has=("reward", "fail")),
        **{**reward, **changes},
    )


def same(env: int = 0, **changes: Any) -> Verdict[PastRun]:
    nothing = {"first_difference": None, "look_at": None, "differing": (), "largest": 0.0}
    return episode(env, **{**nothing, "returns": (1.0, 1.0), **changes})


def done(*verdicts: Verdict[PastRun], **changes: Any) -> RescoreView:
    differing = frozenset(name for verdict in verdicts for name in verdict.differing)
    fields = {"names": ("reward", "success"), "differing_names": differing, "task": "the new code", **changes}
    return replace(RescoreView("done", 1, verdicts, 50, 50), **fields)


class Rescored:
    def __init__(self, live: Live) -> None:
        self.live, self.panels = live, live.part("Reward")
        live.session.answers["rescored_curve"] = self.curve

    def curve(self, name: str, env: int) -> RescoredCurve | None:
        tick, old = np.arange(20), np.full(20, env, np.float32)
        return RescoredCurve(tick, tick, old, 2 * old) if name in ("reward", "success") else None

    def draw(self, rescored: RescoreView, shown: int | None = None, first: int = 0, env: int = 0) -> Panels:
        past = TimelineView(first=first, last=1000, shown=shown)
        self.live.show(running(40, rescored=rescored, timeline=past, selected_env=env))
        return self.panels


@pytest.fixture
def rescored(live_page: Live) -> Rescored:
    return Rescored(live_page)


def test_the_state_is_shown_above_and_below_and_only_a_running_job_can_be_stopped(rescored: Rescored) -> None:
    assert not rescored.draw(RescoreView()).shows(STOP) and "wb-again" not in rescored.panels.html()
    for state, says in (
        ("loading", "loading the new code"),
        ("rescoring", "26 of 50"),
        ("done", "1 of 2 episodes differs."),
    ):
        shown = rescored.draw(done(episode(), same(1), state=state, serial=hash(state), done=26))
        assert shown.shows(STOP) is (state != "done") and says in shown.html()
        if state == "rescoring":
            shown.press(STOP)
            assert rescored.live.asked == [StopRescoring()]
    rescored.draw(RescoreView("stopped", 9, why="the file was saved again"))
    assert "the file was saved again" in rescored.panels.html()


def test_a_problem_is_shown_as_text_with_file_and_line(rescored: Rescored) -> None:
    problem = Problem("reward", "KeyError: '<b>'", "/home/me/push.py", 88, "raise <b>", "")
    html = rescored.draw(done(state="failed", why="the new code raised", problem=problem, done=20)).html(
        "wb-again"
    )
    assert "push.py:88" in html and "20 of 50" in html and "KeyError: &#39;&lt;b&gt;" in html


def test_the_new_curve_is_drawn_over_the_recorded_one(rescored: Rescored) -> None:
    (chart,) = rescored.draw(done(episode(3)), env=3).charts()
    assert chart.of(RECORD_COLOUR)[:, 1] == pytest.approx(3, abs=0.01)
    assert chart.of(SELECTED_COLOUR)[:, 1] == pytest.approx(6, abs=0.01)
    rescored.panels.set("Curve", "success")
    assert [one.title[:7] for one in rescored.draw(done(episode(3)), env=2).charts()] == ["success"]
    rescored.panels.do(ChooseRescoredCurve(curve="../../etc"))
    assert rescored.panels.client.notices and rescored.panels.field("Curve").value == "success"
    rescored.draw(done(episode(3), names=("reward",)))
    assert rescored.panels.field("Curve").value == "reward", "the chosen curve no longer exists"
    rescored.draw(done(same(3), serial=2), env=3)
    assert rescored.panels.charts() == [] and not rescored.panels.shows("Curve")


def test_rows_open_their_moment_and_forgotten_moments_only_their_env(rescored: Rescored) -> None:
    many = done(same(30), *(episode(env) for env in range(MAX_ROWS + 3)))
    assert f"1 to {MAX_ROWS} of {MAX_ROWS + 3}" in rescored.draw(many).html()
    rescored.panels.ask(ShowRescored(run="2 25"))
    rescored.panels.ask(TurnRescored(by=1))
    assert f"{MAX_ROWS + 1} to {MAX_ROWS + 3} of" in rescored.draw(many).html(), "the next page is shown"
    last = MAX_ROWS + 2
    rescored.panels.ask(ShowRescored(run=f"{last} {10 * last + 5}"))
    rescored.panels.do(ShowRescored(run="99 1"))  # no run has this id
    asked = rescored.live.asked
    assert asked == [MomentShown(25, 2), MomentShown(10 * last + 5, last)]
    rescored.panels.ask(TurnRescored(by=-1))
    rescored.draw(many)
    rescored.draw(many, first=500)
    rescored.panels.ask(ShowRescored(run="0 5"))
    assert asked[-1] == ("change", {"selected_env": 0})
    rescored.panels.ask(TurnRescored(by=1))
    rescored.draw(RescoreView())
    assert f"1 to {MAX_ROWS} of" in rescored.draw(replace(many, serial=5)).html(), (
        "a new result begins at its first page"
    )


def test_the_key_cycles_through_the_differences(rescored: Rescored) -> None:
    rescored.live.do(NextDifference())
    assert rescored.live.asked == []
    rescored.draw(done(episode(0), episode(1)))
    for env, moment in ((0, 5), (1, 15), (0, 5)):
        rescored.live.do(NextDifference())
        assert rescored.live.asked[-1] == MomentShown(moment, env)
        rescored.draw(done(episode(0), episode(1)), shown=moment, env=env)
    rescored.live.do(PreviousDifference())
    assert rescored.live.asked[-1] == MomentShown(15, 1)


def test_only_the_part_of_a_long_record_around_the_shown_moment_is_drawn() -> None:
    count = 3 * MAX_POINTS
    tick = np.arange(count)
    curve = RescoredCurve(tick, tick + 7, np.zeros(count, np.float32), np.ones(count, np.float32))
    assert chart_data(curve, None)[0][-1] == count - 1
    x, _, _, cursor = chart_data(curve, 7 + MAX_POINTS)
    assert len(x) == MAX_POINTS and cursor == MAX_POINTS
    assert chart_data(curve, 10**6)[-1] is None

"""What the page says of a judgement, and what it draws."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pytest

from tests.drive.panels import Clock, Panels
from tests.ui.scenes import running
from workbench.authoring.problem import Problem
from workbench.jobs.rescore.verdict import Verdict
from workbench.session.live.timeline import TimelineView
from workbench.session.rescore import verdict_text
from workbench.session.rescore.background import RescoreView
from workbench.session.rescore.past import PastRun, RescoredCurve
from workbench.ui.live.rescored import PastRescorePanel, chart_data, in_a_line
from workbench.ui.widgets.line_chart import LONGEST
from workbench.ui.widgets.rescored import MOST_ROWS, status_html


def episode(env: int = 0, **changes: Any) -> Verdict[PastRun]:
    """An episode of fifty moments that differs at its fifth step."""
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
    told = {"names": ("reward", "success"), "differing_names": differing, "task": "the new code", **changes}
    return replace(RescoreView("done", 1, verdicts, 50, 50), **told)


class RecordedSession:
    """Stands where the session stands for a panel: what it has of curves, and what it was requested."""

    def __init__(self) -> None:
        self.asked: list[tuple[object, ...]] = []
        self.shown = running(40, timeline=TimelineView(first=0, last=1000))
        self.rescorer = self

    def curve(self, name: str, env: int) -> RescoredCurve | None:
        tick = np.arange(20)
        old = np.full(20, env, np.float32)
        return RescoredCurve(tick, tick, old, 2 * old) if name in ("reward", "success") else None

    def view(self) -> object:
        return self.shown

    def show(self, env: int, serial: int) -> None:
        self.asked.append(("show", env, serial))

    def change(self, *, selected_env: int) -> None:
        self.asked.append(("select", selected_env))

    def stop(self) -> None:
        self.asked.append(("stop",))


@dataclass
class Rescoring:
    """The panel on a page, and the session that it asks."""

    panel: PastRescorePanel
    session: RecordedSession
    panels: Panels
    clock: Clock

    def draw(self, rescored: RescoreView, **changes: Any) -> None:
        self.clock.passes()
        timeline = TimelineView(first=0, last=1000)
        self.panel.draw(running(40, rescored=rescored, **{"timeline": timeline, **changes}))


@pytest.fixture
def rescoring(panels: Panels, clock: Clock) -> Rescoring:
    session = RecordedSession()
    return Rescoring(PastRescorePanel(panels.server, cast(Any, session)), session, panels, clock)


@pytest.mark.parametrize(
    ("rescored", "says"),
    [
        (RescoreView("none"), ""),
        (RescoreView("loading"), "loading the new code"),
        (RescoreView("rescoring", done=26, total=50), "50 %"),
        (done(episode(), same(1)), "1 of 2 episodes differs."),
        (done(same(1), differing_names={"new"}), "are unchanged. Other entries differ: new."),
        (RescoreView("stopped", why="the file was saved again"), "the file was saved again"),
    ],
)
def test_one_line_says_how_far_it_is_and_what_came_of_it(rescored: RescoreView, says: str) -> None:
    assert in_a_line(rescored).endswith(says) and bool(in_a_line(rescored)) == bool(says)


def test_outcomes_are_said_before_rewards() -> None:
    moved = episode(success=(None, 41), fail=(7, None))
    assert (
        verdict_text.change_text(moved) == "success now at step 41, was never, fail never now, was at step 7"
    )
    assert verdict_text.change_text(episode()) == "reward by up to 0.25, from step 5"


def test_a_task_without_a_reward_has_no_return_to_tell() -> None:
    none, flags = same(0, has=()), same(0, has=("success", "fail"))
    assert "reward" not in verdict_text.headline([flags]) and "success and fail" in verdict_text.headline(
        [flags]
    )
    assert "there is no reward" in verdict_text.headline([none])
    assert verdict_text.totals([none]) == [] and "return" not in "".join(verdict_text.totals([flags]))
    assert verdict_text.returns_text(none) == ""


def test_nothing_that_differs_is_one_sentence() -> None:
    both = same(0), same(1)
    says = "Nothing differs in 2 episodes: reward and fail are unchanged."
    assert verdict_text.headline(both) == says and verdict_text.totals(both) == ["mean return: 1"]
    assert verdict_text.headline([same(0), same(1, differing=("height",))]).endswith(
        "Other entries differ: height."
    )
    assert "2 episodes so far:" in verdict_text.headline(both, so_far=True)
    assert verdict_text.headline([episode(0), episode(1)], so_far=True) == "2 of 2 episodes differ so far."


@pytest.mark.parametrize(
    ("metres", "radians", "says", "far"),
    [
        (0.0, 0.0, "to the last bit", False),
        (4e-4, 1e-4, "at most 0.4 mm", False),
        (0.032, 0.0, "up to 3.2 cm", True),
        (0.0, 0.2, "11°", True),
        (float("inf"), 0.0, "infinite", True),
    ],
)
def test_drift_is_told_and_doubted_where_it_is_large(
    metres: float, radians: float, says: str, far: bool
) -> None:
    found = [same(1), same(7, metres=metres, radians=radians)]
    assert says in verdict_text.drift_summary(found)
    assert verdict_text.count_drifted(found) == far
    assert ("In 1 episode" in verdict_text.drift_summary(found)) == far
    assert metres == 0 or ("env 7" in verdict_text.drift_summary(found)) == far


def test_a_problem_is_told_with_file_and_line_and_escaped() -> None:
    problem = Problem("reward", "KeyError: '<b>'", "/home/me/push.py", 88, "raise <b>", "")
    html = status_html(done(state="failed", why="the new code raised", problem=problem, done=20))
    assert "push.py:88" in html and "20 of 50" in html
    assert "<b>" not in html and "&lt;b&gt;" in html


def test_nothing_is_shown_before_the_first_judgement(rescoring: Rescoring) -> None:
    rescoring.draw(RescoreView())
    assert not any(rescoring.panels.shows(name) for name in ("Stop rescoring", "Curve"))
    assert rescoring.panels.html("wb-again") == "" and rescoring.panels.charts() == []


def test_only_what_runs_can_be_stopped(rescoring: Rescoring) -> None:
    for state, stoppable in (("loading", True), ("rescoring", True), ("done", False), ("failed", False)):
        rescoring.draw(done(state=state, serial=hash(state)))
        assert rescoring.panels.shows("Stop rescoring") == stoppable and rescoring.panels.html("wb-again")


def test_the_new_line_lies_over_the_recorded_one(rescoring: Rescoring) -> None:
    rescoring.draw(done(episode(3)), selected_env=3)
    (chart,) = rescoring.panels.charts()
    _, old, new = chart.data
    assert (old == 3).all() and (new == 6).all()
    assert [series.get("label") for series in chart.series] == [
        "step",
        "as recorded",
        "rescored",
    ]
    recorded, rescored = ((series.get("width"), series.get("stroke")) for series in chart.series[1:])
    assert recorded[0] is not None and rescored[0] is not None and recorded[0] < rescored[0]
    assert recorded[1] != rescored[1], "the record stands back"
    rescoring.draw(done(same(3), serial=2), selected_env=3)
    assert rescoring.panels.charts() == [] and not rescoring.panels.shows("Curve")


def test_a_choice_that_is_none_draws_the_reward(rescoring: Rescoring) -> None:
    rescoring.draw(done(episode(1)))
    rescoring.panels.claim("Curve", "../../etc")
    rescoring.draw(done(episode(1), serial=2))
    assert [str(chart.title)[:13] for chart in rescoring.panels.charts()] == ["reward of env"]


def test_rows_go_to_their_moment_and_forgotten_moments_only_to_their_env(rescoring: Rescoring) -> None:
    session = rescoring.session
    rescoring.draw(done(same(30), *(episode(env) for env in range(MOST_ROWS + 3))))
    assert f"1 to {MOST_ROWS} of {MOST_ROWS + 3}" in rescoring.panels.html()
    rescoring.panels.press("row 2")
    rescoring.panels.press("on")
    rescoring.panels.press("row 2")
    rescoring.panels.claim("row 3", True, "button")  # there is no such row on the last part
    assert session.asked == [("show", 2, 25), ("show", MOST_ROWS + 2, 10 * (MOST_ROWS + 2) + 5)]
    session.shown = running(40, timeline=TimelineView(first=500, last=1000))
    rescoring.panels.press("back")
    rescoring.panels.press("row 0")
    assert session.asked[-1] == ("select", 0)


def test_the_key_goes_round(rescoring: Rescoring) -> None:
    session = rescoring.session
    rescoring.panel.go_to_difference(1)
    assert session.asked == []
    rescoring.draw(done(episode(0), episode(1)))
    for wanted in (("show", 0, 5), ("show", 1, 15), ("show", 0, 5)):
        rescoring.panel.go_to_difference(1)
        assert session.asked[-1] == wanted
        session.shown = running(
            40, selected_env=wanted[1], timeline=TimelineView(first=0, last=1000, shown=wanted[2])
        )


def test_of_a_long_record_the_part_round_the_shown_moment_is_drawn() -> None:
    count = 3 * LONGEST
    tick = np.arange(count)
    curve = RescoredCurve(tick, tick + 7, np.zeros(count, np.float32), np.ones(count, np.float32))
    assert chart_data(curve, None)[0][-1] == count - 1
    x, _, _, cursor = chart_data(curve, 7 + LONGEST)
    assert len(x) == LONGEST
    assert x[np.flatnonzero(np.isfinite(cursor))].tolist() == [LONGEST]
    assert len(chart_data(curve, 10**6)) == 3


def test_a_reward_that_turned_nan_is_said_so_and_counted_in_the_mean() -> None:
    lost, nan = float("inf"), float("nan")
    for returns, says in (
        ((1.0, nan), "NaN now"),
        ((nan, 1.0), "no longer NaN"),
        ((nan, nan), "NaN at other steps"),
    ):
        assert (
            verdict_text.change_text(episode(largest=lost, returns=returns)) == f"reward {says}, from step 5"
        )
    told = [episode(returns=(1.0, 2.0)), episode(1, returns=(1.0, nan))]
    assert verdict_text.totals(told) == ["mean return: 1 → 2, NaN in 1 of 2"]
    assert verdict_text.totals(told[1:]) == ["mean return: 1 → NaN in 1 of 1"]

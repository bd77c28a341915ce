"""The folder *Solve*: what it says of a plan, and what it asks the session for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import viser

from tests.drive.panels import Panels
from tests.ui.env_rows import rows_of
from tests.ui.scenes import PLAN, problem, running
from workbench.core.env.keywords import HowMade, Keyword
from workbench.planning.options import PlanOptions
from workbench.session.history.env_table import EnvRows
from workbench.session.live.solver import SolveView
from workbench.session.live.view import SessionView
from workbench.session.process.job_lane import JobProgress
from workbench.session.protocol.messages import Settings
from workbench.session.record.live import RecordingStatus
from workbench.session.record.save_past import SaveStatus
from workbench.ui.live.solve_panel import (
    ALL_ENVS,
    SAVE_SOLVED,
    USE_MODE,
    SolvePanel,
    horizon_seconds,
    in_words,
    offers_better_mode,
    solve_html,
)

SOLVED = SolveView(
    "planning",
    3,
    plan=PLAN,
    plan_step=2,
    predicted=np.array([0.5, 0.6, 0.9], np.float32),
    achieved=np.array([0.4, 0.6, 0.8], np.float32),
    solved_at=3,
    solved=((0, 3),),
    steps_per_second=5125.0,
)


class RecordedSession:
    """Stands where the session stands for the panel, and notes what it was asked."""

    def __init__(self) -> None:
        self.asked: list[object] = []
        self.shown = running(2)
        self.versions = self

    def view(self) -> SessionView:
        return self.shown

    def env_rows(self) -> EnvRows:
        return rows_of()

    def change(self, **settings: Any) -> None:
        self.asked.append(settings)

    def save_past(self, envs: tuple[int, ...]) -> None:
        self.asked.append(("save", envs))

    def use_control_mode(self, mode: str) -> None:
        self.asked.append(mode)


@dataclass
class Shown:
    panel: SolvePanel
    session: RecordedSession
    panels: Panels

    def draw(self, solve: SolveView = SOLVED, source: Any = "solve", **changes: Any) -> SessionView:
        view = running(2, **{"playing": False, "solve": solve, **changes})
        view = replace(view, settings=Settings(action_source=source, plan=PlanOptions(rollouts=32)))
        self.session.shown = view
        self.panel.draw(view)
        return view


@pytest.fixture
def shown(server: viser.ViserServer) -> Iterator[Shown]:
    session = RecordedSession()
    yield Shown(SolvePanel(server, session), session, Panels(server))  # type: ignore[arg-type]


def test_it_is_there_only_while_actions_are_planned(shown: Shown) -> None:
    shown.draw(source="random")
    assert not shown.panels.part("Solve").seen
    shown.draw()
    assert shown.panels.part("Solve").seen and shown.panels.control("Rollouts").value == 32


def test_it_tells_what_the_rollouts_earned_and_what_came_of_it(shown: Shown) -> None:
    shown.draw()
    said = shown.panels.html()
    for told in (
        "Env 0 is solved at step 3",
        "3.5",
        "has earned <b>1</b> in 3 steps",
        "last plan, carried on",
        "5 rollouts in 0.25 s",
        "5 125 env-steps/s",
    ):
        assert told in said
    (chart,) = shown.panels.charts()
    assert [list(line) for line in chart.data[1:]] == [
        pytest.approx([0.5, 0.6, 0.9]),
        pytest.approx([0.4, 0.6, 0.8]),
    ]


def test_what_the_episode_earned_is_what_the_table_of_envs_says_also_where_planning_began_later() -> None:
    later = replace(SOLVED, begins=6)
    assert "has earned <b>3</b> in 30 steps" in solve_html(later, rows_of(), 5)
    assert "has earned <b>20</b> in 33 steps" in solve_html(later, rows_of(), 1), "until the end"
    assert "has earned" not in solve_html(later, rows_of(), 3), "it was not followed from its start"


def test_without_a_plan_it_says_what_to_press_and_why_there_is_none() -> None:
    assert "Press <i>Play</i>" in solve_html(SolveView(), None, 0)
    assert "building envs" in solve_html(SolveView("starting", activity="building envs"), None, 0)
    failed = solve_html(SolveView("failed", why="it is <b>random", problem=problem()), None, 0)
    assert "There is no plan: it is &lt;b&gt;random: KeyError" in failed and "push.py:88" in failed


def test_rollouts_that_earn_the_same_are_told() -> None:
    flat = replace(PLAN, returns=np.ones(5, np.float32), success_at=np.zeros(5, np.int32))
    assert "nothing leads on" in solve_html(replace(SOLVED, plan=flat), None, 0)
    solved = solve_html(SOLVED, None, 0)
    assert "nothing leads on" not in solved and "Solved at step 3" in solved


def test_sliders_ask_for_other_plans(shown: Shown) -> None:
    shown.draw()
    shown.panels.set("Method", "CEM")
    shown.panels.set("Plan for", ALL_ENVS)
    shown.panels.set("Lines follow", "cube")
    plan = PlanOptions(rollouts=32)
    assert shown.session.asked == [
        {"plan": replace(plan, method="cem")},
        {"solve_all": True},
        {"traced": "cube"},
    ]


def test_a_solved_episode_is_saved_and_a_playing_one_is_not_offered(shown: Shown) -> None:
    shown.draw(playing=True)
    assert not shown.panels.shows(SAVE_SOLVED)
    shown.draw()
    assert "saving" not in shown.panels.html()
    shown.panels.press(SAVE_SOLVED)
    assert shown.session.asked == [("save", (0,))]
    # Before the session has answered.
    assert ">saving<" in shown.panels.html() and shown.panels.control(SAVE_SOLVED).disabled
    under_way = SaveStatus(progress=JobProgress("rendering it again", 2, 8))
    shown.draw(recording=RecordingStatus(saving=under_way))
    assert "rendering it again, 2 of 8 moments" in shown.panels.html()
    shown.draw(recording=RecordingStatus(saving=SaveStatus("saved 1 episode, 7 steps")))
    assert (
        "saved 1 episode, 7 steps" in shown.panels.html() and not shown.panels.control(SAVE_SOLVED).disabled
    )


def test_a_success_is_told_once_whichever_tab_is_open(shown: Shown, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(
        "workbench.ui.live.solve_panel.tell_all", lambda server, title, text, **more: told.append(text)
    )
    shown.draw(SolveView())
    shown.draw()
    shown.draw()
    assert told == ["Env 0 is solved at step 3."]


def test_a_rollout_of_the_last_plan_can_be_looked_at_while_it_is_paused(shown: Shown) -> None:
    shown.draw(playing=True)
    assert not shown.panels.shows("Look at")
    shown.draw()
    assert "The best rollout: return 3.5, success at step 3" in shown.panels.html()
    shown.panels.set("Look at", 2)
    shown.draw()
    assert "Rollout 3 of 5: return 1.25" in shown.panels.html()
    assert in_words(replace(PLAN, drawn=(0, 1, 3)), 2) == "Rollout 4 of 5: return 1, which holds still"


def test_the_ways_are_in_the_view_unless_the_past_is_shown_or_a_person_hides_them(shown: Shown) -> None:
    here = np.zeros(3, np.float32)
    shown.panel.draw_in_view(shown.draw(), here)
    assert len(shown.panels.nodes("/rollouts")) == 1
    view = shown.draw()
    shown.panel.draw_in_view(replace(view, timeline=replace(view.timeline, shown=0)), here)
    assert shown.panels.nodes("/rollouts") == []
    shown.panel.draw_in_view(shown.draw(), here)
    shown.panels.set("Show rollouts", False)
    shown.panel.draw_in_view(shown.draw(), here)
    assert shown.panels.nodes("/rollouts") == []


def test_the_control_mode_in_which_plans_are_found_is_offered_where_the_robot_has_it(shown: Shown) -> None:
    view = shown.draw()
    assert not offers_better_mode(view) and view.task is not None
    modes = (
        Keyword(
            "control_mode",
            "choice",
            '"pd_joint_delta_pos"',
            choices=('"pd_ee_delta_pose"', '"pd_joint_delta_pos"'),
        ),
    )
    with_modes = replace(view.task, made=HowMade(modes=modes))
    shown.draw(task=with_modes)
    shown.panels.press(USE_MODE)
    assert shown.session.asked == ["pd_ee_delta_pose"]
    shown.draw(task=replace(with_modes, control_mode="pd_ee_delta_pose"))
    assert not shown.panels.shows(USE_MODE)


def test_the_usual_horizon_is_shown_in_seconds() -> None:
    assert horizon_seconds(PlanOptions(), 0.05) == pytest.approx(0.5)
    assert horizon_seconds(PlanOptions(horizon=1.0), 0.05) == pytest.approx(1.0)

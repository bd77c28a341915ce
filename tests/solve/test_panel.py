"""The folder *Solve*: its texts about a plan, and its requests to the session."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.drive.env_rows import rows_of
from tests.drive.live import Live
from tests.drive.scenes import PLAN, problem, running
from workbench.envs.keywords import HowMade, Keyword
from workbench.live.commands import UseControlMode
from workbench.live.messages import Settings
from workbench.live.process.background_jobs import JobProgress
from workbench.page.commands import TellOpenTab
from workbench.planning.options import PlanOptions
from workbench.record.commands import SaveSolved
from workbench.record.saving_state import SaveStatus
from workbench.record.state import RecordingStatus
from workbench.solve.commands import (
    ChooseMethod,
    ChoosePlannedEnvs,
    FollowBody,
    LookAtRollout,
    SetPlanEvery,
    SetRollouts,
)
from workbench.solve.panel import (
    ACHIEVED,
    ALL_ENVS,
    PREDICTED,
    SAVE_SOLVED,
    USE_MODE,
    in_words,
    solve_html,
)
from workbench.solve.state import SolveView

pytestmark = pytest.mark.thorough

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


class Solve:
    def __init__(self, live: Live) -> None:
        self.live = live

    def draw(
        self, solve: SolveView = SOLVED, source: Any = "solve", horizon: float = 0.0, **changes: Any
    ) -> None:
        view = running(2, **{"playing": False, "state": "paused", "solve": solve, **changes})
        view = replace(
            view, settings=Settings(action_source=source, plan=PlanOptions(rollouts=32, horizon=horizon))
        )
        self.live.show(view, rows_of())


@pytest.fixture
def solve(live_page: Live) -> Solve:
    return Solve(live_page)


def test_the_folder_shows_the_rollouts_returns_and_the_result(solve: Solve) -> None:
    solve.draw(source="random")
    assert not solve.live.part("Solve").seen
    solve.draw()
    part = solve.live.part("Solve")
    assert part.seen and part.field("Rollouts").value == 32 and part.field("Horizon").value == 0.5
    for words in (
        "Env 0 is solved at step 3",
        "3.5",
        "<b>1</b> in 3 steps",
        "5 rollouts in 0.25 s",
        "5 125 env-steps/s",
    ):
        assert words in part.html()
    (chart,) = part.charts()
    assert chart.of(PREDICTED)[:, 1] == pytest.approx([0.5, 0.6, 0.9], abs=0.01)
    assert chart.of(ACHIEVED)[:, 1] == pytest.approx([0.4, 0.6, 0.8], abs=0.01)
    solve.draw(replace(SOLVED, predicted=SOLVED.predicted[:1], achieved=SOLVED.achieved[:1]))
    assert part.charts() == []
    solve.draw(horizon=1.0)
    assert part.field("Horizon").value == 1.0


def test_the_episodes_return_equals_the_env_tables() -> None:
    later = replace(SOLVED, begins=6)
    assert "<b>3</b> in 30 steps" in solve_html(later, rows_of(), 5)
    assert "<b>20</b> in 33 steps" in solve_html(later, rows_of(), 1), "the return covers the whole episode"
    assert "has earned" not in solve_html(later, rows_of(), 3), "the episode was not followed from its start"


def test_without_a_plan_the_reason_is_shown() -> None:
    assert "building envs" in solve_html(SolveView("starting", activity="building envs"), None, 0)
    failed = solve_html(SolveView("failed", why="it is <b>random", problem=problem()), None, 0)
    assert "it is &lt;b&gt;random: KeyError" in failed and "push.py:88" in failed
    flat = replace(PLAN, returns=np.ones(5, np.float32), success_at=np.zeros(5, np.int32))
    assert "show no direction" in solve_html(replace(SOLVED, plan=flat), None, 0)
    assert "show no direction" not in solve_html(SOLVED, None, 0)


def test_controls_change_the_plan_options(solve: Solve) -> None:
    solve.draw()
    solve.live.set("Method", "CEM")
    solve.live.set("Plan for", ALL_ENVS)
    solve.live.set("Lines follow", "cube")
    solve.live.set("Rollouts", 64)
    solve.live.set("Plan every", 2)
    solve.live.set("Horizon", 99.0)
    assert solve.live.asked == [
        ChooseMethod(method="cem"),
        ChoosePlannedEnvs(envs="all"),
        FollowBody(body="cube"),
        SetRollouts(rollouts=64),
        SetPlanEvery(every=2),
    ]
    assert len(solve.live.client.notices) == 1, "the horizon is out of range"


def test_a_solved_episode_can_be_saved_but_not_while_playing(solve: Solve) -> None:
    solve.draw(playing=True)
    assert not solve.live.shows(SAVE_SOLVED)
    solve.draw()
    solve.live.press(SAVE_SOLVED)
    assert solve.live.asked == [SaveSolved()]
    part = solve.live.part("Solve")
    solve.draw(recording=RecordingStatus(saving=SaveStatus(progress=JobProgress("rendering it again", 2, 8))))
    assert "2 of 8" in part.html() and part.button(SAVE_SOLVED).command is None
    solve.draw(recording=RecordingStatus(saving=SaveStatus("saved 1 episode, 7 steps")))
    assert "saved 1 episode, 7 steps" in part.html() and part.button(SAVE_SOLVED).command is not None
    solve.draw(replace(SOLVED, solved=()))
    assert not solve.live.shows(SAVE_SOLVED)


def test_a_success_is_announced_once_per_episode(solve: Solve, monkeypatch: pytest.MonkeyPatch) -> None:
    announced: list[str] = []
    monkeypatch.setattr(
        "workbench.solve.panel.notify_all", lambda server, title, text, **more: announced.append(text)
    )
    for view in (SolveView(), SOLVED, SOLVED, SolveView(), SOLVED):
        solve.draw(view)
    assert announced == ["Env 0 is solved at step 3."] * 2


def test_a_rollout_of_the_last_plan_can_be_viewed_while_paused(solve: Solve) -> None:
    solve.draw(playing=True)
    assert not solve.live.shows("Look at")
    solve.draw()
    solve.live.set("Look at", 2)
    solve.draw()
    assert "Rollout 3 of 5: return 1.25" in solve.live.html()
    assert solve.live.field("Look at").bounds == (1, 3)
    solve.live.do(LookAtRollout(number=4))
    assert solve.live.client.notices
    solve.draw(replace(SOLVED, plan=replace(PLAN, drawn=(0, 2))))
    assert solve.live.field("Look at").value == 2
    solve.draw(replace(SOLVED, plan=replace(PLAN, drawn=(0,))))
    assert not solve.live.shows("Look at")
    assert in_words(replace(PLAN, drawn=(0, 1, 3)), 2).startswith("Rollout 4 of 5: return 1")


def test_rollout_paths_are_drawn_where_wanted_and_not_in_the_past(solve: Solve) -> None:
    def path_nodes() -> int:
        return len(solve.live.nodes("/rollouts"))

    solve.draw()
    assert path_nodes() == 0
    solve.live.do(TellOpenTab(tab="Try"))
    solve.draw()
    assert path_nodes() == 1
    solve.draw(timeline=replace(running(2).timeline, shown=0))
    assert path_nodes() == 0
    solve.draw()
    assert path_nodes() == 1
    solve.live.do(TellOpenTab(tab="Run"))
    solve.draw()
    assert path_nodes() == 0
    solve.live.set("Show rollouts", "on all tabs")
    solve.draw()
    assert path_nodes() == 1
    solve.live.do(TellOpenTab(tab="Try"))
    solve.live.set("Show rollouts", "off")
    solve.draw()
    assert path_nodes() == 0


def test_the_control_mode_that_suits_planning_is_offered_if_the_robot_has_it(solve: Solve) -> None:
    solve.draw()
    assert not solve.live.shows(USE_MODE)
    choices = ('"pd_ee_delta_pose"', '"pd_joint_delta_pos"')
    modes = (Keyword("control_mode", "choice", choices[1], choices=choices),)
    task = running(2).task
    assert task is not None
    task = replace(task, made=HowMade(modes=modes))
    solve.draw(task=task)
    solve.live.press(USE_MODE)
    assert solve.live.asked == [UseControlMode(mode="pd_ee_delta_pose")]
    solve.draw(task=replace(task, control_mode="pd_ee_delta_pose"))
    assert not solve.live.shows(USE_MODE)

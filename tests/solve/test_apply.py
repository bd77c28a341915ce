"""The states of planning and of solving seeds: events, the effects that follow, and the jobs that perform them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from tests.drive.background import ScriptedBackground
from tests.drive.panels import Panels
from tests.drive.scenes import PLAN
from tests.drive.session import DEATH, FakeWorkerSession
from tests.drive.waiting import until
from workbench.checks.commands import ChooseSeeds, ShowSolved, SolveSeeds, StopSolving
from workbench.checks.rule_table import RULES
from workbench.live.events import FileSaved, WorkerDied
from workbench.live.messages import FollowPlan, Load, PlanDropped, PlanWanted, Play, Status
from workbench.live.process.background_jobs import JobFailed
from workbench.machine.loop import do
from workbench.page.command import Command, Refused
from workbench.planning.options import PlanOptions
from workbench.planning.planned_episodes import PlannedEpisode
from workbench.planning.seeds_report import SolvedSeed, SolveReport
from workbench.planning.verdicts import RewardVerdict
from workbench.record.job import Recorded
from workbench.record.job_worker import Written
from workbench.solve.commands import (
    ChooseMethod,
    ChoosePlannedEnvs,
    FollowBody,
    SetHorizon,
    SetNoise,
    SetPlanEvery,
    SetRollouts,
    SetTemperature,
)
from workbench.solve.job import SolveOptions, report_of
from workbench.solve.panel import in_words
from workbench.solve.questions import PlanActions, Planned, PlannedEnv
from workbench.solve.seeds import BeginSeeds, EndSeeds, SeedsDone, SeedsFailed, SeedsUpdate, SeedsView
from workbench.solve.seeds_panel import SolveSeedsPanel, verdict_cards
from workbench.solve.state import (
    BeginPlan,
    EndPlan,
    PlanActivity,
    PlanFailed,
    PlanJobs,
    PlanMade,
    RolloutsStart,
    SolveState,
    SolveView,
    Solving,
    apply,
)
from workbench.task.description import TaskOptions
from workbench.task.problem import Problem

PROBLEM = Problem("step", "KeyError: 'goal'", "push.py", 31, "x", "")
FEW = PlanOptions(rollouts=16, horizon=0.3, noise=0.8, every=2)


@pytest.mark.parametrize(
    "event", [PlanDropped(), FileSaved(), WorkerDied(DEATH, "")], ids=lambda event: type(event).__name__
)
@pytest.mark.parametrize("state", ["starting", "planning", "none", "failed"])
def test_planning_ends_with_its_request_its_version_and_its_worker(state: SolveState, event: object) -> None:
    solving = Solving(SolveView(state, activity="importing"))
    ended, effects = apply(solving, event, cast(Any, None))
    if state in ("none", "failed"):
        assert (ended, effects) == (solving, [])
    else:
        assert (ended.shared.state, ended.shared.activity, effects) == ("none", "", [EndPlan()])


def planned(env: int, best: float) -> PlannedEnv:
    """A plan of two actions that differ for each env, over a horizon of four steps."""
    actions = np.array([[env, 10 + env], [20 + env, 30 + env]], np.float32)
    return replace(PLAN, env=env, actions=actions, returns=np.array([best, best - 1], np.float32))


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The effects of planning and of solving seeds, which are not performed."""
    begun: list[Any] = []
    for jobs in ("state.PlanJobs", "seeds.SeedsJobs"):
        monkeypatch.setattr(f"workbench.solve.{jobs}.perform", lambda _, effect: begun.append(effect))
    return begun


@pytest.fixture
def solving(played: FakeWorkerSession, begun: list[Any]) -> FakeWorkerSession:
    """A session of three envs that takes its actions from plans, from the third step of an episode on."""
    played.reset()
    played.step(2)
    played.session.change(action_source="solve", plan=FEW, traced="cube")
    played.step()
    played.asked(object)
    return played


def plan_of(fake: FakeWorkerSession, env: int) -> SolveView:
    fake.session.change(selected_env=env)
    return fake.view.of(SolveView)


def test_a_plan_is_made_with_the_version_and_followed_by_its_envs(
    solving: FakeWorkerSession, begun: list[Any]
) -> None:
    session = solving.session
    wanted = PlanWanted(5, (0, 2), b"state", ({}, {}))
    solving.tell(wanted)
    (begin,) = begun
    assert isinstance(begin, BeginPlan) and begin.wanted == wanted
    assert (begin.load.options.num_envs, begin.load.options.seed) == (1, 0)
    assert (begin.options, begin.traced) == (FEW, "cube")
    states = [solving.view.of(SolveView).state]
    session.dispatch(PlanActivity("too early"))
    assert not solving.view.of(SolveView).activity, "only the start has a text"
    for event in (RolloutsStart(), PlanActivity("building envs")):
        session.dispatch(event)
        states.append(solving.view.of(SolveView).state)
    assert solving.view.of(SolveView).activity == "building envs"
    solving.asked(object)
    session.dispatch(PlanMade(wanted, (planned(0, 8.0), planned(2, 2.0)), 123.0))
    assert [*states, solving.view.of(SolveView).state] == ["planning", "starting", "starting", "planning"]
    assert not solving.view.of(SolveView).activity
    (follow,) = solving.asked(FollowPlan)
    assert (follow.number, follow.env_idx) == (5, (0, 2))
    assert follow.actions.tolist() == [[[0, 10], [2, 12]], [[20, 30], [22, 32]]]
    solving.step(3, reward=[1, 10, 100])
    session.dispatch(PlanMade(wanted, (planned(2, 6.0),), 77.0))
    solving.step(reward=[3, 30, 300])
    for env, predicted, rewards, step, rate in (
        (0, [2.0, None, None, None], [1, 1, 1, 3], 3, 123.0),
        (1, [None] * 4, [10, 10, 10, 30], 0, 0.0),
        (2, [0.5, None, None, 1.5], [100, 100, 100, 300], 6, 77.0),
    ):
        view = plan_of(solving, env)
        assert view.begins == 3 and (view.plan_step, view.steps_per_second) == (step, rate)
        assert [None if np.isnan(one) else float(one) for one in view.predicted] == predicted
        horizon = 1 if env == 1 else 4
        means = [float(np.mean(rewards[at : at + horizon])) for at in range(4)]
        assert view.achieved.tolist() == pytest.approx(means)
        assert (None if view.plan is None else view.plan.env) == (None if env == 1 else env)
    solving.reset((2,))
    assert plan_of(solving, 2).plan is None and plan_of(solving, 0).plan is not None
    assert plan_of(solving, 2).begins == 0


def test_without_a_plan_the_worker_pauses_and_the_next_request_plans_again(
    solving: FakeWorkerSession, begun: list[Any]
) -> None:
    session = solving.session
    for fails in range(2):
        solving.tell(Status(True, 20.0, 1.0), PlanWanted(5 + fails, (0,), b"state", ({},)))
        solving.asked(object)
        session.dispatch(PlanFailed("the task raised", PROBLEM))
        view = solving.view.of(SolveView)
        assert (view.state, view.why, view.problem) == ("failed", "the task raised", PROBLEM)
        assert [one.playing for one in solving.asked(Play)] == [False]
        session.dispatch(PlanFailed("late", None))
        session.dispatch(PlanMade(PlanWanted(5, (0,)), (planned(0, 1.0),), 1.0))
        session.dispatch(RolloutsStart())
        assert solving.view.of(SolveView).why == "the task raised" and not solving.asked(FollowPlan)
    solving.tell(PlanWanted(9, (0,), b"state", ({},)))
    view = solving.view.of(SolveView)
    assert (view.state, view.why, view.problem) == ("planning", "", None)
    solving.tell(PlanWanted(10, (0,), why_not="it cannot be copied"))
    assert isinstance(begun[-1], EndPlan) and solving.view.of(SolveView).state == "failed"
    assert [type(one) for one in begun[:-1]] == [BeginPlan] * 3


def test_each_option_changes_alone(solving: FakeWorkerSession) -> None:
    session = solving.session
    changes: Sequence[tuple[Command, dict[str, Any]]] = [
        (ChooseMethod(method="cem"), {"method": "cem"}),
        (SetRollouts(rollouts=32), {"rollouts": 32}),
        (SetHorizon(horizon=1.0), {"horizon": 1.0}),
        (SetNoise(noise=0.4), {"noise": 0.4}),
        (SetTemperature(temperature=0.3), {"temperature": 0.3}),
        (SetPlanEvery(every=4), {"every": 4}),
    ]
    wanted = FEW
    for command, change in changes:
        session.do(command)
        wanted = replace(wanted, **change)
        assert solving.view.settings.plan == wanted
    for envs in ("all", "selected"):
        session.do(ChoosePlannedEnvs(envs=envs))  # type: ignore[arg-type]
        assert solving.view.settings.solve_all is (envs == "all")
    for body, follows in (
        ("arm/hand", True),
        ("", True),
        ("cube", True),
        ("ground", False),
        ("table", False),
        ("x", False),
    ):
        if follows:
            session.do(FollowBody(body=body))
        else:
            with pytest.raises(Refused):
                session.do(FollowBody(body=body))
        assert solving.view.settings.traced == (body if follows else "cube")


def test_the_process_is_asked_for_the_moment_and_told_of_its_start_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    answers: list[Any] = [Planned((planned(0, 1.0), planned(2, 2.0)))]
    process = ScriptedBackground(lambda question: answers[0])
    monkeypatch.setattr("workbench.solve.state.Background", lambda niceness: process)
    events: list[Any] = []
    jobs = PlanJobs(events.append)
    begin = BeginPlan(
        PlanWanted(5, (0, 2), b"state", ({"a": b"1"}, {})), Load("push.py", TaskOptions(1)), FEW, "cube"
    )

    def plan(ends: type) -> list[Any]:
        events.clear()
        do(lambda: jobs.perform(begin))
        until(lambda: any(isinstance(event, ends) for event in events), "the end")
        return [event for event in events if not isinstance(event, PlanActivity)]

    start, made = plan(PlanMade)
    assert isinstance(start, RolloutsStart) and made.wanted == begin.wanted and made.steps_per_second > 0
    assert made.envs == answers[0].envs
    assert process.of(PlanActions) == [PlanActions(b"state", ({"a": b"1"}, {}), FEW, "cube")]
    assert [type(one) for one in plan(PlanMade)] == [PlanMade], "the version is loaded"
    assert len(process.ensured) == 1 or process.ensured[0] == process.ensured[1]
    answers[0] = JobFailed("it raised", PROBLEM)
    (failed,) = plan(PlanFailed)
    assert (failed.why, failed.problem) == ("it raised", PROBLEM)
    answers[0] = Planned(())
    events.clear()

    def begins_and_ends() -> None:
        jobs.perform(begin)
        jobs.perform(EndPlan())

    do(begins_and_ends)
    do(lambda: None)
    assert not any(isinstance(event, PlanMade | PlanFailed) for event in events)
    jobs.close()


# --- seeds ----------------------------------------------------------------------------------------------


def solved(seed: int, at: int = 3, path: str = "") -> SolvedSeed:
    return SolvedSeed(seed, at, 9, 1.5, 0.5, "" if at else "it fell", Path(path or f"{seed}.rrd"))


def test_seeds_are_solved_reported_and_stopped(played: FakeWorkerSession, begun: list[Any]) -> None:
    session = played.session
    session.change(plan=FEW)

    def seen() -> SeedsView:
        return played.view.of(SeedsView)

    session.do(ChooseSeeds(seeds=5))
    session.do(SolveSeeds())
    (begin,) = begun
    assert isinstance(begin, BeginSeeds) and (begin.task, begin.seeds, begin.plan) == ("push.py", 5, FEW)
    assert (seen().state, seen().total, seen().chosen) == ("starting", 5, 5)
    serial = seen().serial
    session.dispatch(SeedsUpdate("importing"))
    assert (seen().state, seen().activity) == ("starting", "importing")
    session.dispatch(SeedsUpdate("seed 0, step 4", 0.25))
    assert (seen().state, seen().activity, seen().done) == ("solving", "seed 0, step 4", 0.25)
    report = SolveReport((solved(0),), (), 1.0, False, 5)
    session.dispatch(SeedsUpdate(report=report))
    assert (seen().report, seen().done, seen().activity) == (report, 0.25, "seed 0, step 4")
    assert seen().serial > serial and not seen().stale
    session.do(StopSolving())
    assert begun[1:] == [EndSeeds()] and (seen().state, seen().report) == ("stopped", report)
    for late in (SeedsUpdate("late", 3.0), SeedsDone(), SeedsFailed("late", None)):
        session.dispatch(late)
        assert seen().state == "stopped" and not seen().activity
    session.do(StopSolving())
    assert len(begun) == 2
    played.load("patched")
    assert seen().stale and seen().report == report
    session.do(SolveSeeds())
    assert (seen().state, seen().report, seen().stale, seen().done, seen().chosen) == (
        "starting",
        None,
        False,
        0,
        5,
    )
    session.dispatch(SeedsFailed("the task failed", PROBLEM))
    assert (seen().state, seen().why, seen().problem) == ("failed", "the task failed", PROBLEM)
    session.do(SolveSeeds())
    assert (seen().why, seen().problem) == ("", None)
    session.dispatch(SeedsUpdate(report=report))
    assert (seen().state, seen().report) == ("solving", report)
    session.dispatch(SeedsUpdate("seed 4", 4.5))
    session.dispatch(SeedsDone())
    assert (seen().state, seen().activity, len(begun)) == ("done", "", 4)


def test_a_press_on_a_seed_opens_its_recording(
    panels: Panels, played: FakeWorkerSession, begun: list[Any]
) -> None:
    looked: list[Path] = []
    panel = SolveSeedsPanel(panels.server, played.session, looked.append)
    panel.do(ShowSolved(seed=1), cast(Any, None))
    assert not looked
    played.session.do(SolveSeeds())
    report = SolveReport((solved(0), solved(1, 0), solved(2)), (), 1.0, False, 3)
    played.session.dispatch(SeedsUpdate(report=report))
    for seed in (1, 2, 7):
        panel.do(ShowSolved(seed=seed), cast(Any, None))
    assert looked == [Path("1.rrd"), Path("2.rrd")]
    panel.draw(played.view)
    assert all(panels.presses(ShowSolved(seed=seed)) for seed in (0, 1, 2))
    assert "it fell" in panels.html()
    assert any("2 of 3 solved" in fold for fold in panels.folders())


def episode(seed: int, success: Sequence[int], cut_off: bool = False) -> PlannedEpisode:
    steps = len(success)
    numbers = np.arange(steps, dtype=np.float32)
    no = np.zeros(steps, bool)
    return PlannedEpisode(
        seed,
        4,
        numbers,
        np.array(success, bool),
        no,
        numbers + 1,
        numbers,
        numbers,
        plan_seconds=seed / 2,
        cut_off=cut_off,
    )


def test_a_report_has_a_row_for_each_seed_with_its_own_numbers() -> None:
    episodes = [episode(3, [0, 0, 1]), episode(4, [0, 0, 0, 0]), episode(5, [1, 1], cut_off=True)]
    written = tuple(
        Written(at, Path(f"{one.seed}.rrd"), one.seed, one.steps, 10.0 + at, bool(one.solved_at), planned=one)
        for at, one in enumerate(episodes)
    )
    report = report_of(SolveOptions("push.py", seeds=6), Recorded(written, 3, True), 7.5)
    assert [(one.seed, one.solved_at, one.steps, one.total_reward, one.seconds) for one in report.seeds] == [
        (3, 3, 3, 10.0, 1.5),
        (4, 0, 4, 11.0, 2.0),
        (5, 1, 2, 12.0, 2.5),
    ]
    assert [bool(one.in_the_way) for one in report.seeds] == [False, True, False]
    assert [one.path for one in report.seeds] == [one.path for one in written]
    assert [one.cut_off for one in report.seeds] == [False, False, True]
    assert (report.seconds, report.stopped, report.wanted) == (7.5, True, 6)
    assert [one.seed for one in report.solved] == [3, 5] and report.median_steps == 2
    assert [verdict.seeds for verdict in report.verdicts] == [(4,)]
    few = report_of(SolveOptions("push.py", seeds=6), Recorded(written[:2], 2, False), 7.5)
    assert not few.verdicts and not few.stopped, "the next seeds may refute them"
    options = SolveOptions(
        "push.py", Path("out"), 6, 2, True, 70, FEW, TaskOptions(3), 9.0, "s3://x"
    ).recording()
    assert (options.task, options.out, options.episodes, options.workers) == ("push.py", Path("out"), 6, 2)
    assert (options.actions, options.pictures, options.max_steps, options.seconds_per_seed) == (
        "solve",
        True,
        70,
        9.0,
    )
    assert (options.upload, options.plan, options.options.num_envs, options.after_success) == (
        "s3://x",
        FEW,
        3,
        5,
    )


def test_the_rollouts_of_the_last_plan_and_of_holding_still_are_named() -> None:
    texts = [in_words(PLAN, place) for place in range(3)]
    assert "3.5" in texts[0] and "1.25" in texts[1] and "0.5" in texts[2]
    assert "3" in texts[1] and "5" in texts[2] and len(set(texts)) == 3
    same = replace(PLAN, plan=2, hold=4)
    held, last = in_words(same, 2), in_words(same, 1)
    assert held != texts[2] and last != texts[1] and held.split(",")[-1] != last.split(",")[-1]
    assert "3" in in_words(PLAN, 0).split(":")[-1].split(",")[-1], "success at step 3"
    assert not in_words(PLAN, 2).split(":")[-1].count(",")


def test_a_verdict_names_its_rule_and_its_first_seeds() -> None:
    rule = next(iter(RULES))
    report = SolveReport((), (RewardVerdict(rule, "odd", tuple(range(40, 60))),), 1.0, False, 60)
    (card,) = verdict_cards(report, old=True)
    (row,) = card.rows
    assert card.rule is RULES[rule] and row.old and row.finding.count == 20
    assert "51" in row.finding.message and "52" not in row.finding.message and "odd" in row.finding.message

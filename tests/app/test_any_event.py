"""Any events in any order: the checks, the profile, the seeds and the plans depend only on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.scenes import PLAN, description, problem, step_of, table_scene
from tests.drive.session import DEATH, moment
from workbench.checks import profile
from workbench.checks import state as checks
from workbench.checks.commands import (
    CheckAfterSave,
    CheckNow,
    ChooseSeeds,
    SolveSeeds,
    StopChecks,
    StopProfile,
    StopSolving,
    TimeStep,
)
from workbench.checks.results import HookTime, RuleResult, StepProfile
from workbench.envs.gpu_rules import Finding
from workbench.live.effects import Asked
from workbench.live.events import FileSaved, LoadDone, VersionLoaded, WorkerDied
from workbench.live.messages import Loaded, PlanDropped, PlanWanted, Settings
from workbench.live.run import Run, first_run
from workbench.page.command import Refused
from workbench.planning.seeds_report import SolveReport
from workbench.solve import seeds as solve_seeds
from workbench.solve import state as solver
from workbench.task.description import TaskOptions
from workbench.task.reference import RecordedTask

ENVS = 2
GEOMETRY, POSES = table_scene(ENVS)
NOTHING = first_run("push.py", TaskOptions(ENVS), 1, Settings())
PUSH = replace(NOTHING, task=description(GEOMETRY))
RUNS = (
    NOTHING,
    PUSH,
    replace(PUSH, settings=Settings(action_source="solve")),
    replace(PUSH, task=replace(description(GEOMETRY), env_id="Pull-v1", source={"push.py": "pass"})),
    replace(PUSH, options=TaskOptions(ENVS, rules="off")),
    replace(PUSH, running_reference=RecordedTask("Push-v1")),
)
FINDING = Finding("success-at-reset", "stop", "it is broken", "push.py", 7, "pass", "evaluate", 8, 0)
RESULTS = (RuleResult("success-at-reset", "broken", (FINDING,)), RuleResult("reward-changes", "kept"))
REPORT = SolveReport((), (), 1.0, False, 2)
PROFILE = StepProfile(2, 20, 1.0, (HookTime("evaluate", 1.0, 1.0),), ())

flags, numbers, why = st.booleans(), st.integers(0, 3), st.sampled_from(["", "it died"])
problems = st.sampled_from([None, problem()])
plan_requests = st.builds(PlanWanted, numbers, st.just((0,)), why_not=why)
EVENTS = st.one_of(
    st.sampled_from([CheckNow(), StopChecks(), TimeStep(), StopProfile(), SolveSeeds(), StopSolving()]).map(
        Asked
    ),
    st.builds(CheckAfterSave, on=flags).map(Asked),
    st.builds(ChooseSeeds, seeds=st.integers(1, 256)).map(Asked),
    st.just(VersionLoaded(Loaded(description(GEOMETRY), step_of(POSES), {}), True)),
    st.sampled_from([LoadDone(), FileSaved(), WorkerDied(DEATH, ""), PlanDropped()]),
    plan_requests,
    st.builds(
        moment,
        numbers.map(lambda step: np.full(ENVS, step, np.int32)),
        st.sampled_from([(), (0,), (0, 1)]),
        st.sampled_from([(), (1,)]),
    ),
    st.builds(checks.CheckWaits, flags),
    st.just(checks.GroupBegan()),
    st.builds(checks.RuleChecked, st.sampled_from(RESULTS), st.floats(0, 9), st.none() | numbers),
    st.builds(checks.GroupChecked, numbers, why),
    st.just(checks.CheckDone()),
    st.builds(checks.CheckFailed, why, problems),
    st.just(profile.StepTimed(PROFILE)),
    st.builds(profile.ProfileFailed, why, problems),
    st.builds(solve_seeds.SeedsUpdate, why, st.none() | st.floats(0, 256), st.sampled_from([None, REPORT])),
    st.just(solve_seeds.SeedsDone()),
    st.builds(solve_seeds.SeedsFailed, why, problems),
    st.just(solver.RolloutsStart()),
    st.builds(solver.PlanActivity, why),
    st.builds(solver.PlanMade, plan_requests, st.just((PLAN,)), st.floats(1, 99)),
    st.builds(solver.PlanFailed, why, problems),
)
SEQUENCES = st.lists(st.tuples(EVENTS, st.sampled_from(RUNS)), max_size=40)
"""(event, run after the event) pairs."""


@dataclass(frozen=True)
class Feature:
    first: Any
    apply: Callable[[Any, object, Run, Run], tuple[Any, list[Any]]]
    view: Callable[[Any], Any]
    running: tuple[str, ...]
    """States in which its job may run."""
    begins: type
    """The effect that begins its job."""
    ends: tuple[type, ...]
    """The effect that ends the job, and the job's last event."""


def without_before(apply: Callable[[Any, object, Run], Any]) -> Callable[[Any, object, Run, Run], Any]:
    """Adapt an `apply` that only takes the run after the event to one that also gets the run before it."""
    return lambda value, event, before, run: apply(value, event, run)


FEATURES = {
    "checks": Feature(
        checks.Checks(),
        checks.apply,
        lambda value: value.view,
        checks.RUNNING,
        checks.BeginCheck,
        (checks.EndCheck, checks.CheckDone, checks.CheckFailed),
    ),
    "profile": Feature(
        profile.ProfileView(),
        without_before(profile.apply),
        lambda value: value,
        ("running",),
        profile.BeginProfile,
        (profile.EndProfile, profile.StepTimed, profile.ProfileFailed),
    ),
    "seeds": Feature(
        solve_seeds.SeedsView(),
        without_before(solve_seeds.apply),
        lambda value: value,
        solve_seeds.RUNNING,
        solve_seeds.BeginSeeds,
        (solve_seeds.EndSeeds, solve_seeds.SeedsDone, solve_seeds.SeedsFailed),
    ),
    "plans": Feature(
        solver.Solving(),
        without_before(solver.apply),
        lambda value: value.view(0),
        ("starting", "planning"),
        solver.BeginPlan,
        (solver.EndPlan, solver.PlanMade, solver.PlanFailed),
    ),
}


def test_the_check_of_a_load_is_started_last_and_so_runs_before_rescoring() -> None:
    loaded = VersionLoaded(Loaded(description(GEOMETRY), step_of(POSES), {}), True)
    value, effects = checks.apply(checks.Checks(), loaded, NOTHING, PUSH)
    assert effects == []
    _, effects = checks.apply(value, LoadDone(), PUSH, PUSH)
    assert [type(effect) for effect in effects] == [checks.BeginCheck]


features = pytest.mark.parametrize("feature", FEATURES.values(), ids=FEATURES)


def values_after(feature: Feature, happened: list[tuple[object, Run]]) -> list[tuple[Any, list[Any]]]:
    """The value after each event, and its effects."""
    values: list[tuple[Any, list[Any]]] = [(feature.first, [])]
    before = NOTHING
    for event, run in happened:
        try:
            values.append(feature.apply(values[-1][0], event, before, run))
        except Refused:
            values.append((values[-1][0], []))
        before = run
    return values


@features
@given(happened=SEQUENCES)
def test_the_same_events_give_the_same_value(feature: Feature, happened: list[tuple[object, Run]]) -> None:
    first, again = values_after(feature, happened), values_after(feature, happened)
    assert [value for value, _ in first] == [value for value, _ in again]
    for (before, _), (after, _) in zip(first, first[1:], strict=False):
        grew = feature.view(after).serial - feature.view(before).serial
        assert after is before if grew == 0 else grew > 0


@features
@given(happened=SEQUENCES)
def test_no_job_runs_when_the_page_shows_none(feature: Feature, happened: list[tuple[object, Run]]) -> None:
    runs = False
    for (event, _), (value, effects) in zip(happened, values_after(feature, happened)[1:], strict=True):
        runs = runs and not isinstance(event, feature.ends)
        for effect in effects:
            runs = isinstance(effect, feature.begins) or (runs and not isinstance(effect, feature.ends))
        assert not runs or feature.view(value).state in feature.running

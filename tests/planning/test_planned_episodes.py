"""What is kept of an episode with planned actions, and the report over several seeds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from workbench.envs.step_result import StepResult
from workbench.planning.options import PlanOptions
from workbench.planning.planned_episodes import EpisodeLog
from workbench.planning.rollouts import Plan
from workbench.planning.seeds_report import SolvedSeed, SolveReport, underway_text
from workbench.planning.verdicts import MIN_EPISODES, MIN_SEEDS


def plan(*returns: float, seconds: float = 1.0, **terms: list[float]) -> Plan:
    """A plan whose rollouts of two steps have these returns; rollout 1 holds still."""
    rewards = np.array([[each, 0] for each in returns], np.float32)
    kept = {name: np.array(each, np.float32) for name, each in terms.items()}
    return Plan(np.zeros((2, 1), np.float32), rewards, kept, np.zeros(len(returns), np.int32), seconds)


def step(reward: float, success: bool, fail: bool = False, height: float = 0.0) -> StepResult:
    """A step of three envs, of which env 1 has these values and the others the opposite."""
    return StepResult(
        np.zeros(3, np.int32),
        np.array([-reward, reward, -reward], np.float32),
        np.zeros(3, bool),
        np.zeros(3, bool),
        {
            "success": np.array([not success, success, not success]),
            "fail": np.array([not fail, fail, not fail]),
            "height": np.array([9, height, 9], np.float32),
            "place": np.ones((3, 2), np.float32),
        },
        np.zeros((3, 0, 7), np.float32),
    )


def test_an_episode_holds_the_plan_and_the_step_of_its_own_env() -> None:
    log = EpisodeLog(seed=4, horizon=2)
    first, second = (
        plan(3, 1, -2, seconds=0.5, reach=[1, 5, 2]),
        plan(np.inf, np.nan, 7, 4, seconds=0.25, reach=[1, 1, 1, 1], push=[0, 2, 0, 8]),
    )
    for each, taken in (
        (first, step(0.1, False)),
        (first, step(0.2, False)),
        (second, step(0.3, True, height=0.5)),
        (second, step(0.4, False, fail=True, height=0.75)),
    ):
        log.add_plan(each)
        log.add_step(taken, 1)
    log.add_plan(plan(9, 9, 9))  # its step is not taken
    episode = log.episode()
    assert (episode.seed, episode.horizon, episode.steps, episode.cut_off) == (4, 2, 4, False)
    np.testing.assert_allclose(episode.reward, [0.1, 0.2, 0.3, 0.4])
    assert episode.success.tolist() == [False, False, True, False] and episode.solved_at == 3
    assert episode.fail.tolist() == [False, False, False, True] and episode.failed_at == 4
    np.testing.assert_array_equal(episode.best, [3, 3, 7, 7])
    np.testing.assert_array_equal(episode.hold, [1, 1, np.nan, np.nan])
    np.testing.assert_array_equal(episode.worst, [-2, -2, 4, 4])
    np.testing.assert_array_equal(episode.terms["reach"], [4, 4, 0, 0])
    np.testing.assert_array_equal(episode.terms["push"], [np.nan, np.nan, 8, 8])
    assert episode.evaluate == {"success": 0.0, "fail": 1.0, "height": 0.75}
    assert episode.plan_seconds == 0.5 + 0.25 + 1.0, "a plan that is used for two steps was made once"
    log.cut_off = True
    assert log.episode().cut_off


def test_an_episode_without_success_or_fail_reaches_neither() -> None:
    log = EpisodeLog(seed=0, horizon=2)
    assert log.episode().steps == 0 and log.episode().reward.shape == (0,)
    taken = step(0.5, True)
    log.add_plan(plan(np.nan, np.nan))
    log.add_step(replace(taken, evaluate={"height": taken.evaluate["height"]}), 1)
    episode = log.episode()
    assert (episode.solved_at, episode.failed_at) == (0, 0)
    assert np.isnan(episode.best).all() and np.isnan(episode.worst).all()


def test_the_best_rollout_has_the_highest_finite_return() -> None:
    made = plan(np.inf, 2, np.nan, 5, 3)
    assert made.best == 3 and made.returns[4] == 3
    assert plan(-5, -1, -np.inf).best == 1


# --- the report ------------------------------------------------------------------------------------------


def seed(number: int, solved_at: int = 0, cut_off: bool = False) -> SolvedSeed:
    return SolvedSeed(number, solved_at, 50, 1.0, 2.0, "", Path(f"{number}.rrd"), cut_off)


def report(*seeds: SolvedSeed, wanted: int = 0) -> SolveReport:
    return SolveReport(seeds, (), 61.4, False, wanted or len(seeds))


def test_a_report_counts_the_solved_seeds_and_their_median_steps() -> None:
    made = report(seed(0, 9), seed(1), seed(2, 4), seed(3, 20))
    assert [one.seed for one in made.solved] == [0, 2, 3] and made.median_steps == 9
    for words in ("3 of 4 seeds", " 9 control steps", "61 s"):
        assert words in made.summary
    assert report(seed(0)).median_steps is None and made.so_far == ""
    part = report(seed(0, 9), seed(1), wanted=8)
    assert part.so_far == "after 2 of 8 seeds" and part.summary.startswith("2 of 8 seeds are done, 1 solved")
    assert report(seed(0), wanted=8).summary.startswith("1 of 8 seeds is done, 0 solved")


def test_a_report_tells_what_its_seeds_cannot_show() -> None:
    def enough(count: int, wanted: int) -> bool:
        return report(*map(seed, range(count)), wanted=wanted).has_enough_seeds

    assert not enough(MIN_EPISODES - 1, MIN_SEEDS) and enough(MIN_EPISODES, MIN_SEEDS)
    assert enough(1, 1) and not enough(1, 2)
    all_seeds = report(*map(seed, range(MIN_SEEDS)))
    assert all_seeds.notes == ()
    assert len(replace(all_seeds, wanted=MIN_SEEDS - 1).notes) == 1
    assert len(report(seed(0), wanted=MIN_SEEDS).notes) == 1
    assert len(report(seed(0), wanted=MIN_SEEDS - 1).notes) == 2
    cut = (seed(0, cut_off=True), seed(1, 9, cut_off=True), seed(2, cut_off=True))
    (note,) = report(*cut, *map(seed, range(3, MIN_SEEDS))).notes
    assert note.startswith("2 seeds ")


def test_running_seeds_are_named_in_order_with_their_steps() -> None:
    assert underway_text({}, 50) == ""
    assert underway_text({2: 12}, 50) == "seed 2 at step 12 of 50"
    assert underway_text({3: 7, 2: 12}, 50) == "seeds 2 and 3 at steps 12 and 7 of 50"
    assert underway_text({10: 1, 3: 7, 2: 12}, 50) == "seeds 2, 3 and 10 at steps 12, 7 and 1 of 50"


# --- the horizon -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "control_dt", "has_success", "steps"),
    [
        ({}, 0.05, True, 10),
        ({}, 0.05, False, 20),
        ({}, 0.01, True, 20),
        ({}, 0.1, True, 8),
        ({"horizon": 0.3}, 0.05, True, 6),
        ({"horizon": 0.3}, 0.05, False, 6),
        ({"horizon": 2.0}, 0.05, True, 40),
        ({"horizon": 0.05}, 0.05, True, 2),
        ({"horizon": 0.3, "every": 9}, 0.05, True, 9),
        ({"every": 30}, 0.05, True, 30),
    ],
)
def test_a_plan_is_long_enough_to_see_its_effect(
    given: dict, control_dt: float, has_success: bool, steps: int
) -> None:
    assert PlanOptions(**given).steps(control_dt, has_success) == steps


@pytest.mark.parametrize(
    "name", ["rollouts", "knots", "rounds", "every", "noise", "temperature", "elites", "horizon"]
)
def test_each_option_takes_its_least_value_and_nothing_below(name: str) -> None:
    least = {"rollouts": 4, "knots": 2, "rounds": 1, "every": 1, "horizon": 0.0}.get(name, 1e-6)

    def made(value: Any) -> PlanOptions:
        return PlanOptions(**{name: value})

    assert getattr(made(least), name) == least
    floats = [float("nan"), float("inf")] if isinstance(least, float) else []
    for wrong in (least - 1, *floats):
        with pytest.raises(ValueError, match=name):
            made(wrong)
    assert PlanOptions(elites=1.0).elites == 1

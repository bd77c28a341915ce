"""Verdicts on a reward: each with episodes that show it and episodes that do not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from workbench.planning.planned_episodes import PlannedEpisode
from workbench.planning.verdicts import in_the_way, of_episodes

STEPS, HORIZON = 20, 10


def row(values: Sequence[float] | float, dtype: type = np.float32) -> Any:
    return np.broadcast_to(np.asarray(values, dtype), (STEPS,)).copy()


def rises(seed: int = 0, solved_at: int = 15) -> PlannedEpisode:
    """Return a good episode: the reward rises until success, and rollouts differ until then."""
    reward = np.minimum(np.arange(1, STEPS + 1) / solved_at, 1.0).astype(np.float32)
    success = np.arange(1, STEPS + 1) >= solved_at
    best, one = row((HORIZON * reward + 1).tolist()), np.float32(1)
    return PlannedEpisode(seed, HORIZON, reward, success, row(0, bool), best, best - one, best - 2 * one)


def unsolved(
    reward: Sequence[float] | float, seed: int = 9, gain: float = 1.0, spread: float = 2.0
) -> PlannedEpisode:
    rewards = row(reward)
    best = HORIZON * rewards + gain
    evaluate = {"success": 0.0}
    return PlannedEpisode(
        seed,
        HORIZON,
        rewards,
        row(0, bool),
        row(0, bool),
        best,
        best - gain,
        best - spread,
        evaluate=evaluate,
    )


def rules(*episodes: PlannedEpisode) -> list[str]:
    return [verdict.rule for verdict in of_episodes(episodes)]


def test_good_episodes_have_no_verdict() -> None:
    assert rules(rises(0), rises(1), rises(2, solved_at=9)) == []
    assert rules() == []
    assert in_the_way(rises(), [rises()]) == ""


def test_an_unsolved_episode_that_ran_out_of_time_has_no_verdict() -> None:
    slow = unsolved(np.linspace(0, 0.7, STEPS).tolist())
    assert rules(rises(), slow) == []
    assert "step limit" in in_the_way(slow, [rises(), slow])


def test_a_higher_reward_without_success_is_an_exploit() -> None:
    held = replace(unsolved(1.0, seed=7), evaluate={"success": 0.0, "height": 0.2})
    (verdict,) = of_episodes([rises(0), held])
    assert (verdict.rule, verdict.seeds) == ("reward-exploited", (7,))
    assert "ended without success and earned 1.000 a step at their end" in verdict.message
    assert "at the end of seed 7, evaluate() returned success 0, height 0.2" in verdict.message
    assert rules(rises(0), unsolved(0.99)) == []
    # Without a success, its reward is unknown.
    assert rules(held) == []
    assert in_the_way(held, [rises(), held]) == "earned 1.000 a step without success"


def test_rollouts_that_all_earn_the_same_are_flat() -> None:
    plateau = unsolved(0.4, seed=3, gain=0.0, spread=0.0)
    plateau.best[:6] += 3
    plateau = replace(plateau, terms={"reach": row(0.0), "place": row(2.0)})
    (verdict,) = of_episodes([rises(0), plateau])
    assert (verdict.rule, verdict.seeds) == ("reward-flat", (3,))
    assert "seed 3 from step 7 on, at 0.400 a step; flat terms: reach" in verdict.message
    assert in_the_way(plateau, [rises(), plateau]) == "all rollouts earned the same from step 7 on"


def test_a_sparse_reward_is_named_in_the_flat_verdict() -> None:
    (verdict,) = of_episodes([unsolved(0.0, seed, gain=0.0, spread=0.0) for seed in (1, 2)])
    assert (verdict.rule, verdict.seeds) == ("reward-flat", (1, 2))
    assert "sparse" in verdict.message
    lucky = replace(rises(0), reward=row([0.0] * 14 + [1.0] * 6))
    lucky = replace(lucky, best=lucky.reward * 3, hold=row(0.0), worst=row(0.0))
    assert "sparse" in of_episodes([lucky, unsolved(0.0, gain=0.0, spread=0.0)])[0].message


def test_a_reward_is_stuck_if_nothing_beats_holding_still() -> None:
    still = unsolved(0.6, seed=4, gain=0.0)
    (verdict,) = of_episodes([rises(0), still])
    assert (verdict.rule, verdict.seeds) == ("reward-stuck", (4,))
    assert "--horizon" in verdict.message
    # In a task without success, staying at the highest reward is fine.
    assert rules(replace(still, evaluate={"speed": 1.0})) == []


def test_a_reward_is_stuck_even_if_holding_still_drops_the_object() -> None:
    slips = unsolved(0.6, seed=4, gain=0.0)
    slips = replace(slips, hold=slips.hold - 3, worst=slips.worst - 3)
    assert rules(rises(0), slips) == ["reward-stuck"]
    assert (
        in_the_way(slips, [rises(0), slips])
        == "no rollout earned more than the episode already did from step 2 on"
    )
    going_on = unsolved(np.linspace(0, 0.7, STEPS).tolist())
    assert rules(rises(0), replace(going_on, hold=going_on.hold - 3)) == []


def test_a_reward_that_falls_before_success_is_against_it() -> None:
    dip = rises(5)
    dip.reward[6:11] = [0.4, 0.2, 0.0, 0.1, 0.5]
    (verdict,) = of_episodes([dip, dip, rises(0)])
    assert (verdict.rule, verdict.seeds) == ("reward-against", (5, 5))
    assert rules(dip, dip) == [], "two episodes are too few for a verdict"
    assert "from 0.400 at step 6 to 0.000 at step 9, success at step 15" in verdict.message
    # The reward may fall after success.
    after = rises(5)
    after.reward[16:] = 0.0
    assert rules(after) == []
    assert rules(dip, rises(0), rises(1)) == []


def test_success_that_does_not_stay_is_lost() -> None:
    blinking = rises(6)
    blinking.success[16] = False
    (verdict,) = of_episodes([blinking, blinking, rises(0)])
    assert (verdict.rule, verdict.seeds) == ("success-lost", (6, 6))
    assert "at step 15 and lost success 2 steps later" in verdict.message
    assert rules(blinking, rises(0)) == []


def test_failing_early_pays_if_every_step_costs() -> None:
    ended = unsolved(-0.5, seed=8)
    ended.fail[-1] = True
    (verdict,) = of_episodes([ended, ended, unsolved(-0.5)])
    assert (verdict.rule, verdict.seeds) == ("failing-pays", (8, 8))
    assert in_the_way(ended, [ended]) == "failed at step 20"
    paid = replace(ended, reward=row(0.5))
    assert rules(paid, paid, paid) == []


def test_few_fails_or_fails_without_a_loss_do_not_pay() -> None:
    ended = unsolved(-0.5, seed=8)
    ended.fail[-1] = True
    assert rules(ended, ended, unsolved(-0.5), rises(0)) == [], "2 of 4 are not most"
    assert rules(*[unsolved(-0.5)] * 4) == []
    early = unsolved(-0.5)
    early.fail[3] = True
    assert in_the_way(early, [early]) == "failed at step 4"


def test_unsolved_episodes_are_compared_with_the_median_of_successes() -> None:
    paid = [
        replace(rises(seed), reward=rises().reward * np.float32(most))
        for seed, most in enumerate((0.5, 0.6, 1.0))
    ]
    for reward, expected in ((0.55, []), (0.65, ["reward-exploited"])):
        assert rules(*paid, unsolved(reward)) == expected
    # What counts is what an episode earns at its end.
    ends = [unsolved([0.0] * 10 + [each] * 10, seed=int(10 * each)) for each in (0.7, 0.9, 2.0)]
    (verdict,) = of_episodes([*paid, *ends])
    assert (
        verdict.seeds == (7, 9, 20)
        and "earned 0.900 a step" in verdict.message
        and "0.600 at success" in verdict.message
    )
    first = [replace(each, evaluate={"success": 0.0, "x": float(each.seed)}) for each in ends]
    assert "seed 7, evaluate() returned success 0, x 7" in of_episodes([*paid, *first])[0].message
    assert rules(*paid, unsolved([2.0] * 10 + [0.0] * 10)) == []


def test_an_episode_without_a_step_says_nothing() -> None:
    none = {
        name: getattr(unsolved(0.4), name)[:0]
        for name in ("reward", "success", "fail", "best", "hold", "worst")
    }
    assert rules(rises(0), replace(unsolved(0.4), **none)) == []


@pytest.mark.parametrize(("steps", "counted"), [(8, 4), (20, 10), (1, 1)])
def test_at_most_the_last_half_of_an_episode_is_its_end(steps: int, counted: int) -> None:
    reward = np.zeros(steps, np.float32)
    reward[-counted:] = 1.0
    best = 10 * reward
    one = PlannedEpisode(9, HORIZON, reward, reward < 0, reward < 0, best + 1, best, best - 1)
    assert rules(rises(0), one) == ["reward-exploited"]
    reward[-counted] = 0.9
    assert rules(rises(0), one) == []


def test_a_fall_counts_from_a_quarter_of_the_rise_on() -> None:
    def dips(depth: float, start: float = 0.0) -> PlannedEpisode:
        one = rises(5)
        one.reward[:] = start + (1 - start) * np.minimum(np.arange(STEPS) / 14, 1)
        one.reward[8] = one.reward[7] - depth
        return one

    for start, enough in ((0.0, 0.26), (-3.0, 1.05)):
        assert rules(*[dips(enough, start)] * 3) == ["reward-against"]
        assert rules(*[dips(enough - 0.1, start)] * 3) == []
    assert rules(*[dips(0.5)] * 2, rises(0), rises(1)) == [], "2 of 4 are not most"
    assert rules(*[dips(0.5)] * 3, rises(0), rises(1)) == ["reward-against"]


def test_success_that_is_lost_at_once_is_lost_after_one_step() -> None:
    blinking = rises(6)
    blinking.success[15] = False
    assert "lost success 1 step later" in of_episodes([blinking] * 3)[0].message


def test_progress_beyond_the_best_of_holding_still_and_the_step_before_is_not_stuck() -> None:
    """The best rollout of 10 steps earns 0.7 a step; holding still or the step before earn less, or as much."""

    def earning(hold: float, before: float) -> PlannedEpisode:
        one = unsolved(before, seed=4)
        return replace(one, best=row(7.0), hold=row(10 * hold), worst=row(10 * hold - 3))

    assert rules(rises(0), earning(0.6, 0.6)) == []
    for hold, before in ((0.7, 0.6), (0.6, 0.7), (0.7, 0.7)):
        assert rules(rises(0), earning(hold, before)) == ["reward-stuck"]
    late = earning(0.6, 0.6)
    late.hold[12:] = 7
    assert rules(rises(0), late) == [], "it must be stuck in all of its last steps"
    late.hold[8:] = 7
    (verdict,) = of_episodes([rises(0), late])
    assert "from step 9 on, at 0.600 a step" in verdict.message


def test_an_episode_that_timed_out_breaks_no_rule() -> None:
    for one in (unsolved(1.0), unsolved(0.4, gain=0.0, spread=0.0), unsolved(0.6, gain=0.0)):
        assert rules(rises(0), one) != []
        cut = replace(one, cut_off=True)
        assert rules(rises(0), cut) == []
        assert (
            in_the_way(cut, [rises(0), cut]) == "wall time limit reached after 20 steps (--seconds-per-seed)"
        )


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nan_and_infinite_rewards_raise_nothing(value: float) -> None:
    broken = unsolved(0.4)
    for each in (broken.reward, broken.best, broken.hold, broken.worst):
        each[:] = value
    of_episodes([rises(0), broken])
    assert in_the_way(broken, [rises(0), broken])

"""Sampling of candidate plans: bounds, interpolation, and improvement of the plan by each method."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from workbench.planning.options import Method, PlanOptions
from workbench.planning.sampling import Sampler

METHODS: tuple[Method, ...] = ("mppi", "predictive", "cem")
DEFAULTS = PlanOptions()
GRIPPER = torch.tensor([False, False, True])


def sampler_of(options: PlanOptions = DEFAULTS, steps: int = 10, seed: int = 0) -> Sampler:
    return Sampler(options, steps, GRIPPER, torch.ones(3), seed)


def improved(sampler: Sampler, rounds: int, target: torch.Tensor) -> torch.Tensor:
    """Return the plan's knots after `rounds` in which candidates closer to `target`, (A,), earn more."""
    for _ in range(rounds):
        knots = sampler.candidates(torch.zeros(3))
        sampler.improve(knots, -(sampler.sequences(knots) - target).square().sum((1, 2)))
    return sampler.plan


@given(
    knots=st.integers(2, 9),
    steps=st.integers(2, 40),
    shift=st.integers(0, 50),
    noise=st.floats(0.01, 10.0),
    method=st.sampled_from(METHODS),
)
def test_candidates_stay_within_bounds_during_an_episode(
    knots: int, steps: int, shift: int, noise: float, method: Method
) -> None:
    sampler = sampler_of(PlanOptions(method, rollouts=8, knots=knots, noise=noise), steps)
    for _ in range(3):
        drawn = sampler.candidates(torch.tensor([0.5, -1.0, 1.0]))
        sequences = sampler.sequences(drawn)
        assert sequences.shape == (8, steps, 3)
        assert sequences.abs().max() <= 1 + 1e-5
        sampler.improve(drawn, sequences.sum((1, 2)))
        sampler.shift(shift)


@given(knots=st.integers(2, 9), steps=st.integers(2, 40), value=st.floats(-1, 1), shift=st.integers(0, 50))
def test_constant_knots_give_a_constant_plan_before_and_after_a_shift(
    knots: int, steps: int, value: float, shift: int
) -> None:
    """The interpolation's weights must add up to 1."""
    sampler = sampler_of(PlanOptions(rollouts=4, knots=knots), steps)
    sampler.candidates(torch.full((3,), value))
    sampler.shift(shift)
    torch.testing.assert_close(sampler.sequences(sampler.plan[None]), torch.full((1, steps, 3), value))


def test_a_shift_moves_the_plan_forward() -> None:
    sampler = sampler_of(PlanOptions(rollouts=8, knots=4), steps=10)
    improved(sampler, 2, torch.tensor([0.3, -0.8, 1.0]))
    before = sampler.sequences(sampler.plan[None])[0]
    sampler.shift(3)  # the distance between two knots
    after = sampler.sequences(sampler.plan[None])[0]
    torch.testing.assert_close(after[:7, :2], before[3:, :2])


def test_a_shift_restores_the_initial_spread_of_candidates() -> None:
    sampler = sampler_of(PlanOptions("cem", rollouts=300, knots=4), steps=10)

    def width() -> torch.Tensor:
        return sampler.candidates(torch.zeros(3))[1::6, :, :2].std()

    first = width()
    improved(sampler, 8, torch.tensor([0.0, 0.0, 1.0]))
    narrow = width()
    sampler.shift(1)
    assert narrow < 0.6 * first and width() > 0.9 * first


def test_a_gripper_switches_while_an_arm_interpolates() -> None:
    sampler = sampler_of(PlanOptions(rollouts=4, knots=2), steps=5)
    line = torch.tensor([[[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]])
    sampler.candidates(torch.zeros(3))
    sequence = sampler.sequences(line)[0]
    torch.testing.assert_close(sequence[:, 0], torch.linspace(-1, 1, 5))
    assert sequence[:, 2].tolist() == [-1, -1, -1, -1, 1]
    drawn = sampler.candidates(torch.tensor([0.0, 0.0, 0.25]))
    assert set(drawn[2:, :, 2].flatten().tolist()) <= {-1.0, 0.0, 1.0}


@pytest.mark.parametrize("method", METHODS)
def test_each_method_improves_the_plan(method: Method) -> None:
    target = torch.tensor([0.6, -0.4, 1.0])
    sampler = sampler_of(PlanOptions(method, rollouts=64))
    plan = improved(sampler, 30, target)
    assert (plan[:, :2] - target[:2]).abs().max() < 0.3
    assert plan[:, 2].min() > 0.5


@pytest.mark.parametrize("method", METHODS)
def test_a_nan_or_infinite_return_ranks_worst(method: Method) -> None:
    sampler = sampler_of(PlanOptions(method, rollouts=8))
    knots = sampler.candidates(torch.zeros(3))
    returns = torch.tensor(
        [torch.nan, torch.inf, -torch.inf, torch.nan, 1.0, torch.nan, torch.nan, torch.nan]
    )
    sampler.improve(knots, returns)
    torch.testing.assert_close(sampler.plan, knots[4])
    before = sampler.plan.clone()
    sampler.improve(sampler.candidates(torch.zeros(3)), torch.full((8,), torch.nan))
    assert torch.equal(sampler.plan, before)


def test_the_plan_and_holding_still_are_always_among_the_candidates() -> None:
    sampler = sampler_of(PlanOptions(rollouts=8))
    hold = torch.tensor([0.1, 0.2, -1.0])
    plan = improved(sampler, 2, torch.tensor([0.3, -0.8, 1.0])).clone()
    knots = sampler.candidates(hold)
    assert torch.equal(knots[0], plan)
    assert torch.equal(knots[1], hold.expand(4, 3))


def test_holding_still_keeps_the_gripper_closed() -> None:
    sampler = sampler_of()
    improved(sampler, 20, torch.tensor([0.3, -0.8, -1.0]))
    assert sampler.plan[0, 2] == -1
    sampler.shift(1)
    # The env's hold action keeps the gripper at the object's width, which would exert no force.
    assert sampler.candidates(torch.tensor([0.0, 0.0, 0.2]))[1].tolist() == [[0.0, 0.0, -1.0]] * 4


def test_dimensions_that_earn_nothing_hardly_move() -> None:
    plans = []
    for seed in range(8):
        sampler = sampler_of(seed=seed)
        for _ in range(20):
            knots = sampler.candidates(torch.zeros(3))
            sampler.improve(knots, -(sampler.sequences(knots)[..., 0] - 0.6).square().sum(1))
        plans.append(sampler.plan)
    needed, idle = torch.stack(plans).unbind(2)[:2]
    assert (needed - 0.6).abs().mean() < 0.2
    assert idle.abs().mean() < 0.12


@pytest.mark.parametrize("method", METHODS)
def test_a_gripper_of_the_plan_is_open_or_closed(method: Method) -> None:
    sampler = sampler_of(PlanOptions(method, rollouts=32))
    for _ in range(5):
        knots = sampler.candidates(torch.tensor([0.0, 0.0, 1.0]))
        sampler.improve(knots, torch.randn(32, generator=torch.Generator().manual_seed(3)))
        if method != "cem":
            assert set(sampler.plan[:, 2].tolist()) <= {-1.0, 1.0}


def test_draws_depend_only_on_the_seed() -> None:
    one, same, other = sampler_of(seed=3), sampler_of(seed=3), sampler_of(seed=4)
    torch.manual_seed(0)
    drawn = one.candidates(torch.zeros(3))
    torch.manual_seed(1)
    assert torch.equal(drawn, same.candidates(torch.zeros(3)))
    assert not torch.equal(drawn, other.candidates(torch.zeros(3)))


def moved_plan(sampler: Sampler, to: list[float]) -> torch.Tensor:
    """Make this action, (A,), the plan at all knots."""
    knots = sampler.candidates(torch.zeros(3))
    knots[0] = torch.tensor(to)
    sampler.improve(knots, torch.eye(len(knots))[0])
    return sampler.plan


def test_candidates_are_spread_around_the_plan_and_some_around_holding_still() -> None:
    options = PlanOptions("predictive", rollouts=600, noise=0.02)
    sampler = Sampler(options, 10, GRIPPER, torch.tensor([1.0, 0.25, 1.0]), 0)
    moved_plan(sampler, [0.5, -0.5, 1.0])
    knots = sampler.candidates(torch.tensor([0.1, 0.2, 0.0]))[4:, :, :2]
    numbers = torch.arange(4, 600)
    hold, plan = torch.tensor([0.1, 0.2]), torch.tensor([0.5, -0.5])
    for chosen, centre in ((numbers % 6 == 0, hold), (numbers % 6 != 0, plan)):
        assert (knots[chosen] - centre).abs().max() < 0.15
    alike, small, usual = (knots[numbers % 6 == k] - plan for k in (3, 5, 4))
    # Some move the same way at all knots, in some of the dimensions; some move less; the others at each knot anew.
    assert (alike == alike[:, :1]).all() and not (usual == usual[:, :1]).all()
    unmoved = (alike == 0).all(1)
    assert 0.3 < unmoved.float().mean() < 0.7 and not (usual == 0).any()
    assert (usual.std((0, 1)) / torch.tensor([0.02, 0.005])).sub(1).abs().max() < 0.15
    assert (small.std((0, 1)) / usual.std((0, 1))).max() < 0.5


def test_a_gripper_is_switched_in_half_of_the_candidates_only() -> None:
    sampler = sampler_of(PlanOptions("predictive", rollouts=600))
    moved_plan(sampler, [0.0, 0.0, -1.0])
    gripper = sampler.candidates(torch.zeros(3))[4:, :, 2]
    switched = (gripper == 1).any(1).float().mean()
    assert set(gripper.unique().tolist()) == {-1.0, 1.0} and 0.1 < switched < 0.28


def test_the_two_best_candidates_are_tried_again_at_their_new_times() -> None:
    sampler = sampler_of(PlanOptions("mppi", rollouts=8, knots=4), steps=4)
    knots = sampler.candidates(torch.zeros(3))
    sampler.improve(knots, torch.tensor([0.0, 1, 2, 9, 3, 8, 5, 6]))
    again = sampler.candidates(torch.zeros(3))
    # The penalty on motion may exchange close ones, so the best are far ahead.
    kept = {tuple(each.flatten().tolist()) for each in again[2:4]}
    assert kept == {tuple(each.flatten().tolist()) for each in knots[[3, 5]]}
    sampler.shift(1)  # a knot a step
    moved = sampler.candidates(torch.zeros(3))[2:4]
    torch.testing.assert_close(moved[:, :3], again[2:4][:, 1:])


def test_holding_still_keeps_what_the_gripper_did_last() -> None:
    for steps, last in ((1, -1.0), (2, 1.0), (9, 1.0)):
        sampler = sampler_of(PlanOptions("predictive", rollouts=8, knots=4), steps=4)
        knots = sampler.candidates(torch.zeros(3))
        knots[0, :, 2] = torch.tensor([-1.0, 1.0, 1.0, 1.0])
        sampler.improve(knots, torch.eye(8)[0])
        sampler.shift(steps)
        assert sampler.candidates(torch.zeros(3))[1, :, 2].tolist() == [last] * 4


@pytest.mark.parametrize("method", METHODS)
def test_the_plan_is_made_of_the_candidates_that_earned_most(method: Method) -> None:
    options = PlanOptions(method, rollouts=20, elites=0.1, temperature=1e-6)
    sampler = sampler_of(options)
    knots = sampler.candidates(torch.zeros(3))
    returns = torch.linspace(0, 1, 20)
    returns[[7, 11]] = torch.tensor([1000.0, 50.0])
    returns[15] = torch.nan
    sampler.improve(knots, returns)
    expected = knots[[7, 11]].mean(0) if method == "cem" else knots[7]
    torch.testing.assert_close(sampler.plan, expected)


def test_motion_away_from_holding_still_has_to_pay() -> None:
    hold, plans = torch.tensor([0.5, -0.5, 1.0]), []
    for seed in range(8):
        sampler = sampler_of(PlanOptions("mppi", rollouts=64), seed=seed)
        for turn in range(20):
            noise = torch.rand(64, generator=torch.Generator().manual_seed(20 * seed + turn))
            sampler.improve(sampler.candidates(hold), noise)
        plans.append(sampler.plan)
    assert (torch.cat(plans).mean(0) - hold)[:2].abs().max() < 0.15


def test_seeds_are_drawn_from_the_plans_own_generator() -> None:
    one, same = sampler_of(seed=3), sampler_of(seed=3)
    drawn = [one.draw_seed() for _ in range(3)]
    torch.manual_seed(1)
    assert drawn == [same.draw_seed() for _ in range(3)] and len(set(drawn)) == 3


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"method": "guess"}, "mppi, predictive, cem"),
        ({"elites": 2.0}, "at most 1"),
    ],
)
def test_an_unknown_method_and_more_than_all_elites_are_refused(wrong: dict, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        PlanOptions(**wrong)

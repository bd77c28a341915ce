"""Rules about entries, rewards and observations, on episodes that all differ: what is counted, and where it was first."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.checks.checked import the_finding
from tests.checks.given import SEEDS, Judged, episodes, flags
from workbench.checks.evidence.odd_states import KINDS, SHORT, OddStates

pytestmark = pytest.mark.thorough


def nan_at(*places: tuple[int, ...], shape: tuple[int, ...] = (5, 3), value: float = np.nan) -> Any:
    """Numbers (T, K, ...) that differ everywhere, with `value` at these (step, episode)."""
    numbers = np.arange(np.prod(shape), dtype=np.float64).reshape(shape) / 100
    for place in places:
        numbers[place] = value
    return numbers


# --- entries of evaluate() -------------------------------------------------------------------------------


def test_success_after_a_reset_counts_the_seeds_that_have_it(judged: Judged) -> None:
    finding = the_finding(judged("success-at-reset", starts=episodes(success="0 1 1")))
    assert (finding.count, finding.degree) == (2, "stop") and finding.code.startswith('"success"')
    assert "2 of 3 seeds (seed 21, 22)" in finding.message
    rows = np.array([[[0, 0], [0, 1], [0, 0]]])
    assert "(seed 21)" in the_finding(judged("success-at-reset", starts=episodes(success=rows))).message
    assert judged("success-at-reset", starts=episodes(success="01 01 01")).state == "kept"


def test_each_kind_of_episodes_counts_its_own_successes(judged: Judged) -> None:
    starts, random = episodes(success="0 0 0"), episodes(success="00000 00110 00000")
    acted = (episodes(kind="given", seeds=[7, 8], success="0111 0100"),)
    result = judged("success-stays-possible", starts=starts, random=random, acted=acted)
    assert result.notes == ("success in 1 of 3 random episodes", "success in 2 of 2 given episodes")
    for mode, state in (("sparse", "broken"), ("dense", "not_applicable")):
        assert judged("success-stays-possible", mode=mode, starts=episodes(far="0 0 0")).state == state
    lacks = judged("success-stays-possible", mode="sparse", starts=episodes(far="0 0 0"))
    assert the_finding(lacks).code.startswith("def evaluate")
    fails_only = judged("success-stays-possible", mode="sparse", starts=episodes(fail="0 0 0"))
    assert (fails_only.state, fails_only.notes) == ("kept", ())


def test_only_a_name_that_is_missing_is_taken_for_misspelt(judged: Judged) -> None:
    numbers = np.zeros((1, 3))
    found = judged("entry-name", starts=episodes(succes=numbers, Fail=numbers, suction=numbers))
    assert [finding.message.split("'")[1::2] for finding in found.findings] == [
        ["succes", "success"],
        ["Fail", "fail"],
    ]
    assert judged("entry-name", starts=episodes(succes=numbers, success=numbers)).state == "kept"


def test_success_and_fail_together_are_counted_in_states(judged: Judged) -> None:
    random = episodes(success="0011 0000 0010", fail="0001 1111 0010")
    finding = the_finding(judged("success-and-fail", random=random))
    assert finding.count == 2 and "2 of 3 random episodes, first at step 2 of seed 22" in finding.message
    apart = episodes(success="0011 0000 0000", fail="0000 1111 0000")
    given = episodes(kind="given", seeds=[7], success="01", fail="01")
    finding = the_finding(judged("success-and-fail", random=apart, acted=(given,)))
    assert "1 of 1 given episode, first at step 1 of seed 7" in finding.message
    assert judged("success-and-fail", random=apart).state == "kept"
    for success, fail in (("0000", "1111"), ("1111", "0000")):
        never = episodes(success=f"{success} 0000 {success}", fail=f"0000 {fail} 0000")
        assert judged("success-and-fail", random=never).state == "not_known"


def test_success_flickers_where_it_is_gone_at_the_next_step(judged: Judged) -> None:
    # At the reset success only stays, and at the last step nothing is known of the next one.
    random = episodes(success="0100110 0010100 1000001")
    finding = the_finding(judged("success-flickers", random=random))
    assert finding.count == 3 and "3 of 4 times in random episodes" in finding.message
    late = judged("success-flickers", random=episodes(success="0001 0001 0001"))
    at_reset = judged("success-flickers", random=episodes(success="1110 1111 1000"))
    never = judged("success-flickers", random=episodes(success="0000 0000 0000"))
    assert {each.state for each in (late, at_reset, never)} == {"not_known"}
    assert len({each.why for each in (late, at_reset, never)}) == 3


def test_each_entry_that_is_not_finite_is_found_once_with_its_first_step(judged: Judged) -> None:
    bad = nan_at((2, 1), (3, 1), (4, 2))
    wide = nan_at((1, 2, 1), shape=(5, 3, 2), value=np.inf)
    random = episodes(cube_to_goal=bad, wide=nan_at(shape=(5, 3, 2)), success="00000 00000 00000")
    given = episodes(kind="given", cube_to_goal=bad * np.nan, wide=wide)
    result = judged("entries-finite", random=random, acted=(given,))
    first, second = result.findings
    assert (first.count, second.count) == (3, 1) and first.code.startswith('"cube_to_goal"')
    assert "2 of 3 random episodes, first at step 2 of seed 21" in first.message
    assert "1 of 3 given episodes, first at step 1 of seed 22" in second.message
    flags_only = judged("entries-finite", random=episodes(success="00 00 00"))
    assert flags_only.state == "not_applicable"


# --- observations ----------------------------------------------------------------------------------------


def leaves(**odd: Any) -> dict[str, Any]:
    """Observations that are finite, small and always different, except the given ones."""
    plain = {name: nan_at(shape=(5, 3, 2)) for name in ("agent/qpos", "extra/goal_pos", "extra/tcp_pose")}
    return plain | {name.replace("_of_", "/", 1): value for name, value in odd.items()}


def test_an_observation_that_is_not_finite_is_found_with_its_first_state(judged: Judged) -> None:
    bad = nan_at((3, 0, 1), (1, 2, 0), shape=(5, 3, 2), value=-np.inf)
    finding = the_finding(judged("observation-finite", random=episodes(obs=leaves(extra_of_goal_pos=bad))))
    assert finding.count == 2 and "2 of 3 episodes, first at step 1 of seed 22" in finding.message
    assert finding.code.startswith('"goal_pos"') and "'extra/goal_pos'" in finding.message
    sound, row = nan_at(shape=(3, 2)), nan_at((1, 0), shape=(3, 2))
    odd = OddStates(
        [SEEDS, [30, 31, 32]], [*KINDS[:2]], obs=[{"extra/tcp_pose": sound}, {"extra/tcp_pose": row}]
    )
    finding = the_finding(judged("observation-finite", odd, random=episodes(obs=leaves())))
    assert f"{KINDS[1]} (seed 31)" in finding.message and finding.code.startswith('"tcp_pose"')


def test_only_a_number_that_is_the_same_in_all_states_is_constant(judged: Judged) -> None:
    same = np.broadcast_to([0.2, 0.5], (5, 3, 2))
    late = same.copy()
    late[4, 2, 1] = 0.6
    obs = leaves(
        extra_of_goal_pos=same,
        extra_of_tcp_pose=late,
        extra_of_flag=np.ones((5, 3, 1)),
        agent_of_palm=same,
        extra_of_seldom=same,
        extra_of_lost=same * np.nan,
    )
    odd = OddStates([SEEDS], [KINDS[0]], obs=[{"extra/goal_pos": same[0], "extra/seldom": late[4]}])
    result = judged("observation-constant", odd, random=episodes(obs=obs))
    finding = the_finding(result)
    assert "'extra/goal_pos'" in finding.message and "(0.2, 0.5) in all of 18 states" in finding.message
    assert [note.split("'")[1] for note in result.notes] == ["extra/flag", "agent/palm"]
    with_one_seed = judged("observation-constant", odd, random=episodes(obs=obs), seeds=[20])
    assert with_one_seed.state == "not_known"


def test_huge_observations_are_counted_with_the_largest(judged: Judged) -> None:
    huge = leaves()["extra/goal_pos"].copy()
    huge[3, 2, 0], huge[1, 1, 1], huge[2, 0, 0], huge[4, 0, 0] = -2500, 1001, 1000, np.inf
    finding = the_finding(judged("observation-huge", random=episodes(obs=leaves(extra_of_goal_pos=huge))))
    assert finding.count == 2 and "up to 2500, first at step 1 of seed 21" in finding.message
    assert finding.code.startswith('"goal_pos"')


# --- rewards ---------------------------------------------------------------------------------------------

QUIET = [[0.1, 0.2, 0.3], [0.2, 0.3, 0.4], [0.3, 0.4, 0.5], [0.4, 0.5, 0.6]]
NEVER = "00000 00000 00000"


def rewards(*changed: tuple[int, int, float]) -> list[list[float]]:
    """`QUIET` with these (row, episode, reward); row 0 is step 1."""
    made = [list(row) for row in QUIET]
    for row, episode, reward in changed:
        made[row][episode] = reward
    return made


def odd(reward: Any, success: str = "000 000", mode: str = "normalized_dense", **more: Any) -> OddStates:
    """Two kinds of odd states of all seeds; `success` has a word for each kind."""
    entries = [{"success": row} for row in flags(success).T]
    return OddStates(
        [SEEDS] * 2, [*KINDS[:2]], entries, {mode: [np.array(row, np.float64) for row in reward]}, **more
    )


PLAIN = odd([[0.1, 0.2, 0.3], [0.2, 0.3, 0.4]])


def test_a_reward_that_is_not_finite_is_found_at_its_step(judged: Judged) -> None:
    bad = episodes(rewards((2, 0, np.inf), (1, 2, np.nan), (3, 2, np.nan)))
    finding = the_finding(judged("reward-finite", random=bad))
    assert (
        finding.count == 3 and "nan in 2 of 3 random episodes, first at step 2 of seed 22" in finding.message
    )
    given = episodes([[-np.inf]], kind="given", seeds=[7])
    finding = the_finding(judged("reward-finite", random=episodes(QUIET), acted=(given,)))
    assert "-inf in 1 of 1 given episode, first at step 1 of seed 7" in finding.message
    put = odd([[0.1, 0.2, 0.3], [0.2, np.nan, np.nan]])
    finding = the_finding(judged("reward-finite", put, random=episodes(QUIET)))
    assert finding.count == 2 and "2 of 6 states" in finding.message
    assert f"{KINDS[1]} (seed 21)" in finding.message
    assert judged("reward-finite", PLAIN, random=episodes(QUIET)).state == "kept"


def test_a_reward_that_changes_in_one_episode_only_changes(judged: Judged) -> None:
    still = np.full((4, 3), 0.5)
    assert the_finding(judged("reward-changes", random=episodes(still))).code.startswith("def compute_dense")
    still[2, 2] = 0.5001
    assert judged("reward-changes", random=episodes(still)).state == "kept"
    assert judged("reward-changes", mode="sparse", random=episodes(still)).state == "not_applicable"


@pytest.mark.parametrize("reward", [1.5, -1.5])
def test_a_reward_out_of_range_in_one_step_is_found(judged: Judged, reward: float) -> None:
    starts = episodes(success="0 0 0")
    random = episodes(rewards((1, 2, reward), (3, 0, np.nan)), success="00000 00010 00000")
    finding = the_finding(judged("reward-normalized", random=random, starts=starts))
    assert finding.count == 1 and f"{min(0.1, reward):g} to {max(0.6, reward):g}" in finding.message
    assert finding.function == "compute_normalized_dense_reward"
    inside = episodes(rewards((1, 2, np.sign(reward) * 1.00005)), success="00000 00010 00000")
    assert judged("reward-normalized", PLAIN, random=inside, starts=starts).state == "kept"
    # Where nothing succeeds, the largest reward is not known; where a body was put at a goal, it is.
    unsolved = episodes(QUIET, success=NEVER)
    assert judged("reward-normalized", PLAIN, random=unsolved, starts=starts).state == "not_known"
    put = odd([[0.1, 0.2, 0.3], [0.2, reward, 1.9]], "000 010")
    finding = the_finding(judged("reward-normalized", put, random=unsolved, starts=starts))
    assert finding.count == 1 and f"{reward:g} to {reward:g}" in finding.message
    paid = odd(PLAIN.reward["normalized_dense"], reward_if_success={"normalized_dense": [np.full(3, reward)]})
    assert judged("reward-normalized", paid, random=unsolved, starts=starts).state == "broken"
    assert judged("reward-normalized", mode="dense", random=random, starts=starts).state == "not_applicable"


def test_success_is_compared_with_its_own_episode(judged: Judged) -> None:
    # Seed 20 earns more before its success, seed 21 less; seed 22 never succeeds.
    random = episodes(
        rewards((0, 0, 0.9), (3, 0, 0.5), (2, 1, 0.8), (3, 1, 0.2), (1, 2, 1.0)), success="00001 00010 00000"
    )
    finding = the_finding(judged("reward-order", PLAIN, random=random))
    assert finding.count == 1 and "at most 0.5 at success and 0.9" in finding.message
    assert "step 1 of seed 20), in 1 of 2 episodes" in finding.message
    # A difference below a twentieth of all rewards seen is not clear.
    near = episodes(rewards((0, 0, 0.52), (3, 0, 0.5), (1, 2, 1.0)), success="00001 00000 00000")
    assert judged("reward-order", PLAIN, random=near).state == "kept"
    unsolved = episodes(QUIET, success=NEVER)
    assert judged("reward-order", PLAIN, random=unsolved).state == "not_known"
    given = episodes([[0.9, 0.5], [0.1, 0.1]], kind="given", seeds=[7, 8], success="001 001")
    finding = the_finding(judged("reward-order", PLAIN, random=unsolved, acted=(given,)))
    assert "step 1 of seed 7 with given actions), in 2 of 2 episodes" in finding.message
    # Of the odd states, only those between a reset and a success show what is paid nearby.
    put = odd([[0.1, 0.2, 0.4], [0.2, 0.3, 0.7]], "001 000")
    near = replace(put, kinds=[KINDS[1], SHORT])
    finding = the_finding(judged("reward-order", near, random=unsolved))
    assert (
        f"0.4 at success and 0.7 elsewhere in the same episode ({SHORT}, seed 22), in 1 of 1 "
        in finding.message
    )
    assert judged("reward-order", put, random=unsolved).state == "not_known"


def test_what_success_would_pay_is_compared_with_the_most_without_it(judged: Judged) -> None:
    paid = odd(
        [[0.1, 0.2, 0.3], [0.2, 0.95, 0.4]],
        reward_if_success={"normalized_dense": [np.full(3, 0.3), np.full(3, 0.3)]},
    )
    finding = the_finding(judged("reward-order", paid, random=episodes(QUIET, success=NEVER)))
    assert (
        finding.message.startswith("The reward is 0.3 ")
        and f"0.95 without success ({KINDS[1]}, seed 21)" in finding.message
    )
    most = odd(PLAIN.reward["normalized_dense"], reward_if_success={"normalized_dense": [np.full(3, 1.0)]})
    assert judged("reward-order", most, random=episodes(QUIET, success=NEVER)).state == "not_known"
    varies = odd(
        PLAIN.reward["normalized_dense"], reward_if_success={"normalized_dense": [np.array([0, 0.1, 0])]}
    )
    assert judged("reward-order", varies, random=episodes(QUIET, success=NEVER)).state == "not_known"


def test_a_full_reward_without_success_is_counted_in_all_states(judged: Judged) -> None:
    random = episodes(rewards((2, 1, 0.9995), (3, 1, 1.0), (3, 2, 1.0)), success="00000 00001 00001")
    put = odd([[0.1, 1.0, 0.3], [0.2, 0.3, 1.0]], "000 001")
    finding = the_finding(judged("reward-needs-success", put, random=random))
    assert finding.count == 2 and "(step 3 of seed 21)" in finding.message
    only_odd = the_finding(judged("reward-needs-success", put, random=episodes(QUIET, success=NEVER)))
    assert f"({KINDS[0]}, seed 21)" in only_odd.message
    solved = episodes(rewards((3, 1, 1.0)), success="00000 00001 00000")
    assert judged("reward-needs-success", PLAIN, random=solved).state == "kept"
    beyond = episodes(rewards((3, 1, 1.2)), success="00000 00001 00000")
    assert judged("reward-needs-success", PLAIN, random=beyond).state == "not_known"
    assert judged("reward-needs-success", PLAIN, mode="dense", random=solved).state == "not_applicable"


def test_one_constant_relates_the_normalized_reward_to_the_dense_one(judged: Judged) -> None:
    dense = [np.array([1.0, 2.0, 3.0]), np.array([0.001, -4.0, np.nan])]

    def related(normalized: list[np.ndarray]) -> Any:
        return judged("reward-ratio", OddStates(reward={"dense": dense, "normalized_dense": normalized}))

    assert related([row / 4 for row in dense]).state == "kept"
    wrong = [row / 4 for row in dense]
    wrong[1] = wrong[1] * [1, 0.5, 1]
    finding = the_finding(related(wrong))
    assert (
        finding.count == 1 and "-0.5 where the dense reward is -4, and 0.25 where it is 1" in finding.message
    )
    result = related([row / 4 + 0.5 for row in dense])
    assert result.state == "kept" and "0.25 plus 0.5" in result.notes[0]
    assert related([-row / 4 + 0.5 for row in dense]).state == "broken"
    lost = OddStates(reward={"dense": dense})
    assert judged("reward-ratio", lost).state == "not_applicable"
    nothing = OddStates(reward={mode: [np.zeros(3)] for mode in ("dense", "normalized_dense")})
    assert judged("reward-ratio", nothing).state == "not_known"

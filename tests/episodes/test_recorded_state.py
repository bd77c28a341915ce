"""Distance and equality of two recorded states."""

from __future__ import annotations

import numpy as np
import pytest

from workbench.episodes.recorded_state import same_state, state_distance


def test_the_distance_of_states_is_that_of_the_furthest_body_and_joint() -> None:
    cube, arm = np.zeros(13, np.float32), np.zeros(13 + 4, np.float32)
    cube[3] = arm[3] = 1
    was = {"actors/cube": cube, "articulations/arm": arm}
    now = {name: state.copy() for name, state in was.items()}
    assert state_distance(now, was) == (0, 0)
    now["actors/cube"][1] = 0.25
    now["articulations/arm"][14] = -0.5
    now["articulations/arm"][16] = 9  # a velocity
    assert state_distance(now, was) == pytest.approx((0.25, 0.5))


@pytest.mark.parametrize("count", [12, 13, 20])
def test_a_controllers_state_is_not_taken_for_a_pose(count: int) -> None:
    name = "controller/arm"
    assert state_distance({name: np.ones(count)}, {name: np.zeros(count)}) == (0, 0)


def test_a_state_with_nan_is_the_same_as_itself_and_every_velocity_counts() -> None:
    was = {"actors/cube": np.arange(13, dtype=np.float32), "actors/gone": np.full(13, np.nan, np.float32)}
    now = {name: state.copy() for name, state in was.items()}
    assert same_state(now, was)
    now["actors/cube"][12] += 1e-6
    assert not same_state(now, was)

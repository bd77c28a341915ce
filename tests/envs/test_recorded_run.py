"""A recorded run cut at a state, the distance between poses, and the keywords that make an env again."""

# pyright: reportArgumentType=false

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import sapien

from workbench.envs.recorded_run import RecordedRun, env_kwargs, pose_distances, states_of

STEPS = 5


def a_run() -> RecordedRun:
    states, steps = np.arange(STEPS + 1.0), np.arange(STEPS, dtype=np.float32)
    return RecordedRun(
        "run", 3, {}, steps[:, None], {"actors/cube": states[:, None]}, {"height": states}, 10 * steps
    )


@pytest.mark.parametrize("state", [0, 2, STEPS])
def test_a_run_is_cut_after_the_action_that_led_to_the_state(state: int) -> None:
    cut = a_run().until(state)
    assert cut.length == state and cut.action.ravel().tolist() == [*range(state)]
    assert cut.reward.tolist() == [10.0 * t for t in range(state)]
    assert cut.evaluate["height"].tolist() == [*range(state + 1)]
    assert cut.state(state)["actors/cube"].tolist() == [state] and cut.state(state + 1) == {}
    assert cut.name == "run" and cut.seed == 3


def test_distances_between_poses_are_metres_and_radians() -> None:
    turned = sapien.Pose([3, 4, 0], [np.cos(0.25), 0, np.sin(0.25), 0])
    one = np.array([0, 0, 0, 1, 0, 0, 0], np.float32)
    other = np.array([*turned.p, *turned.q], np.float32)
    lost = np.full(7, np.nan)
    minus = np.concatenate([one[:3], -one[3:]])
    metres, radians = pose_distances(
        np.stack([one, one, one, lost, lost]), np.stack([other, minus, lost, one, lost])
    )
    np.testing.assert_allclose(metres, [5, 0, np.inf, np.inf, 0])
    np.testing.assert_allclose(radians, [0.5, 0, np.inf, np.inf, 0], atol=1e-6)


def test_states_are_those_of_the_env_without_what_it_lacks() -> None:
    columns = {
        "state/actors/cube": np.array([[1.0, 2.0], [3.0, np.nan]]),
        "state/actors/rare": np.array([[5.0, 6.0], [np.nan, np.nan]]),
        "obs/agent/qpos": np.zeros((2, 2)),
    }
    assert {name: row.tolist()[0] for name, row in states_of(columns, 0).items()} == {
        "actors/cube": 1.0,
        "actors/rare": 5.0,
    }
    assert {name: row.tolist()[0] for name, row in states_of(columns, 1).items()} == {"actors/cube": 3.0}


def test_keywords_that_make_the_env_again_are_its_modes_and_what_json_holds() -> None:
    env = SimpleNamespace(obs_mode="state", reward_mode="dense", control_mode="pd_joint_pos", agent=object())
    given = {"size": 2, "obs_mode": "rgb", "num_envs": 8, "render_backend": "cpu", "robot_uids": ("a", "b")}
    made = {
        "size": 2,
        "robot_uids": ("a", "b"),
        "obs_mode": "state",
        "reward_mode": "dense",
        "control_mode": "pd_joint_pos",
    }
    assert env_kwargs(env, {**given, "helper": object(), "sizes": {1: 2}}) == made
    env.control_mode = {"left": "pd_joint_pos", "right": "pd_joint_vel"}
    del made["control_mode"]
    assert env_kwargs(env, given) == made
    env.control_mode = {"left": "pd_joint_pos", "right": "pd_joint_pos"}
    assert env_kwargs(env, given) == {**made, "control_mode": "pd_joint_pos"}

"""Recorded episodes replayed in running envs, compared with the recording."""

# pyright: reportOptionalSubscript=false, reportAttributeAccessIssue=false

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.live.recorded_runs import Recorded, opened, reaching, record
from workbench.envs.evaluate_entries import flat_entries
from workbench.envs.recorded_run import RecordedRun
from workbench.episodes.recorded_state import read_states, state_distance, state_mismatches, write_states
from workbench.episodes.replay import ReplayResult, begin_run, replay_text, replay_to, restore_recorded
from workbench.task.open import OpenedTask
from workbench.task.problem import TaskError

pytestmark = pytest.mark.thorough

N, STEPS = 3, 44
TASKS = Path(__file__).parents[2] / "tasks"


@pytest.fixture(scope="module", params=["PickCube-v1", str(TASKS / "push_cube.py")], ids=["pick", "push"])
def task(request: pytest.FixtureRequest) -> Iterator[OpenedTask]:
    task = opened(request.param, N)
    yield task
    task.env.close()


@pytest.fixture(scope="module")
def recorded(task: OpenedTask) -> Recorded:
    return record(task, STEPS, [31, 7, 5], reaching(STEPS, N))


@pytest.mark.parametrize("state", [0, 1, 17, STEPS - 3])
def test_an_env_continues_from_an_entered_state_as_recorded_bit_for_bit(
    task: OpenedTask, recorded: Recorded, state: int
) -> None:
    run, env = recorded.run(1), 1
    step, replay_result = replay_to(task, run, state, [env])
    assert (replay_result.way, replay_result.metres, replay_result.radians) == ("re-simulated", 0, 0)
    assert replay_result.missed == {} and not replay_result.start_differs
    assert step.elapsed_steps[env] == state and task.env.episode_seeds[env] == 7
    for name, values in recorded.steps[state].evaluate.items():
        # Reward terms belong to an action, and no action was taken.
        assert name.startswith("reward_terms/") or np.array_equal(step.evaluate[name][env], values[env]), name
    for t in range(state, STEPS):
        step = task.env.step(recorded.steps[t + 1].action)
        for name, rows in read_states(task.env.env).items():
            assert np.array_equal(rows[env], recorded.states[t + 1][name][env]), (name, t)
        assert step.reward[env] == recorded.steps[t + 1].reward[env]


def test_the_other_envs_continue_undisturbed(task: OpenedTask, recorded: Recorded) -> None:
    def run(steps: int, disturb: bool) -> list[dict[str, np.ndarray]]:
        rng, states = np.random.default_rng(3), []
        record(task, 25, [1, 2, 3], reaching(25, N))
        if disturb:
            replay_to(task, recorded.run(1), 20, [1])
        for _ in range(steps):
            task.env.step(rng.uniform(-0.4, 0.4, (N, 8)).astype(np.float32))
            states.append(read_states(task.env.env))
        return states

    plain, disturbed = run(12, False), run(12, True)
    for a, b in zip(plain, disturbed, strict=True):
        for name in a:
            assert np.array_equal(a[name][[0, 2]], b[name][[0, 2]]), name
    assert not np.array_equal(plain[0]["articulations/panda"][1], disturbed[0]["articulations/panda"][1])


def test_all_envs_can_enter_one_state_and_continue_equally(task: OpenedTask, recorded: Recorded) -> None:
    _, replay_result = replay_to(task, recorded.run(2), 30, range(N))
    assert replay_result.metres == 0
    for t in range(30, STEPS):
        action = np.broadcast_to(recorded.steps[t + 1].action[2], (N, 8)).astype(np.float32)
        task.env.step(action)
    for name, rows in read_states(task.env.env).items():
        for env in range(N):
            assert np.array_equal(rows[env], recorded.states[STEPS][name][2])


def test_an_episode_that_began_with_a_reset_of_all_envs_starts_equally(task: OpenedTask) -> None:
    # The seed alone is not enough: random numbers were drawn for all three envs at once.
    recorded = record(task, STEPS, None, reaching(STEPS, N))
    _, replay_result = replay_to(task, recorded.run(2), 20, [0])
    assert replay_result.start_differs and replay_result.metres == 0 and replay_result.way == "re-simulated"


def test_states_that_drift_from_the_record_are_reset_to_it(task: OpenedTask, recorded: Recorded) -> None:
    run = recorded.run(1)
    states = {name: rows.copy() for name, rows in run.env_states.items()}
    states["actors/cube"][12:, 0] += 0.05  # as if the cube had been pushed
    step, replay_result = replay_to(task, replace(run, env_states=states), 20, [1])
    assert replay_result.way == "corrected" and 1 <= replay_result.corrected <= 8
    assert replay_result.metres is not None and replay_result.metres < 1e-4
    now = {name: rows[1] for name, rows in read_states(task.env.env).items()}
    assert state_distance(now, {n: rows[20] for n, rows in states.items()})[0] < 1e-4


def test_actions_of_the_wrong_shape_are_reported_and_the_state_is_set(
    task: OpenedTask, recorded: Recorded
) -> None:
    run = recorded.run(1)
    step, replay_result = replay_to(task, replace(run, action=run.action[:, :5]), 25, [1])
    assert replay_result.way == "restored" and "5 dimensions" in replay_result.missed["the way there"]
    assert replay_result.metres is not None and replay_result.metres < 1e-6
    assert step.elapsed_steps[1] == 25
    robot = task.env.env.agent.robot
    targets = task.env.env.scene.px.cuda_articulation_target_qpos.torch()[1]
    assert np.allclose(targets[: robot.max_dof], robot.get_qpos()[1], atol=1e-6)
    # The robot stays in this state and does not move to its previous drive target.
    task.env.step(None)
    now = {name: rows[1] for name, rows in read_states(task.env.env).items()}
    assert state_distance(now, run.state(25))[1] < 0.05


def test_each_env_begins_its_own_run_and_gets_its_own_state(task: OpenedTask, recorded: Recorded) -> None:
    record(task, 3, [1, 2, 3], reaching(3, N))
    before = {name: rows.copy() for name, rows in read_states(task.env.env).items()}
    runs = {0: recorded.run(2), 2: recorded.run(0)}
    moved = {name: rows.copy() for name, rows in runs[2].env_states.items()}
    moved["actors/cube"][0, 0] += 0.05  # its reset leads elsewhere
    runs[2] = replace(runs[2], env_states=moved)
    begun = begin_run(task.loaded, task.env, runs)
    assert {env: (one.differs, one.missed) for env, one in begun.items()} == {0: (False, {}), 2: (True, {})}
    assert [task.env.episode_seeds[env] for env in (0, 1, 2)] == [5, 2, 31]
    first, later = (
        {env: run.state(0) for env, run in runs.items()},
        {0: runs[0].state(9), 2: runs[2].state(20)},
    )
    for wanted in (first, later):
        now = read_states(task.env.env)
        for name, rows in now.items():
            assert np.array_equal(rows[1], before[name][1]), name
            for env, state in wanted.items():
                np.testing.assert_allclose(rows[env], state[name], atol=1e-6, err_msg=name)
        step = restore_recorded(task, later)
    assert step.poses.shape[0] == N
    unseeded = begin_run(task.loaded, task.env, {1: replace(recorded.run(1), seed=-1)})
    assert len(unseeded[1].missed) == 1 and unseeded[1].differs


def test_parts_of_a_state_that_do_not_fit_are_named_and_stay(task: OpenedTask, recorded: Recorded) -> None:
    env, state = task.env.env, recorded.run(1).state(20)
    cube = state["actors/cube"]
    lacking = {name: value for name, value in state.items() if name != "actors/cube"}
    others = {"actors/other", "articulations/other"}
    for changed, missed in (
        (state, set()),
        (lacking, {"actors/cube"}),
        ({**state, "actors/cube": np.zeros(14, np.float32)}, {"actors/cube"}),
        ({**state, "actors/cube": np.full(13, np.nan, np.float32)}, {"actors/cube"}),
        (state | dict.fromkeys(others, cube), others),
        ({**state, "actors/other": np.full(13, np.nan, np.float32), "controller/arm": cube}, set()),
    ):
        assert state_mismatches(env, 1, changed).keys() == missed
    begin_run(task.loaded, task.env, {1: recorded.run(0)})
    before = {name: rows.copy() for name, rows in read_states(env).items()}
    write_states(env, {1: lacking})
    now = read_states(env)
    np.testing.assert_array_equal(now["actors/cube"], before["actors/cube"])
    np.testing.assert_allclose(now["articulations/panda"][1], state["articulations/panda"], atol=1e-6)
    for other in (0, 2):
        np.testing.assert_array_equal(now["articulations/panda"][other], before["articulations/panda"][other])


def test_actions_that_are_no_numbers_are_not_taken(task: OpenedTask, recorded: Recorded) -> None:
    action = recorded.run(1).action.copy()
    action[3] = np.nan
    done: list[int] = []
    _, result = replay_to(task, replace(recorded.run(1), action=action), 10, [0, 2], done.append)
    assert result.way == "restored" and result.missed.keys() == {"the way there"} and done == []
    for env in (0, 2):
        here = {name: rows[env] for name, rows in read_states(task.env.env).items()}
        assert state_distance(here, recorded.run(1).state(10))[0] < 1e-6
    _, result = replay_to(task, recorded.run(1), 4, [0, 2], done.append)
    assert (result.way, done) == ("re-simulated", [1, 2, 3, 4])
    for state, envs in ((STEPS + 1, [0]), (-1, [0]), (3, []), (3, [N])):
        with pytest.raises(IndexError):
            replay_to(task, recorded.run(1), state, envs)
    assert replay_to(task, recorded.run(1), STEPS, [1])[1].metres == 0


def test_each_way_to_a_state_is_told_apart() -> None:
    results = [
        ReplayResult("restored", 20, 0.0, 0.0),
        ReplayResult("corrected", 20, 0.0012, 0.0, corrected=3),
        ReplayResult("re-simulated", 0, 0.0, 0.0),
        ReplayResult("re-simulated", 0, 0.0, 0.0, start_differs=True),
        ReplayResult("re-simulated", 20, 0.0, 0.0),
        ReplayResult("re-simulated", 20, 0.0, 0.0, start_differs=True),
        ReplayResult("re-simulated", 20, 0.0, 0.1),
        ReplayResult("re-simulated", 20, None, None),
    ]
    texts = [replay_text(result) for result in results]
    assert len(set(texts)) == len(texts)
    assert "3 of 20" in texts[1] and "1.2 mm" in texts[1]
    exact = [text.endswith("to the last bit.") for text in texts]
    assert exact == [True, False, True, True, True, True, False, False]


PLACED = """
import torch
from mani_skill.envs.tasks import PushCubeEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose


@register_env("PlacedByOptions-v1", max_episode_steps=9, override=True)
class PlacedEnv(PushCubeEnv):
    def _initialize_episode(self, env_idx, options):
        super()._initialize_episode(env_idx, options)
        place = torch.tensor([[options.get("x", 0.0), 0.0, 0.02]]).repeat(len(env_idx), 1)
        self.obj.set_pose(Pose.create_from_pq(p=place))
"""


def test_the_recorded_options_of_the_reset_and_targets_of_controllers_are_restored(tmp_path: Path) -> None:
    file = tmp_path / "placed.py"
    file.write_text(PLACED)
    task = opened(str(file), N, control_mode="pd_joint_target_delta_pos")
    options = {"x": 0.3, "env_idx": [0], "reconfigure": True}
    plain = RecordedRun("r", 3, options, np.zeros((0, 8), np.float32), {})
    begun = begin_run(task.loaded, task.env, {1: plain})
    assert read_states(task.env.env)["actors/cube"][:, 0].tolist() == pytest.approx([0, 0.3, 0])
    assert len(begun[1].missed) == 1 and options == {"x": 0.3, "env_idx": [0], "reconfigure": True}

    def targets() -> dict[str, np.ndarray]:
        held = flat_entries(task.env.env.agent.get_controller_state(), "controller")
        return {name: value.cpu().numpy().copy() for name, value in held if value is not None}

    before = targets()
    assert any(rows.shape[1:] == (7,) for rows in before.values())
    states = {name: rows[1] + np.float32(0.25) for name, rows in before.items()}
    write_states(task.env.env, {0: {name: row + np.float32(0.5) for name, row in states.items()}, 1: states})
    for name, rows in targets().items():
        np.testing.assert_array_equal(rows[0], before[name][1] + np.float32(0.25) + np.float32(0.5))
        np.testing.assert_array_equal(rows[1], before[name][1] + np.float32(0.25))
        np.testing.assert_array_equal(rows[2], before[name][2])
    task.env.close()


def test_an_error_of_the_task_during_replay_has_its_own_line(tmp_path: Path) -> None:
    text = (TASKS / "push_cube.py").read_text()
    file = tmp_path / "push_cube.py"
    file.write_text(text)
    task = opened(str(file), 2)
    run = record(task, 8, [3, 4]).run(0)
    task.env.close()
    wrong = r"\g<0>\n        if (self.elapsed_steps > 3).any():\n            1 / 0"
    file.write_text(re.sub(r"    def evaluate\(self\).*", wrong, text))
    task = opened(str(file), 2)
    with pytest.raises(TaskError) as raised:
        replay_to(task, run, 6, [0])
    assert raised.value.problem.file == str(file) and "ZeroDivisionError" in raised.value.problem.message
    task.env.close()

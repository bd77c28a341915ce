"""Columns told later of many steps are those that are read at every step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mani_skill.utils.structs.pose import Pose

import workbench
from tests.drive.envs import CPU
from tests.session.odd_entries import write_task
from workbench.core import actions, seams
from workbench.core.open_env import open_env
from workbench.core.state_columns import read_state_columns
from workbench.core.state_names import STATE
from workbench.core.step_rows import ELAPSED, StepRows
from workbench.core.task_env import TaskEnv
from workbench.recording.step_ring import StepRing, Steps
from workbench.session.episodes import batch_columns


@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("PickCube-v1", {"obs_mode": "state", "control_mode": "pd_joint_target_delta_pos"}),
        ("PickCube-v1", {"obs_mode": "state_dict"}),
        ("TwoRobotPickCube-v1", {"obs_mode": "state"}),
        ("odd_entries", {"obs_mode": "state"}),
    ],
)
def test_steps_told_later_are_those_that_were_read(
    task: str, options: dict[str, Any], tmp_path: Path
) -> None:
    odd = task == "odd_entries"
    env = workbench.make(write_task(tmp_path) if odd else task, 3, **CPU, **options)
    env.reset(seed=1)
    held = TaskEnv(open_env(env))
    rows = StepRows(held)
    told: list[dict[str, Any]] = []

    def deliver(steps: Steps) -> None:
        columns = rows.columns(steps.arrays)
        columns[ELAPSED] = steps.arrays[ELAPSED].copy()
        told.append(columns)

    ring = StepRing(deliver, rows.learn)
    read: list[dict[str, Any]] = []
    rng = np.random.default_rng(0)
    width = sum(len(part.names) for part in held.parts)
    for step in range(7):
        if step == 4:
            for actor in seams.hidden_objects(held.env):
                actor.hide_visual()  # moves it 99999 m away, as a sensor's picture does
                # While it is hidden its row in the simulation's tensor keeps place and turn of before.
                turned = torch.tensor([[0.5, 0.5, -0.5, 0.5], [0.6, 0, 0.8, 0], [0, 1, 0, 0]])
                actor.set_pose(Pose.create_from_pq(p=torch.arange(9.0).reshape(3, 3), q=turned))
        action = rng.uniform(-1, 1, (3, width)).astype(np.float32)
        made = actions.to_env_action(held.env, held.parts, action)
        _, reward, terminated, truncated, info = env.step(made)
        ring.take(rows.read(reward, terminated, truncated, info, action))
        assert odd or not rows.others
        result = held.result_of(info, reward, terminated, truncated, action)
        assert rows.others.keys() == result.others.keys()
        columns = read_state_columns(held)
        names = frozenset(name[len(STATE) :] for name in columns if name.startswith(STATE))
        read.append({**dict(batch_columns(result, columns, names)), ELAPSED: result.elapsed_steps})
    ring.flush()
    assert ring.error is None
    if odd:  # whose entries come and go, so that each step is a layout of its own
        assert len(told) == len(read)
        for block, one in zip(told, read, strict=True):
            assert list(block)[:-1] == list(one)[:-1]
            for name, values in one.items():
                np.testing.assert_array_equal(block[name][0], values, err_msg=name)
        env.close()
        return
    assert len(told) == (2 if seams.hidden_objects(held.env) else 1)
    for name, values in read[0].items():
        whole = np.concatenate([block[name] for block in told])
        assert whole.dtype == values.dtype, name
        np.testing.assert_array_equal(whole, np.stack([one[name] for one in read]), err_msg=name)
    assert [list(block)[:-1] for block in told] == [list(read[0])[:-1]] * len(told)
    env.close()

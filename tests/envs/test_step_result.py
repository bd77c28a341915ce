"""The memory size of a step result, which bounds the history."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from workbench.envs.step_result import OtherEntry, StepResult
from workbench.envs.task_drawings import Drawing


def test_every_field_counts() -> None:
    arrays = {
        "elapsed_steps": np.zeros(3, np.int32),
        "reward": np.zeros(3, np.float32),
        "terminated": np.zeros(3, bool),
        "truncated": np.zeros(3, bool),
        "poses": np.zeros((3, 5, 7), np.float32),
        "action": np.zeros((3, 2), np.float32),
        "sound_obs": np.zeros(3, bool),
        "qpos": np.zeros((3, 9), np.float32),
    }
    evaluate, others = {"success": np.zeros(3, bool)}, {"mean": OtherEntry("float", ("0.5",))}
    drawn = {"goal": Drawing("points", np.zeros((3, 4, 3), np.float32))}
    forces = {("cube", "table"): np.zeros(3, np.float32)}
    assert {one.name for one in fields(StepResult)} == {*arrays, "evaluate", "others", "forces", "drawn"}
    step = StepResult(**arrays, evaluate=evaluate, others=others, forces=forces, drawn=drawn)
    parts = [*arrays.values(), *evaluate.values(), *others.values(), *forces.values(), *drawn.values()]
    assert step.nbytes == sum(part.nbytes for part in parts)

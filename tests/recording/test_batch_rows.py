"""Rows of a batch packed at once are the rows that each env's own packer makes."""

from __future__ import annotations

import numpy as np

from workbench.core.step import OtherEntry, StepResult
from workbench.recording.batch_rows import BatchPacker
from workbench.recording.columns import RowPacker
from workbench.session.episodes import batch_columns, next_row


def test_a_batch_is_packed_as_its_envs_are() -> None:
    rng = np.random.default_rng(0)
    step = StepResult(
        elapsed_steps=np.array([1, 4, 2], np.int32),
        reward=rng.random(3, np.float32),
        terminated=np.array([False, True, False]),
        truncated=np.array([True, False, False]),
        evaluate={"success": np.array([True, False, True]), "reward_terms/reach": rng.random((3, 2))},
        poses=rng.random((3, 5, 7), np.float32),
        action=rng.random((3, 4), np.float32),
        others={
            "progress": OtherEntry("float", numbers=np.array(0.5)),
            "goal": OtherEntry("float32 tensor of shape (2,)", numbers=np.ones(2, np.float32)),
            "phase": OtherEntry("str", ("reach",)),
            "words": OtherEntry("list", ("a", "b", "c"), per_env=True),
        },
    )
    columns = {
        "state/actors/cube": rng.random((3, 13, 2), np.float32)[:, :, 0],  # not in one piece
        "state/actors/mug": np.full((3, 13), np.nan, np.float32),
        "obs/agent/qpos": rng.random((3, 9), np.float32),
        "obs/extra/none": np.zeros((3, 0), np.float32),
    }
    names = frozenset({"actors/cube"})
    packer = BatchPacker()
    layout, rows = packer.pack(batch_columns(step, columns, names))
    for env in range(3):
        one = RowPacker(bodies=5, actions=4)
        row = next_row(step, env, columns, (), names)
        assert row.others["words"].texts == ("abc"[env],) and row.others["phase"].texts == ("reach",)
        _, packed, text = one.pack(row)
        assert rows[env] == packed and text is not None
        assert one.number_of(layout.key) == (0, None)  # the same layout, so nothing new
    assert packer.pack(batch_columns(step, columns, names))[0] is layout

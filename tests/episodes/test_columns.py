"""Rows that are packed and unpacked are unchanged, and invalid rows are refused."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tests.drive.rows import EpisodeRow, packed
from workbench.envs.step_result import OtherEntry, StepResult
from workbench.episodes.columns import BatchPacker, assemble, layout_type
from workbench.record.gather import batch_columns

VALUE = st.sampled_from([np.bool_, np.int64, np.float32, np.float64]).flatmap(
    lambda dtype: hnp.arrays(dtype, st.sampled_from([(), (0,), (1,), (3,), (2, 2)]))
)


@settings(max_examples=60)
@given(st.lists(st.dictionaries(st.text(max_size=3), VALUE, max_size=3), min_size=1, max_size=8))
def test_any_rows_are_restored(entries: list[dict[str, np.ndarray]]) -> None:
    poses, action = np.zeros((2, 7), np.float32), np.zeros(2, np.float32)
    packer = BatchPacker()
    contents = [packed(EpisodeRow(poses, held, action=action), packer, 2) for held in entries]
    columns = assemble([np.frombuffer(content, layout_type(layout.text)) for layout, content in contents])
    names = {name for held in entries for name in held}
    assert columns.keys() == {
        "poses", "action", "reward", "terminated", "truncated", *(f"evaluate/{name}" for name in names)
    }  # fmt: skip
    for name in names:
        column = columns[f"evaluate/{name}"]
        for index, held in enumerate(entries):
            if name not in held:
                assert np.isnan(column[index]).all()
            else:
                value = held[name].reshape(-1)
                kept = column[index].reshape(-1)
                np.testing.assert_array_equal(kept[: value.size], value.astype(column.dtype))
                assert value.size == kept.size or np.isnan(kept[value.size :]).all()


def test_a_batch_is_packed_like_its_single_envs() -> None:
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
        },
    )
    columns = {
        "state/actors/cube": rng.random((3, 13, 2), np.float32)[:, :, 0],  # not contiguous
        "state/actors/mug": np.full((3, 13), np.nan, np.float32),
        "obs/agent/qpos": rng.random((3, 9), np.float32),
        "obs/extra/none": np.zeros((3, 0), np.float32),
    }
    packer = BatchPacker()
    together = batch_columns(step, columns, frozenset({"actors/cube"}))
    layout, rows = packer.pack(together)
    assert step.action is not None
    for env in range(3):
        by_hand = EpisodeRow(
            step.poses[env],
            {name: values[env] for name, values in step.evaluate.items()},
            {"actors/cube": columns["state/actors/cube"][env]},
            {name[4:]: values[env] for name, values in columns.items() if name.startswith("obs/")},
            step.action[env],
            float(step.reward[env]),
            bool(step.terminated[env]),
            bool(step.truncated[env]),
            others=step.others,
        )
        assert packed(by_hand, packer, 4) == (layout, rows[env])
    assert packer.pack(together)[0] is layout


def test_batches_of_changing_size_and_entries_are_packed_each_for_itself() -> None:
    packer = BatchPacker()
    seen = []
    for count, more in ((3, False), (2, False), (2, True), (3, False), (3, False)):
        numbers = np.arange(count, dtype=np.float32)[:, None] + 10 * len(seen)
        columns = [("poses", numbers), *([("evaluate/more", numbers[:, 0] > 11)] if more else [])]
        layout, rows = packer.pack(columns)
        seen.append(layout)
        assert len(rows) == count
        for env, row in enumerate(rows):
            (found,) = np.frombuffer(row, layout_type(layout.text))
            assert found["poses"].tolist() == [10 * (len(seen) - 1) + env]
    assert seen[0] is seen[1] is seen[3] is seen[4] is not seen[2], "a layout is written once"

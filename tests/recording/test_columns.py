"""Rows that are packed and put together again are the rows, and what is no row is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from workbench.recording.columns import RowPacker, assemble, layout_type, merge
from workbench.recording.row import EpisodeRow


def row(action: Any = (0.0, 0.0), **evaluate: Any) -> EpisodeRow:
    poses = np.zeros((2, 7), dtype=np.float32)
    held = {name: np.asarray(value) for name, value in evaluate.items()}
    return EpisodeRow(poses, held, action=np.asarray(action, dtype=np.float32))


def through(rows: list[EpisodeRow]) -> dict[str, np.ndarray]:
    """`rows` packed, and unpacked as columns; two halves, as a journal is read in pieces."""
    packer = RowPacker(2, 2)
    layouts, packed = [], []
    for one in rows:
        number, content, text = packer.pack(one)
        if text is not None:
            layouts.append(layout_type(text))
        packed.append(np.frombuffer(content, layouts[number]))
    counts: dict[np.dtype, int] = {}
    for run in packed:
        counts[run.dtype] = counts.get(run.dtype, 0) + 1
    columns = merge(counts)
    half = len(packed) // 2
    parts = [assemble(part, columns) for part in (packed[:half], packed[half:]) if part]
    return {name: np.concatenate([part[name] for part in parts]) for name in columns}


def test_types_are_kept_where_every_row_has_the_entry() -> None:
    vectors = np.arange(6.0).reshape(3, 2)
    rows = [
        row(success=flag, contacts=4, offset=vector) for flag, vector in zip((True, False, True), vectors)
    ]
    columns = through(rows)
    assert columns["evaluate/success"].dtype == np.bool_
    assert columns["evaluate/contacts"].dtype.kind == "i"
    np.testing.assert_array_equal(columns["evaluate/success"], [True, False, True])
    np.testing.assert_array_equal(columns["evaluate/offset"], vectors)


def test_entries_that_come_and_go_leave_nan() -> None:
    columns = through([row(early=True), row(late=np.ones(2)), row(late=np.ones(2), early=False)])
    np.testing.assert_array_equal(columns["evaluate/early"], [1, np.nan, 0])
    np.testing.assert_array_equal(columns["evaluate/late"], [[np.nan, np.nan], [1, 1], [1, 1]])


def test_entries_that_change_their_shape_are_padded() -> None:
    columns = through([row(d=np.float32(1)), row(d=np.full(2, 2.0))])
    np.testing.assert_array_equal(columns["evaluate/d"], [[1, np.nan], [2, 2]])


def test_what_is_no_number_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"evaluate\(\)\['phase'\] has dtype <U5"):
        RowPacker(2, 2).pack(row(phase="reach"))


def test_actions_and_bodies_must_fit() -> None:
    with pytest.raises(ValueError, match="3 numbers, but 2 action names"):
        RowPacker(2, 2).pack(row(action=(0, 0, 0)))
    with pytest.raises(ValueError, match="the scene has 3 bodies"):
        RowPacker(3, 2).pack(row())


VALUE = st.sampled_from([np.bool_, np.int64, np.float32, np.float64]).flatmap(
    lambda dtype: hnp.arrays(dtype, st.sampled_from([(), (0,), (1,), (3,), (2, 2)]))
)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.dictionaries(st.text(max_size=3), VALUE, max_size=3), min_size=1, max_size=8))
def test_any_rows_come_back(entries: list[dict[str, np.ndarray]]) -> None:
    columns = through(
        [
            row()
            if not held
            else EpisodeRow(np.zeros((2, 7), np.float32), held, action=np.zeros(2, np.float32))
            for held in entries
        ]
    )
    assert set(columns) == {"poses", "action", "reward", "terminated", "truncated"} | {
        f"evaluate/{name}" for held in entries for name in held
    }
    for name in {name for held in entries for name in held}:
        column = columns[f"evaluate/{name}"]
        for index, held in enumerate(entries):
            if name not in held:
                assert np.isnan(column[index]).all()
            else:
                value = held[name]
                kept = column[index].reshape(-1)
                same = value.reshape(-1).astype(column.dtype)
                np.testing.assert_array_equal(kept[: value.size], same)
                assert value.size == kept.size or np.isnan(kept[value.size :]).all()

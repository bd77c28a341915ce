"""Chunks made without rerun's archetypes are what its archetypes would have made."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from workbench.recording.rerun.chunks import TimedChunks

STEPS = np.arange(5, dtype=np.int64)


def data_of(chunk: Chunk) -> dict[str, list]:
    """Columns but the ids of its rows, which are unique, with all that rerun says of them."""
    batch = chunk.to_record_batch()
    return {
        f"{field.name} {field.type} {sorted((field.metadata or {}).items())}": batch.column(
            field.name
        ).to_pylist()
        for field in batch.schema
        if (field.metadata or {}).get(b"rerun:kind") != b"control"
    }


def times() -> list[rr.TimeColumn]:
    nanoseconds = (STEPS * 50_000_000).astype("timedelta64[ns]")
    return [rr.TimeColumn("step", sequence=STEPS), rr.TimeColumn("sim_time", duration=nanoseconds)]


def unaligned(values: NDArray) -> NDArray:
    """The same numbers, one byte off from where a processor would have them."""
    content = b"\0" + values.tobytes()
    return np.frombuffer(content, np.uint8)[1:].view(values.dtype).reshape(values.shape)


@pytest.mark.parametrize("place", [np.asarray, unaligned])
def test_poses(place: Callable[[NDArray], NDArray]) -> None:
    rng = np.random.default_rng(0)
    translation, quaternion = (rng.normal(size=(5, n)).astype(np.float32) for n in (3, 4))
    poses = place(np.concatenate([translation, quaternion], axis=1))
    (ours,) = TimedChunks(0.05).poses(["/world/cube"], STEPS, poses[:, None])
    columns = rr.Transform3D.columns(translation=translation, quaternion=quaternion)
    assert data_of(ours) == data_of(Chunk.from_columns("/world/cube", times(), columns))


@pytest.mark.parametrize("place", [np.asarray, unaligned])
@pytest.mark.parametrize("shape", [(), (1,), (3,), (2, 2)])
def test_numbers(shape: tuple[int, ...], place: Callable[[NDArray], NDArray]) -> None:
    values = np.random.default_rng(0).normal(size=(5, *shape))
    ours = TimedChunks(0.05).scalars("/evaluate/offset", STEPS, place(values))
    width = int(np.prod(shape))
    columns = rr.Scalars.columns(scalars=values.reshape(-1)).partition([width] * 5)
    assert data_of(ours) == data_of(Chunk.from_columns("/evaluate/offset", times(), columns))

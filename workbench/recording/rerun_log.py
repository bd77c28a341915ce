"""Rerun's two ways in, columns in time and static values, with an account of what went in.

Rerun writes on threads of its own, and what those fail to write is at best a line on stderr. So what was handed over is
counted, for the finished file to be held against.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

STEP = "step"
SIM_TIME = "sim_time"
_MOST_TIMES = 64
SERIES_COLORS = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (213, 94, 0),
    (0, 114, 178),
    (150, 150, 150),
    (136, 100, 220),
)
"""Okabe and Ito's palette, which the colour-blind can tell apart, with grey and violet for its black and
yellow: the viewer comes dark and light, and each of those vanishes on one of the two."""


@dataclass(frozen=True)
class Account:
    """What was handed to rerun."""

    rows: Counter[str] = field(default_factory=Counter)
    """Entity to number of rows in time."""
    statics: set[str] = field(default_factory=set)
    """Entities that hold something static."""


def telling(values: NDArray) -> NDArray[np.int64] | None:
    """Which rows of `values` (R, D) say something; None for all of them.

    A row between two equal ones says nothing: whoever looks there finds the one before, and a curve is the same line.
    A row of one number takes 20 bytes in the file besides that number, and most flags of a task change once in an episode. The
    first and the last row always stay, so that an entity is there for as long as it was recorded.
    """
    if len(values) < 3:
        return None
    bits = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), -1)  # NaN equals NaN
    again = (bits[1:] == bits[:-1]).all(axis=1)
    silent = again[:-1] & again[1:]
    if not silent.any():
        return None
    return np.concatenate([[0], 1 + np.flatnonzero(~silent), [len(values) - 1]])


def static_chunk(entity: str, *values: Any) -> Chunk:
    """`values` as what `entity` is all through, ready to be sent: making it takes longer than that.

    Raises:
        ValueError: rerun refuses one of them.
    """
    batches = [batch for value in values for batch in value.as_component_batches()]
    columns = [batch.partition([len(batch.as_arrow_array())]) for batch in batches]
    return Chunk.from_columns(entity, [], columns)


@lru_cache(maxsize=512)
def _series_chunk(entity: str, names: tuple[str, ...], first_color: int) -> Chunk:
    colors = [SERIES_COLORS[(first_color + index) % len(SERIES_COLORS)] for index in range(len(names))]
    return static_chunk(entity, rr.SeriesLines(names=list(names), colors=colors))


class Log:
    """One recording's way in."""

    def __init__(self, recording: rr.RecordingStream, control_dt: float) -> None:
        self._recording = recording
        self._control_dt = control_dt
        self._times: dict[
            bytes, list[rr.TimeColumn]
        ] = {}  # by their steps, which most entities of a piece share
        self.account = Account()

    def static(self, entity: str, *values: Any) -> None:
        self.chunk(static_chunk(entity, *values))

    def chunk(self, chunk: Chunk) -> None:
        """What `static_chunk` made, for this recording or an earlier one."""
        self._recording.send_chunks(chunk)
        self.account.statics.add(chunk.entity_path)

    def columns(self, entity: str, steps: NDArray[np.int64], columns: Iterable[Any]) -> None:
        if len(steps) == 0:
            return
        self._recording.send_columns(entity, self._times_of(steps), columns)
        self.account.rows[entity] += len(steps)

    def _times_of(self, steps: NDArray[np.int64]) -> list[rr.TimeColumn]:
        key = steps.tobytes()
        if key not in self._times:
            if len(self._times) >= _MOST_TIMES:
                self._times.clear()
            self._times[key] = [
                rr.TimeColumn(STEP, sequence=steps),
                # Whole nanoseconds by rounding: rerun itself cuts off, and 3 * 0.05 s would be 149999999 ns.
                rr.TimeColumn(
                    SIM_TIME, duration=np.rint(steps * self._control_dt * 1e9).astype("timedelta64[ns]")
                ),
            ]
        return self._times[key]

    def pose(
        self,
        entity: str,
        steps: NDArray[np.int64],
        translation: NDArray[np.float32],
        xyzw: NDArray[np.float32],
    ) -> None:
        """`translation` (len(steps), 3) and `xyzw` (len(steps), 4); rows that `telling` leaves out are."""
        rows = telling(np.concatenate([translation, xyzw], axis=1))
        if rows is not None:
            steps, translation, xyzw = steps[rows], translation[rows], xyzw[rows]
        self.columns(entity, steps, rr.Transform3D.columns(translation=translation, quaternion=xyzw))

    def still(self, entity: str, translation: NDArray[np.float32], xyzw: NDArray[np.float32]) -> None:
        """The one pose, (3,) and (4,), of what never moves."""
        quaternion = rr.Quaternion(xyzw=xyzw)
        self.static(entity, rr.Transform3D(translation=translation, quaternion=quaternion))

    def series(self, entity: str, names: Sequence[str], first_color: int = 0) -> None:
        """Name and colour of each number of the batched `scalars` of `entity`."""
        if names:
            # Left to itself rerun gives all series of an entity one colour, and entities of one folder much the same.
            self.chunk(_series_chunk(entity, tuple(names), first_color))

    def scalars(self, entity: str, steps: NDArray[np.int64], values: NDArray) -> None:
        """`values` (len(steps), ...), all of a step as one batch; rows that `telling` leaves out are."""
        if np.size(values):
            flat = np.asarray(values, dtype=np.float64).reshape(len(steps), -1)
            rows = telling(flat)
            if rows is not None:
                steps, flat = steps[rows], flat[rows]
            columns = rr.Scalars.columns(scalars=flat.reshape(-1))
            self.columns(entity, steps, columns.partition([flat.shape[1]] * len(flat)))

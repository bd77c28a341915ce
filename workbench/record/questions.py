"""The question for what a recording stores of a past moment. Only for a worker that does not play: its envs move."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import NDArray

from workbench.envs.camera_data import Picture
from workbench.machine.processes.wire import Question


@dataclass(frozen=True)
class Captured:
    """What a recording stores of a moment."""

    columns: dict[str, NDArray]
    """State columns, as in `Stepped.columns`."""
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class CaptureMoment(Question[Captured]):
    """Put the envs back to a past moment and read what a recording stores of it."""

    snapshot: bytes
    """A pickled `envs.snapshots.snapshot.Snapshot` of the whole batch."""
    env_idx: tuple[int, ...]
    """The envs to draw."""
    pictures: bool
    """Whether to draw pictures."""

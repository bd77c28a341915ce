"""The question that captures a past moment's data for a recording. It moves the envs, so only a worker that
is not playing may be asked."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import NDArray

from workbench.envs.camera_data import Picture
from workbench.machine.processes.wire import Question


@dataclass(frozen=True)
class Captured:
    """Data of a moment for a recording."""

    columns: dict[str, NDArray]
    """State columns, as in `Stepped.columns`."""
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class CaptureMoment(Question[Captured]):
    """Restore the envs to a past moment, and capture its data for a recording."""

    snapshot: bytes
    """A pickled `envs.snapshots.snapshot.Snapshot` of the whole batch."""
    env_idx: tuple[int, ...]
    """The envs whose cameras are rendered."""
    pictures: bool
    """Whether to render pictures."""

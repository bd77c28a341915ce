"""What a worker beside the one that plays is asked of moments of the past: to judge them anew, or to draw them again.

The server has them all (`history`): it hands over snapshots and actions, some moments at a time, and gets what the task
says of them. Both are only for a worker that does not play, since its envs are put wherever the moments are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.authoring.problem import Problem
from workbench.core.pictures import Picture
from workbench.core.step import StepResult
from workbench.session.calls import Question


@dataclass(frozen=True)
class MomentToJudge:
    """A moment of the past to be lived through again: a control step, or a jump if it has a snapshot."""

    action: NDArray[np.float32] | None
    """(N, A) that was made; None for a jump, or a task without robots."""
    snapshot: bytes | None = None
    """A pickled `core.snapshot.Snapshot` of the whole batch."""
    env_idx: tuple[int, ...] = ()
    """The envs that are put back to it."""


@dataclass(frozen=True)
class Judged:
    """What the task says of some moments now."""

    steps: tuple[StepResult, ...]
    """One for each moment; fewer if one raised."""
    not_carried: dict[str, str]
    """What jumps of all envs among them could not put back, and why."""
    problem: Problem | None = None
    """What the moment after `steps` raised."""


@dataclass(frozen=True)
class JudgeMoments(Question[Judged]):
    """Live through these moments, in order. Only for a worker that does not play."""

    moments: tuple[MomentToJudge, ...]


@dataclass(frozen=True)
class Captured:
    """What a recording would have kept of a moment."""

    columns: dict[str, NDArray]
    """As `Stepped.columns`."""
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class CaptureMoment(Question[Captured]):
    """Put the envs back to a moment of the past that is to be recorded after the fact. Only for a worker that does not
    play."""

    snapshot: bytes
    """A pickled `core.snapshot.Snapshot` of the whole batch."""
    env_idx: tuple[int, ...]
    """Those whose pictures are wanted, if any."""
    pictures: bool

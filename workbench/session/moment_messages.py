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
class JudgeMoments:
    """Live through these moments, in order; the answer is `Judged`. Only for a worker that does not play."""

    moments: tuple[MomentToJudge, ...]


@dataclass(frozen=True)
class MomentToCapture:
    """A moment of the past of which some envs are to be recorded after the fact."""

    snapshot: bytes
    """A pickled `core.snapshot.Snapshot` of the whole batch."""
    env_idx: tuple[int, ...]
    """Those whose pictures are wanted."""


@dataclass(frozen=True)
class CaptureMoments:
    """Put the envs back to these moments, and say what a recording would have kept; the answer is `Captured`. Only for a
    worker that does not play."""

    moments: tuple[MomentToCapture, ...]
    pictures: bool


@dataclass(frozen=True)
class Judged:
    """The answer to `JudgeMoments`: what the task says of them now."""

    steps: tuple[StepResult, ...]
    """One for each moment; fewer if one raised."""
    not_carried: dict[str, str]
    """What jumps of all envs among them could not put back, and why."""
    problem: Problem | None = None
    """What the moment after `steps` raised."""


@dataclass(frozen=True)
class Captured:
    """The answer to `CaptureMoments`."""

    columns: tuple[dict[str, NDArray], ...]
    """As `Stepped.columns`, one for each moment."""
    pictures: tuple[tuple[Picture, ...], ...]
    not_carried: dict[str, str]
    """What could not be put back, and why."""

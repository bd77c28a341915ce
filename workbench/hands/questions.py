"""Questions about resets for a worker."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.envs.inspection import Overlap
from workbench.machine.processes.wire import Question


@dataclass(frozen=True)
class FirstStates:
    """The first states of all N envs after a reset."""

    poses: NDArray[np.float32]
    """(N, B, 7) as in `StepResult.poses`."""
    overlaps: tuple[tuple[Overlap, ...], ...] | None = None
    """For each env, bodies inside each other, deepest first (`overlaps_to_report`); None in GPU simulation,
    where contacts cannot be read."""
    reach_of: tuple[int, ...] = ()
    """Bodies for which `out_of_reach` was computed; empty if no robot has an arm."""
    out_of_reach: NDArray[np.bool_] | None = None
    """(N, len(reach_of)) whether no arm of the env reaches the origin of the body, in any rotation. Collisions are
    not considered."""


@dataclass(frozen=True)
class SampleReset(Question[FirstStates]):
    """Reset all envs. Only a process that does not play answers it, since the envs make a substep of physics."""

    seed: int

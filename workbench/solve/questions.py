"""Questions for plans. Only a worker that does not play answers them: its envs run the rollouts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.machine.processes.wire import Question
from workbench.planning.options import PlanArguments


@dataclass(frozen=True)
class PlannedEnv:
    """The plan for one env, and the results of the last round of its K rollouts."""

    env: int
    actions: NDArray[np.float32]
    """(S, A) actions for the control steps before the next plan."""
    horizon: int
    """H, the number of control steps of a rollout."""
    returns: NDArray[np.float32]
    """(K,) return of each rollout, best first, NaN last."""
    plan: int
    """Index of the rollout that repeats the previous plan unchanged."""
    hold: int
    """Index of the rollout in which the robot holds still."""
    success_at: NDArray[np.int32]
    """(K,) step of the horizon at which each rollout succeeded, from 1; 0 without success."""
    paths: NDArray[np.float32]
    """(P, H + 1, 3) paths of the traced body in some of the rollouts, best first; metres in the env's frame."""
    drawn: tuple[int, ...]
    """(P,) index in `returns` of each rollout in `paths`."""
    traced: str
    """Name of the traced body; empty if the task has no body to trace."""
    seconds: float


@dataclass(frozen=True)
class Planned:
    """Plans for the envs of the request, in its order."""

    envs: tuple[PlannedEnv, ...]


@dataclass(frozen=True)
class PlanActions(Question[Planned]):
    """Plan the next actions of some envs, continuing their last plans. A later request ends the planning."""

    snapshot: bytes
    """A pickled `envs.snapshots.snapshot.Snapshot` of these envs."""
    bodies: tuple[dict[str, bytes], ...]
    """Bodies of each of these envs, from `planning.rollouts.bodies_of`."""
    options: PlanArguments
    traced: str = ""
    """Name of the body to trace, see `Settings.traced`."""

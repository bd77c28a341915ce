"""Recorded episodes that are to be judged again, and what is said of them: plain data that crosses a pipe."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from workbench.authoring.problem import Problem
from workbench.recording.episode import Episode
from workbench.session.calls import Question

FAR_METRES = 1e-3
"""A body further than this from the record makes a comparison doubtful."""


@dataclass(frozen=True)
class EpisodeFile:
    """Where a recorded episode is."""

    id: str
    """What the caller knows it by."""
    name: str
    path: Path
    trajectory: str | None = None
    """Of a file of ManiSkill's, which may hold several."""

    def read(self) -> Episode:
        """Raises as `read_recording`."""
        # Not at the top: every worker knows these messages, and few read a recording.
        from workbench.recording.reading import read_recording

        return read_recording(
            "ours" if self.trajectory is None else "maniskill", self.path, self.trajectory or ""
        )


@dataclass(frozen=True)
class Verdict:
    """One recorded episode as it was judged then, and as it is judged now."""

    file: EpisodeFile
    task: str = ""
    seed: int = -1
    length: int = 0
    """Control steps."""
    success: tuple[int | None, int | None] = (None, None)
    """The first state at which it was true, then and now; None for never."""
    fail: tuple[int | None, int | None] = (None, None)
    has_success: bool = False
    returns: tuple[float, float] = (0.0, 0.0)
    largest: float = 0.0
    """The largest change of one reward."""
    first_difference: int | None = None
    """The first state of which the reward, success or fail is another; None where all are as they were."""
    differing: tuple[str, ...] = ()
    """Further entries of ``evaluate`` that are others somewhere."""
    metres: float | None = None
    """How far the body that was furthest from the record was; None where it holds no states to compare with."""
    drift_at: int | None = None
    """The state at which that was."""
    begins_otherwise: bool = False
    """The reset with its seed gave another first state, and the recorded one was put in its place."""
    missed: dict[str, str] = field(default_factory=dict)
    """What of the record could not be put into the env, and why."""
    why_not: str = ""
    """Why it was not judged; all else is then empty."""
    old_reward: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    new_reward: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))

    @property
    def differs(self) -> bool:
        """Whether reward, success or fail is another now."""
        return self.first_difference is not None

    @property
    def drifted(self) -> bool:
        """Whether what differs may come of other states and not of the code."""
        return self.metres is not None and self.metres > FAR_METRES


@dataclass(frozen=True)
class Rescored:
    """How far a `Rescore` is, or its end."""

    verdicts: tuple[Verdict, ...]
    """New ones."""
    steps: int
    """Control steps of all its episodes so far."""
    problem: Problem | None = None
    """What the task's code raised; then it goes no further."""


@dataclass(frozen=True)
class Rescore(Question[Rescored]):
    """Have a worker with the task open judge these episodes; each `Progress.part` is a `Rescored`."""

    files: tuple[EpisodeFile, ...]
    use_env_states: bool

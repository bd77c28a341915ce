"""Recorded episodes that are to be judged again, and what is said of them: plain data that crosses a pipe."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from workbench.authoring.problem import Problem
from workbench.recording.episode import Episode
from workbench.session.calls import Question
from workbench.session.verdict import Verdict


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
class Rescored:
    """How far a `Rescore` is, or its end."""

    verdicts: tuple[Verdict[EpisodeFile], ...]
    """New ones."""
    steps: int
    """Control steps of all its episodes so far."""
    problem: Problem | None = None
    """What the task's code raised; then it goes no further."""


@dataclass(frozen=True)
class Rescore(Question[Rescored]):
    """Have a worker with the task open judge these episodes; each `Progress.part` is a `Rescored`."""

    part: ClassVar[Any] = Rescored
    files: tuple[EpisodeFile, ...]
    use_env_states: bool

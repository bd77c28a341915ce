"""Recorded episodes that are to be judged again, and what is said of them: plain data that crosses a pipe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from workbench.authoring.problem import Problem
from workbench.jobs.wire import Question
from workbench.recording.sources import Source
from workbench.session.verdict import Verdict


@dataclass(frozen=True)
class Rescored:
    """How far a `Rescore` is, or its end."""

    verdicts: tuple[Verdict[Source], ...]
    """New ones."""
    steps: int
    """Control steps of all its episodes so far."""
    problem: Problem | None = None
    """What the task's code raised; then it goes no further."""


@dataclass(frozen=True)
class Rescore(Question[Rescored]):
    """Have a worker with the task open judge these episodes; each `Progress.part` is a `Rescored`."""

    part: ClassVar[Any] = Rescored
    files: tuple[Source, ...]
    use_env_states: bool

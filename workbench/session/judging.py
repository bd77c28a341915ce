"""How far runs are judged again, and what it came to: what a page shows, of the past and of recordings alike."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal

from workbench.authoring.problem import Problem
from workbench.session.verdict import Verdict


class StoppedBy(Enum):
    """Why it ended before it was done; the value is what the page says."""

    HAND = "stopped by hand"
    SAVE = "the file was saved again"
    LOAD = "another version was loaded"
    LOSS = "the episodes are gone"
    CLOSING = "closing"


JudgedState = Literal["none", "asking", "loading", "judging", "done", "stopped", "failed"]
RUNNING: tuple[JudgedState, ...] = ("asking", "loading", "judging")


@dataclass(frozen=True)
class JudgedView:
    state: JudgedState = "none"
    """``asking`` whether the code may run; ``loading``: it is being loaded by the process that judges."""
    serial: int = 0
    """Grows with every change."""
    verdicts: tuple[Verdict[Any], ...] = ()
    """Those that are known, also of a part of a run that is not judged whole."""
    done: int = 0
    total: int = 0
    unit: str = "steps"
    """What is counted: control steps of the batch, or ``episodes``."""
    steps: int = 0
    """Control steps that were made."""
    seconds: float = 0.0
    """That they took, without loading."""
    task: str = ""
    """What is judged with."""
    stopped_by: StoppedBy | None = None
    why: str = ""
    """Why it stopped or failed, in words."""
    problem: Problem | None = None
    """What the code raised."""
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    """A sentence each: what could not be put back, and files beside a task that no import finds."""
    names: tuple[str, ...] = ()
    """What the past has a curve of: ``reward`` first, then what differs, then the rest."""
    differing_names: frozenset[str] = frozenset()

    @property
    def rate(self) -> float:
        """Control steps a second; 0 while that is not known."""
        return self.steps / self.seconds if self.seconds > 0.5 else 0.0

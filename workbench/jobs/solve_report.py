"""What came of solving a task from many seeds, as plain data. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from statistics import median

from workbench.planning.verdicts import Verdict


@dataclass(frozen=True)
class SolvedSeed:
    """What came of one seed."""

    seed: int
    solved_at: int
    """The control step of its success, from 1 on; 0 without one."""
    steps: int
    total_reward: float
    """Over all steps, those after its success too."""
    seconds: float
    """Wall time of its plans."""
    in_the_way: str
    """Why it was not solved; empty if it was."""
    path: Path
    """Its recording."""


@dataclass(frozen=True)
class SolveReport:
    """What came of all seeds that were tried to the end."""

    seeds: tuple[SolvedSeed, ...]
    verdicts: tuple[Verdict, ...]
    seconds: float
    """Wall time, opening the task included."""
    stopped: bool
    """It was stopped before all seeds were tried."""

    @property
    def solved(self) -> tuple[SolvedSeed, ...]:
        return tuple(one for one in self.seeds if one.solved_at)

    @property
    def median_steps(self) -> float | None:
        """Of the solved seeds, to their success; None without one."""
        return median(one.solved_at for one in self.solved) if self.solved else None

    @property
    def fails(self) -> bool:
        """Whether the reward breaks a rule, or no seed was solved."""
        return bool(self.verdicts) or not self.solved

    @property
    def summary(self) -> str:
        """``Solved 14 of 16 seeds, in 9 control steps (median). 61 s.``"""
        steps = "" if self.median_steps is None else f", in {self.median_steps:g} control steps (median)"
        return f"Solved {len(self.solved)} of {len(self.seeds)} seeds{steps}. {self.seconds:.0f} s."

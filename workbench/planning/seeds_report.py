"""Results of solving a task's seeds by planning, complete or so far.

Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from workbench.planning.verdicts import MIN_EPISODES, MIN_SEEDS, RewardVerdict


@dataclass(frozen=True)
class SolvedSeed:
    """Result of one seed."""

    seed: int
    solved_at: int
    """Control step of the first success, counted from 1; 0 without success."""
    steps: int
    total_reward: float
    """Sum of the rewards of all steps, including the steps after success."""
    seconds: float
    """Wall time of all plans of the seed."""
    in_the_way: str
    """Why the seed was not solved; empty if it was solved."""
    path: Path
    """Path of the recording."""
    cut_off: bool = False
    """Whether the seed ended at its wall time limit."""


@dataclass(frozen=True)
class SolveReport:
    """Results of all finished seeds."""

    seeds: tuple[SolvedSeed, ...]
    verdicts: tuple[RewardVerdict, ...]
    """Verdicts over the seeds so far; empty unless there are enough seeds (`has_enough_seeds`). May change with more seeds."""
    seconds: float
    """Wall time, including the opening of the task."""
    stopped: bool
    """Whether the job was stopped before all seeds were tried."""
    wanted: int
    """Number of requested seeds."""

    @property
    def solved(self) -> tuple[SolvedSeed, ...]:
        return tuple(one for one in self.seeds if one.solved_at)

    @property
    def median_steps(self) -> float | None:
        """Median control steps to success over the solved seeds; None if no seed is solved."""
        return median(one.solved_at for one in self.solved) if self.solved else None

    @property
    def has_enough_seeds(self) -> bool:
        """Whether there are enough seeds for verdicts: the next seeds may refute what the first ones show."""
        return len(self.seeds) >= min(MIN_EPISODES, self.wanted)

    @property
    def so_far(self) -> str:
        """``after 3 of 8 seeds``; empty once all are done."""
        done = len(self.seeds)
        return f"after {done} of {self.wanted} seeds" if done < self.wanted else ""

    @property
    def summary(self) -> str:
        """``Solved 14 of 16 seeds, in 9 control steps (median). 61 s.``; while seeds are left, ``3 of 16
        seeds are done, 2 solved ...``."""
        done, solved = len(self.seeds), len(self.solved)
        steps = "" if self.median_steps is None else f", in {self.median_steps:g} control steps (median)"
        what = f"Solved {solved} of {_seeds(done)}"
        if done < self.wanted:
            what = f"{done} of {_seeds(self.wanted)} {'is' if done == 1 else 'are'} done, {solved} solved"
        return f"{what}{steps}. {self.seconds:.0f} s."

    @property
    def notes(self) -> tuple[str, ...]:
        """Limits of the result, as sentences."""
        found = []
        if not self.has_enough_seeds:
            found.append(f"Verdicts on the reward need at least {MIN_EPISODES} seeds.")
        if self.wanted < MIN_SEEDS:
            found.append(few_seeds_text(self.wanted))
        if cut := sum(one.cut_off and not one.solved_at for one in self.seeds):
            found.append(
                f"{_seeds(cut)} reached the wall time limit: on another machine, or in another run, other seeds "
                "may be solved."
            )
        return tuple(found)


def few_seeds_text(count: int) -> str:
    """Warning about a result of fewer seeds than `verdicts.MIN_SEEDS`."""
    be = "is" if count == 1 else "are"
    return f"{_seeds(count)} {be} few: problems of a reward may not show with fewer than {MIN_SEEDS}."


def underway_text(running: Mapping[int, int], limit: int) -> str:
    """``seed 2 at step 12 of 50``; ``seeds 2 and 3 at steps 12 and 7 of 50``; empty if none runs.

    Args:
        running: control steps so far, by seed.
    """
    seeds = sorted(running)
    plural = "" if len(seeds) == 1 else "s"
    named, steps = (
        " and ".join(", ".join(map(str, each)).rsplit(", ", 1))
        for each in (seeds, [running[seed] for seed in seeds])
    )
    return f"seed{plural} {named} at step{plural} {steps} of {limit}" if seeds else ""


def _seeds(count: int) -> str:
    return f"{count} seed{'' if count == 1 else 's'}"

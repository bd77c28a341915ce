"""Compares a run's recorded reward and evaluate with those of the current code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from workbench.envs.step_result import StepResult
from workbench.episodes.equal_numbers import gap, too_far
from workbench.episodes.row import Source
from workbench.machine.processes.wire import Question
from workbench.task.description import TaskOptions
from workbench.task.problem import Problem
from workbench.task.reference import TaskName

DOUBTFUL_METRES, DOUBTFUL_RADIANS = 1e-3, 1e-2
"""Distance and rotation of a body from the recorded state beyond which a comparison is doubtful."""
FLAGS = ("success", "fail")
MAIN = ("reward", *FLAGS)
Of = TypeVar("Of")


@dataclass(frozen=True)
class Scores:
    """Reward of a run, and the entries of evaluate that are scalars or flags."""

    reward: NDArray
    """(T,) rewards; empty if none was recorded."""
    evaluate: Mapping[str, NDArray]
    """(T + 1,) values of each entry; NaN in states without the entry."""
    has_reward: bool = True
    """False for a task without a reward (``reward_mode="none"``), whose `reward` is zeros."""


@dataclass(frozen=True, eq=False)
class Verdict(Generic[Of]):
    """Comparison of one run: T control steps and T + 1 states. It covers all steps that have both recorded
    and new scores, even those after a step at which the current code would have ended the episode.

    Rescoring replays the run, so the verdict also has the distance of the replayed states from the recorded
    ones.
    """

    of: Of
    """The run: a recording, or an env's part of the history."""
    task: str = ""
    seed: int = -1
    length: int = 0
    """Control steps."""
    success: tuple[int | None, int | None] = (None, None)
    """Step of the episode after which success is true for the first time: (recorded, rescored); None if
    never."""
    fail: tuple[int | None, int | None] = (None, None)
    has: tuple[str, ...] = ("reward",)
    """Names among reward, success and fail that the record or the current code has."""
    returns: tuple[float, float] = (0.0, 0.0)
    """Sums of the rewards, as (recorded, rescored)."""
    largest: float = 0.0
    """Largest absolute change of the reward of a step."""
    first_difference: int | None = None
    """The first step whose reward, success or fail differs; None if all are equal."""
    look_at: int | None = None
    """Step to show: where success or fail differs, else where the reward differs most."""
    differing: tuple[str, ...] = ()
    """Names that differ at any step: ``reward``, and entries of ``evaluate``."""
    metres: float | None = None
    """Largest distance in metres of a body from the recorded state; None if there are no states."""
    radians: float = 0.0
    """Largest rotation in radians of a body or joint from the recorded state."""
    drift_at: int | None = None
    """Step after which a body was furthest from the recorded state."""
    start_differs: bool = False
    """Whether the reset with the recorded seed gave another first state, so that the recorded state was
    restored."""
    missed: dict[str, str] = field(default_factory=dict)
    """Name and reason of each part of the state that could not be restored into the env."""
    why_not: str = ""
    """Reason why the run was not rescored; the results of the comparison are then empty."""
    damaged: bool = False
    """Whether some files of the recording cannot be read."""
    old_reward: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    new_reward: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))

    @property
    def has_success(self) -> bool:
        return "success" in self.has

    @property
    def differs(self) -> bool:
        """Whether reward, success or fail differs."""
        return self.first_difference is not None

    @property
    def others(self) -> tuple[str, ...]:
        """`differing` without reward, success and fail."""
        return tuple(name for name in self.differing if name not in MAIN)

    @property
    def drifted(self) -> bool:
        """Whether a difference may come from different states instead of the code."""
        return self.metres is not None and not (
            self.metres <= DOUBTFUL_METRES and self.radians <= DOUBTFUL_RADIANS
        )


def compare(
    of: Of,
    old: Scores,
    new: Scores,
    drift: NDArray | None = None,
    *,
    begin: int = 0,
    task: str = "",
    seed: int = -1,
    start_differs: bool = False,
    missed: Mapping[str, str] | None = None,
    damaged: bool = False,
) -> Verdict[Of]:
    """Compare recorded scores with new ones.

    Args:
        old: recorded scores, at least as long as `new`.
        drift: (T + 1, 2) largest distance (m) and rotation (rad) of a body from each recorded state; None if
            unknown.
        begin: number of steps of the episode before the run.
    """
    steps = len(new.reward)
    has = {"reward": old.has_reward or new.has_reward}
    has |= {name: name in old.evaluate or name in new.evaluate for name in FLAGS}
    both = [n for n, values in new.evaluate.items() if len(old.evaluate.get(n, ())) >= len(values)]
    names = ("reward", *both)
    # All entries are in one array for speed: this is called for hundreds of runs several times a second.
    was, now = np.full((2, len(names), steps + 1), np.nan)
    if len(old.reward):
        was[0, 1:], now[0, 1:] = old.reward[:steps], new.reward
    for row, name in enumerate(both, 1):
        length = len(new.evaluate[name])
        was[row, :length], now[row, :length] = old.evaluate[name][:length], new.evaluate[name]
    apart = gap(was, now)
    differs = too_far(was, apart, axis=1)
    # A missing first value is not a difference: many files lack values for the first state of a run.
    differs[:, 0] &= ~np.isnan(was[:, 0])
    others = {name: differs[row].nonzero()[0] for row, name in enumerate(names)}
    turned: dict[str, tuple[int | None, int | None]] = {}
    for name in FLAGS:
        flags = [_flag(scores.evaluate.get(name), steps + 1) for scores in (old, new)]
        others[name] = (flags[0] != flags[1]).nonzero()[0]
        turned[name] = _first(flags[0], begin), _first(flags[1], begin)
    differing = tuple(name for name in dict.fromkeys((*MAIN, *new.evaluate)) if len(others.get(name, ())))
    first = min((begin + int(others[name][0]) for name in MAIN if name in differing), default=None)
    look_at = first
    if "reward" in differing:
        look_at = begin + int(apart[0].argmax())
    for then, now in (turned["fail"], turned["success"]):
        if then != now:
            look_at = then if now is None else now
    metres, radians, drift_at = None, 0.0, None
    if drift is not None:
        far = int(drift[:, 0].argmax())
        metres, radians = float(drift[far, 0]), float(drift[:, 1].max())
        drift_at = begin + far if metres else None
    return Verdict(
        of=of,
        task=task,
        seed=seed,
        length=steps,
        success=turned["success"],
        fail=turned["fail"],
        has=tuple(name for name, there in has.items() if there),
        returns=(float(was[0, 1:].sum()), float(np.asarray(new.reward, np.float64).sum())),
        largest=float(apart[0].max()),
        first_difference=first,
        look_at=look_at,
        differing=differing,
        metres=metres,
        radians=radians,
        drift_at=drift_at,
        start_differs=start_differs,
        missed=dict(missed or {}),
        damaged=damaged,
        old_reward=was[0, 1:].astype(np.float32),
        new_reward=np.asarray(new.reward, np.float32),
    )


def by_change(verdicts: Sequence[Verdict[Of]]) -> list[Verdict[Of]]:
    """The runs with the largest change first: a changed success counts most, then a changed fail, then the
    change of the return. Unchanged runs come after these, and unrescored runs last."""

    def key(verdict: Verdict[Of]) -> tuple[bool, bool, int, float]:
        moved = 2 * (verdict.success[0] != verdict.success[1]) + (verdict.fail[0] != verdict.fail[1])
        change = float(gap(*map(np.atleast_1d, verdict.returns))[0])
        return bool(verdict.why_not), not verdict.differs, -moved, -change

    return sorted(verdicts, key=key)


def scalar_entries(evaluate: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """The entries of `evaluate` with one number or flag per row, as (n,) arrays.

    Args:
        evaluate: (n, ...) values of each entry.
    """
    return {
        # An author's entry may be called "reward" too, but it is not the reward.
        "evaluate/reward" if name == "reward" else name: values.reshape(len(values))
        for name, values in evaluate.items()
        if values.dtype.kind in "fiub" and values.shape in ((len(values),), (len(values), 1))
    }


def _first(flag: NDArray[np.bool_], begin: int) -> int | None:
    return begin + int(flag.argmax()) if flag.any() else None


def _flag(values: NDArray | None, states: int) -> NDArray[np.bool_]:
    """(states,) values of a flag entry; False in the states without a value."""
    found = np.zeros(states, bool)
    if values is not None:
        found[: len(values)] = values[:states] > 0.5
    return found


# --- questions to a worker -------------------------------------------------------------------------


@dataclass(frozen=True)
class Rescored:
    """Part of the result of rescoring some episodes."""

    verdicts: tuple[Verdict[Source], ...]
    steps: int
    """Control steps since the previous part, over all episodes."""
    problem: Problem | None = None
    """Exception of the task's code, which ended the rescoring."""


@dataclass(frozen=True)
class Rescore(Question[Rescored]):
    """Open a task in a worker that has no open task, and rescore these episodes with it. All results are sent
    as parts. The first part is empty and is sent when the task is open; the answer contains only the
    exception of the code, if it raised."""

    part: ClassVar[Any] = Rescored
    task: TaskName
    options: TaskOptions
    or_else: TaskOptions
    """Options to use if the task cannot be opened with `options`."""
    files: tuple[Source, ...]
    use_env_states: bool


# The server keeps the history and sends snapshots and actions. As in the recorded run, all envs of the batch
# step together: they may depend on each other through a shared random generator. Send these questions only to
# a worker that does not play: they move its envs.


@dataclass(frozen=True)
class MomentToRescore:
    """A past moment to replay: a control step, or a jump if it has a snapshot."""

    action: NDArray[np.float32] | None
    """(N, A) action; None for a jump, or a task without robots."""
    snapshot: bytes | None = None
    """A pickled `envs.snapshots.snapshot.Snapshot` of the whole batch."""
    env_idx: tuple[int, ...] = ()
    """The envs that are restored from the snapshot."""


@dataclass(frozen=True)
class RescoredMoments:
    """Reward and evaluate of past moments by the current code."""

    steps: tuple[StepResult, ...]
    """One result for each moment; fewer if one raised."""
    not_carried: dict[str, str]
    """State that jumps of all envs could not restore, with the reasons."""
    problem: Problem | None = None
    """Exception at the first moment without a result in `steps`."""


@dataclass(frozen=True)
class RescoreMoments(Question[RescoredMoments]):
    """Replay these moments in order."""

    moments: tuple[MomentToRescore, ...]

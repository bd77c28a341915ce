"""What is said of a run now, compared with what was said of it when it was recorded.

A run is what one env lives through: T control steps and T + 1 states. It is compared as far as both were said, also where
today's code would have ended it before. What is judged is the run anew and not the record, so how far it came from the
record belongs to each verdict.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from workbench.authoring.problem import Problem
from workbench.machine.processes.wire import Question
from workbench.recording.episode.row import Source

SAME_SHARE, SAME_NUMBER = 1e-5, 1e-7
"""Numbers that differ by no more than this share of the largest recorded one, or by no more than this, are the same."""
DOUBTFUL_METRES, DOUBTFUL_RADIANS = 1e-3, 1e-2
"""A body further than this from the record makes a comparison doubtful."""
FLAGS = ("success", "fail")
_MAIN = ("reward", *FLAGS)
Of = TypeVar("Of")


@dataclass(frozen=True)
class Scores:
    """What a task says of a run, as far as it is one number or flag."""

    reward: NDArray
    """(T,); empty where none was recorded."""
    evaluate: Mapping[str, NDArray]
    """(T + 1,) each; NaN in a state without it."""


@dataclass(frozen=True, eq=False)
class Verdict(Generic[Of]):
    """One run as it was judged then, and as it is judged now."""

    of: Of
    """Where the run is."""
    task: str = ""
    seed: int = -1
    length: int = 0
    """Control steps."""
    success: tuple[int | None, int | None] = (None, None)
    """The first step of the episode after which it was true, then and now; None for never."""
    fail: tuple[int | None, int | None] = (None, None)
    has_success: bool = False
    returns: tuple[float, float] = (0.0, 0.0)
    largest: float = 0.0
    """The largest change of one reward."""
    first_difference: int | None = None
    """The first step of which the reward, success or fail is another; None where all are as they were."""
    look_at: int | None = None
    """The step to look at: where success or fail is, or else where the reward differs most."""
    differing: tuple[str, ...] = ()
    """``reward``, and the entries of ``evaluate``, that are others somewhere."""
    metres: float | None = None
    """How far the body that was furthest from the record was; None where it holds no states to compare with."""
    radians: float = 0.0
    """How much the body or joint that was turned most was."""
    drift_at: int | None = None
    """The step after which the body was furthest."""
    start_differs: bool = False
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
    def others(self) -> tuple[str, ...]:
        """Those of `differing` that are neither reward, success nor fail."""
        return tuple(name for name in self.differing if name not in _MAIN)

    @property
    def drifted(self) -> bool:
        """Whether what differs may come of other states and not of the code."""
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
) -> Verdict[Of]:
    """Compare what was recorded with what is said now.

    Args:
        old: as long as `new`, or longer.
        drift: (T + 1, 2) metres and radians that the furthest body is from the record in each state; None if not known.
        begin: the steps of its episode that were made before the run.
    """
    steps = len(new.reward)
    both = [n for n, values in new.evaluate.items() if len(old.evaluate.get(n, ())) >= len(values)]
    names = ("reward", *both)
    # All numbers at once: there are some ten, of hundreds of runs, several times a second.
    was, now = np.full((2, len(names), steps + 1), np.nan)
    if len(old.reward):
        was[0, 1:], now[0, 1:] = old.reward[:steps], new.reward
    for row, name in enumerate(both, 1):
        length = len(new.evaluate[name])
        was[row, :length], now[row, :length] = old.evaluate[name][:length], new.evaluate[name]
    apart = gap(was, now)
    differs = _too_far(was, apart, axis=1)
    # Many a file says nothing of the state that a run begins with.
    differs[:, 0] &= ~np.isnan(was[:, 0])
    others = {name: differs[row].nonzero()[0] for row, name in enumerate(names)}
    turned: dict[str, tuple[int | None, int | None]] = {}
    for name in FLAGS:
        flags = [_flag(said.evaluate.get(name), steps + 1) for said in (old, new)]
        others[name] = (flags[0] != flags[1]).nonzero()[0]
        turned[name] = _first(flags[0], begin), _first(flags[1], begin)
    differing = tuple(name for name in dict.fromkeys((*_MAIN, *new.evaluate)) if len(others.get(name, ())))
    first = min((begin + int(others[name][0]) for name in _MAIN if name in differing), default=None)
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
        has_success="success" in old.evaluate or "success" in new.evaluate,
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
        old_reward=was[0, 1:].astype(np.float32),
        new_reward=np.asarray(new.reward, np.float32),
    )


def in_order(verdicts: Sequence[Verdict[Of]]) -> list[Verdict[Of]]:
    """What changed most first: success, fail, then return; what is as it was, and what was not judged, last."""

    def key(verdict: Verdict[Of]) -> tuple[bool, bool, int, float]:
        moved = 2 * (verdict.success[0] != verdict.success[1]) + (verdict.fail[0] != verdict.fail[1])
        change = float(gap(*map(np.atleast_1d, verdict.returns))[0])
        return bool(verdict.why_not), not verdict.differs, -moved, -change

    return sorted(verdicts, key=key)


def single_numbers(evaluate: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """The entries that are one number or flag in each row, (n,) of them; of `evaluate`, (n, ...) each."""
    return {
        # Nobody keeps an author from calling an entry so, and it is not the reward.
        "evaluate/reward" if name == "reward" else name: values.reshape(len(values))
        for name, values in evaluate.items()
        if values.dtype.kind in "fiub" and values.shape in ((len(values),), (len(values), 1))
    }


def gap(old: NDArray, new: NDArray) -> NDArray[np.float64]:
    """How far apart; infinite where one is not a number, zero where both are not or are the same infinity."""
    a, b = np.asarray(old, np.float64), np.asarray(new, np.float64)
    with np.errstate(invalid="ignore"):
        apart = np.abs(b - a)
    if not np.isfinite(apart).all():
        apart[(np.isnan(a) & np.isnan(b)) | (a == b)] = 0.0
        apart[np.isnan(apart)] = np.inf
    return apart


def unlike(old: NDArray, new: NDArray, least: float = SAME_NUMBER) -> NDArray[np.bool_]:
    """Where numbers are not the same.

    Args:
        least: what differs by no more is the same.
    """
    return _too_far(old, gap(old, new), least)


def _too_far(
    old: NDArray, apart: NDArray, least: float = SAME_NUMBER, axis: int | None = None
) -> NDArray[np.bool_]:
    """Where new ones that are so far `apart` are not the same; with `axis` 1 each row is one of its own."""
    if not apart.any():
        return apart > 0
    scale = np.abs(old).max(axis=axis, initial=0.0, where=np.isfinite(old), keepdims=True)
    return apart > np.maximum(SAME_SHARE * scale, least)


def _first(flag: NDArray[np.bool_], begin: int) -> int | None:
    return begin + int(flag.argmax()) if flag.any() else None


def _flag(values: NDArray | None, states: int) -> NDArray[np.bool_]:
    """(states,) of an entry that is a flag: False where it is not said."""
    found = np.zeros(states, bool)
    if values is not None:
        found[: len(values)] = values[:states] > 0.5
    return found


# --- recordings judged again -------------------------------------------------------------------------


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
    """Have a worker with the task open read and judge these episodes; what is told meanwhile are `Rescored` too."""

    part: ClassVar[Any] = Rescored
    files: tuple[Source, ...]
    use_env_states: bool

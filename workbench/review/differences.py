"""Compares two recordings: the first step at which bodies and numbers differ."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from workbench.envs.recorded_run import pose_distances
from workbench.episodes.episode import Episode
from workbench.episodes.equal_numbers import gap, numbers_differ
from workbench.machine.text import length, number_text

ARM_METRES = 0.1
"""Lever arm of rotations: a rotation counts as the distance by which a point this far from the body's origin moves."""
TOLERANCES_METRES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
"""Selectable tolerances. A replay on other threads or another machine differs by 1e-6 to 1e-5."""
DEFAULT_TOLERANCE_METRES = 1e-4
_MIN_DIFFERENCE = 1e-5
"""Smaller differences of numbers count as equal: a replay on another machine differs by less."""
_MAX_LINES = 600


@dataclass(frozen=True)
class FirstDifference:
    """The first and the largest difference of one quantity, as text."""

    name: str
    position: int | None
    """Position relative to the alignment; None if nothing differs."""
    values: str
    """Both values at that position."""
    largest: str
    """The largest difference."""
    totals: str = ""
    """Both sums over the episode, if a sum makes sense."""


@dataclass(frozen=True)
class Difference:
    """The differences between two recordings.

    With the same seed, two versions of a task simulate the same episode up to some step; from that step on
    everything differs slightly. So the comparison finds the first step that differs, for each quantity
    separately, and the first body that differs.
    """

    bodies: FirstDifference | None
    """First difference of bodies; None if one of the recordings has no scene."""
    body: str
    """The body that differs first; empty if none differs."""
    apart: NDArray[np.float64]
    """(K,) for each compared state, from `begin` on: the largest of the bodies' `distances` between the two
    recordings."""
    begin: int
    """Position of the first compared state."""
    compared: int
    """Number of compared states."""
    not_in_both: tuple[str, ...]
    """Bodies that only one of the recordings has."""
    numbers: tuple[FirstDifference, ...]
    """Action, reward, and the entries of ``evaluate``; those that differ come first, in the order of their
    first difference."""
    same_seed: bool
    same_source: bool | None
    """Whether both recordings contain the same source; None if one of them contains none."""
    source: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]
    """For each file that differs: its name, and its changed lines with context as (kind, text). The kind is
    ``add``, ``del``, ``at`` or ``same``."""


def difference(
    a: Episode, b: Episode, anchors: tuple[int, int], tolerance: float = DEFAULT_TOLERANCE_METRES
) -> Difference:
    """The differences of `b` from `a`.

    Args:
        anchors: The state of each recording at position 0.
        tolerance: Distance in metres above which a body's pose differs.
    """
    begin = max(-anchors[0], -anchors[1])
    end = min(len(a.reward) - anchors[0], len(b.reward) - anchors[1])
    count = end - begin + 1  # at least position 0, which is a state of both
    rows = (
        slice(begin + anchors[0], begin + anchors[0] + count),
        slice(begin + anchors[1], begin + anchors[1] + count),
    )
    bodies, body, apart = _bodies_difference(a, b, rows, begin, tolerance)
    numbers = [_first_difference("action", *_steps(a.action, b.action, rows), begin)]
    if a.info.has_reward or b.info.has_reward:
        numbers.append(
            _first_difference("reward", *_steps(a.reward, b.reward, rows), begin, sum_of=(a.reward, b.reward))
        )
    for name in dict.fromkeys([*a.evaluate, *b.evaluate]):
        if name in a.evaluate and name in b.evaluate:
            numbers.append(
                _first_difference(name, a.evaluate[name][rows[0]], b.evaluate[name][rows[1]], begin)
            )
        else:
            numbers.append(FirstDifference(name, None, f"only in {'A' if name in a.evaluate else 'B'}", ""))
    numbers.sort(key=lambda found: (found.position is None, found.position or 0))
    hashes = a.info.source_hash, b.info.source_hash
    return Difference(
        bodies=bodies,
        body=body,
        apart=apart,
        begin=begin,
        compared=count,
        not_in_both=_not_in_both(a, b),
        numbers=tuple(numbers),
        same_seed=a.info.seed == b.info.seed and a.info.seed >= 0,
        same_source=hashes[0] == hashes[1] if all(hashes) else None,
        source=source_changes(a.info.source, b.info.source),
    )


def source_changes(
    before: Mapping[str, str], after: Mapping[str, str]
) -> tuple[tuple[str, tuple[tuple[str, str], ...]], ...]:
    """Each file that differs: its name, and the changed lines with two lines of context."""
    found = []
    if not set(before) & set(after):
        # Recorded from two folders: match files by name.
        before, after = (
            {PurePath(name).name: text for name, text in texts.items()} for texts in (before, after)
        )
    pairs = {name: (before.get(name, ""), after.get(name, "")) for name in dict.fromkeys([*before, *after])}
    gone, new_ones = next(iter(before), None), next(iter(after), None)
    if gone is not None and new_ones is not None and gone not in after and new_ones not in before:
        # The task's own file comes first in both. If it was renamed, compare the old file with the new one,
        # or all its lines would count as changed.
        del pairs[gone], pairs[new_ones]
        pairs = {f"{gone} → {new_ones}": (before[gone], after[new_ones]), **pairs}
    for name, (old, new) in pairs.items():
        if old == new:
            continue
        lines: list[tuple[str, str]] = []
        for line in list(difflib.unified_diff(old.splitlines(), new.splitlines(), lineterm="", n=2))[2:]:
            kind = {"+": "add", "-": "del", "@": "at"}.get(line[:1], "same")
            lines.append((kind, line))
        if len(lines) > _MAX_LINES:
            lines = [*lines[:_MAX_LINES], ("at", f"… and {len(lines) - _MAX_LINES} more lines")]
        found.append((name, tuple(lines)))
    return tuple(found)


def _bodies_difference(
    a: Episode, b: Episode, rows: tuple[slice, slice], begin: int, tolerance: float
) -> tuple[FirstDifference | None, str, NDArray[np.float64]]:
    nothing = np.zeros(0)
    if a.geometry is None or b.geometry is None or a.poses is None or b.poses is None:
        return None, "", nothing
    there = {name: row for row, name in enumerate(b.geometry.body_names)}
    names = [name for name in a.geometry.body_names if name in there]
    if not names:
        return None, "", nothing
    own = [row for row, name in enumerate(a.geometry.body_names) if name in there]
    away = distances(a.poses[rows[0]][:, own], b.poses[rows[1]][:, [there[name] for name in names]])
    apart = away.max(axis=1, initial=0.0)
    off = np.flatnonzero(apart > tolerance)
    if not len(off):
        return FirstDifference("bodies", None, "", _distance_text(float(apart.max(initial=0.0)))), "", apart
    first = int(off[0])
    body = names[int(away[first].argmax())]
    worst = int(apart.argmax())
    found = FirstDifference(
        "bodies",
        begin + first,
        f"{body}, {_distance_text(float(apart[first]))}",
        f"{_distance_text(float(apart[worst]))} ({names[int(away[worst].argmax())]})",
    )
    return found, body, apart


def distances(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    """(...,) distance in metres between poses (..., 7), plus `ARM_METRES` times the angle between them in
    radians; 0 if both recordings lack the body, inf if only one of them has it."""
    metres, radians = pose_distances(a, b)
    return metres + ARM_METRES * radians


def _steps(a: NDArray, b: NDArray, rows: tuple[slice, slice]) -> tuple[NDArray, NDArray]:
    """Values of steps at the states of `rows`; NaN at state 0 of a recording, to which no step led."""
    padded = [np.concatenate([np.full((1, *x.shape[1:]), np.nan), np.asarray(x, np.float64)]) for x in (a, b)]
    return padded[0][rows[0]], padded[1][rows[1]]


def _first_difference(
    name: str,
    a: NDArray,
    b: NDArray,
    begin: int,
    sum_of: tuple[NDArray, NDArray] | None = None,
) -> FirstDifference:
    totals = "" if sum_of is None else " → ".join(number_text(float(np.sum(x))) for x in sum_of)
    if a.shape[1:] != b.shape[1:]:
        return FirstDifference(name, begin, f"shape {a.shape[1:]} → {b.shape[1:]}", "", totals)
    yes = a.dtype.kind == "b" and b.dtype.kind == "b"
    one, two = (np.asarray(x, np.float64).reshape(len(x), -1) for x in (a, b))
    differs = numbers_differ(one, two, _MIN_DIFFERENCE)
    rows = np.flatnonzero(differs.any(axis=1))
    if not len(rows):
        return FirstDifference(name, None, "", "", totals)
    first = int(rows[0])
    column = int(np.flatnonzero(differs[first])[0])
    old, new = (_value_text(x[first, column], yes, first) for x in (one, two))
    label = "" if one.shape[1] == 1 else f"[{column}] "
    apart = gap(one, two)
    largest = "" if yes else number_text(float(apart[np.isfinite(apart)].max(initial=0.0)), ".3g")
    return FirstDifference(name, begin + first, f"{label}{old} → {new}", largest, totals)


def _value_text(value: float, yes: bool, row: int) -> str:
    if yes:
        return "yes" if value else "no"
    # The first compared row may be an episode's first state, where values of steps are NaN (see `_steps`).
    return "—" if np.isnan(value) and row == 0 else number_text(value)


def _not_in_both(a: Episode, b: Episode) -> tuple[str, ...]:
    if a.geometry is None or b.geometry is None:
        return ()
    one, two = set(a.geometry.body_names), set(b.geometry.body_names)
    return (
        *(f"{name} (only in A)" for name in sorted(one - two)),
        *(f"{name} (only in B)" for name in sorted(two - one)),
    )


def _distance_text(metres: float) -> str:
    return length(metres) if np.isfinite(metres) else "missing in one"

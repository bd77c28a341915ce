"""Where two recordings part: the first state at which bodies stand elsewhere, and what was said otherwise.

Two episodes of one seed under two versions of a task are the same simulation up to some step. That step, and the body
that moved first, is the answer to "what did my change do"; after it everything differs a little. So each quantity is
compared on its own, state by state from where the two are aligned, and its first difference is named.

Distances are of positions in metres. Turning is compared too, as the angle between the quaternions, which is put on
the same scale by an arm of `ARM`: a body that only turns has moved as well.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from workbench.core.capture.recorded_run import pose_distances
from workbench.jobs.verdict import gap, unlike
from workbench.machine.text import length, number_text
from workbench.recording.episode.episode import Episode

ARM = 0.1
"""Metres; a body of this size is thought at each pose, so that an angle is a way."""
TOLERANCES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
"""Metres. A replay on other threads or another machine differs by 1e-6 to 1e-5."""
USUAL_TOLERANCE = 1e-4
_LEAST = 1e-5
"""What numbers of two recordings differ by at least: a replay elsewhere differs by less."""
_MOST_LINES = 600


@dataclass(frozen=True)
class Parting:
    """The first difference of one quantity, and how far apart it gets."""

    name: str
    position: int | None
    """Counted from where the two are aligned; None while nothing differs."""
    first: str
    """Both values there, in words."""
    most: str
    """The largest difference, in words."""
    whole: str = ""
    """What each came to, for what adds up."""


@dataclass(frozen=True)
class Difference:
    bodies: Parting | None
    """None where one of them has no scene."""
    body: str
    """Which body is elsewhere first."""
    apart: NDArray[np.float64]
    """(K,) metres that the body that is farthest off is away, from `begin` on."""
    begin: int
    """Position of the first compared state."""
    compared: int
    """How many states of the two lie at the same positions."""
    not_in_both: tuple[str, ...]
    """Bodies that only one has."""
    numbers: tuple[Parting, ...]
    """Action, reward, and the entries of ``evaluate``; those that differ first, by when."""
    same_seed: bool
    same_source: bool | None
    """None where one of them has no source."""
    source: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]
    """File, and its changed lines as (``add``, ``del``, ``at`` or ``same``, text)."""


def difference(
    a: Episode, b: Episode, anchors: tuple[int, int], tolerance: float = USUAL_TOLERANCE
) -> Difference:
    """How `b` differs from `a`.

    Args:
        anchors: The state of each that lies at position 0.
        tolerance: Metres from which on a body counts as elsewhere.
    """
    begin = max(-anchors[0], -anchors[1])
    end = min(len(a.reward) - anchors[0], len(b.reward) - anchors[1])
    count = max(0, end - begin + 1)
    rows = (
        slice(begin + anchors[0], begin + anchors[0] + count),
        slice(begin + anchors[1], begin + anchors[1] + count),
    )
    bodies, body, apart = _bodies(a, b, rows, begin, tolerance)
    numbers = [_numbers("action", *_steps(a.action, b.action, rows), begin)]
    numbers.append(_numbers("reward", *_steps(a.reward, b.reward, rows), begin, whole=(a.reward, b.reward)))
    for name in dict.fromkeys([*a.evaluate, *b.evaluate]):
        if name in a.evaluate and name in b.evaluate:
            numbers.append(_numbers(name, a.evaluate[name][rows[0]], b.evaluate[name][rows[1]], begin))
        else:
            numbers.append(Parting(name, None, f"only in {'A' if name in a.evaluate else 'B'}", ""))
    numbers.sort(key=lambda parting: (parting.position is None, parting.position or 0))
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
    """Of each file that is not the same in both: its name, and the changed lines with two around them."""
    found = []
    if not set(before) & set(after):
        # Recorded from two folders: the same file all the same.
        before, after = (
            {PurePath(name).name: text for name, text in texts.items()} for texts in (before, after)
        )
    for name in dict.fromkeys([*before, *after]):
        old, new = before.get(name, ""), after.get(name, "")
        if old == new:
            continue
        lines: list[tuple[str, str]] = []
        for line in list(difflib.unified_diff(old.splitlines(), new.splitlines(), lineterm="", n=2))[2:]:
            kind = {"+": "add", "-": "del", "@": "at"}.get(line[:1], "same")
            lines.append((kind, line))
        if len(lines) > _MOST_LINES:
            lines = [*lines[:_MOST_LINES], ("at", f"… and {len(lines) - _MOST_LINES} more lines")]
        found.append((name, tuple(lines)))
    return tuple(found)


def _bodies(
    a: Episode, b: Episode, rows: tuple[slice, slice], begin: int, tolerance: float
) -> tuple[Parting | None, str, NDArray[np.float64]]:
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
        return Parting("bodies", None, "", _apart(float(apart.max(initial=0.0)))), "", apart
    first = int(off[0])
    body = names[int(away[first].argmax())]
    worst = int(apart.argmax())
    parting = Parting(
        "bodies",
        begin + first,
        f"{body}, {_apart(float(apart[first]))}",
        f"{_apart(float(apart[worst]))} ({names[int(away[worst].argmax())]})",
    )
    return parting, body, apart


def distances(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    """(..., ) metres between poses (..., 7), turning included; 0 where both lack the body, inf where one does."""
    metres, radians = pose_distances(a, b)
    return metres + ARM * radians


def _steps(a: NDArray, b: NDArray, rows: tuple[slice, slice]) -> tuple[NDArray, NDArray]:
    """What belongs to a step at the states of `rows`: NaN at a start, which no step led to."""
    padded = [np.concatenate([np.full((1, *x.shape[1:]), np.nan), np.asarray(x, np.float64)]) for x in (a, b)]
    return padded[0][rows[0]], padded[1][rows[1]]


def _numbers(
    name: str,
    a: NDArray,
    b: NDArray,
    begin: int,
    whole: tuple[NDArray, NDArray] | None = None,
) -> Parting:
    totals = "" if whole is None else " → ".join(number_text(float(np.sum(x))) for x in whole)
    if a.shape[1:] != b.shape[1:]:
        return Parting(name, begin, f"shape {a.shape[1:]} → {b.shape[1:]}", "", totals)
    yes = a.dtype.kind == "b" and b.dtype.kind == "b"
    one, two = (np.asarray(x, np.float64).reshape(len(x), -1) for x in (a, b))
    differs = unlike(one, two, _LEAST)
    rows = np.flatnonzero(differs.any(axis=1))
    if not len(rows):
        return Parting(name, None, "", "", totals)
    first = int(rows[0])
    column = int(np.flatnonzero(differs[first])[0])
    said = [_said(x[first, column], yes, first) for x in (one, two)]
    label = "" if one.shape[1] == 1 else f"[{column}] "
    apart = gap(one, two)
    most = "" if yes else number_text(float(apart[np.isfinite(apart)].max(initial=0.0)), ".3g")
    return Parting(name, begin + first, f"{label}{said[0]} → {said[1]}", most, totals)


def _said(value: float, yes: bool, row: int) -> str:
    if yes:
        return "yes" if value else "no"
    # A start, which no step led to, has NaN for what belongs to a step, and is the first row of those compared.
    return "—" if np.isnan(value) and row == 0 else number_text(value)


def _not_in_both(a: Episode, b: Episode) -> tuple[str, ...]:
    if a.geometry is None or b.geometry is None:
        return ()
    one, two = set(a.geometry.body_names), set(b.geometry.body_names)
    return (
        *(f"{name} (only in A)" for name in sorted(one - two)),
        *(f"{name} (only in B)" for name in sorted(two - one)),
    )


def _apart(metres: float) -> str:
    return length(metres) if np.isfinite(metres) else "missing in one"

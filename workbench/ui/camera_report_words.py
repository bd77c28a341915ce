"""A camera's report in words, rows and bars, as the page shows it: plain functions of plain data.

What a person asks first is whether anything is wrong, so the worst is said first: an object that some env's picture
lacks comes before one that is only cut, and an env is called by what is worst in it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from workbench.core.camera_report import DEPTH_EDGES, CameraReport, DepthReport, ObjectSeen

MOSTLY_HIDDEN = 0.1
"""Share of an object behind the robot from which on it is said of an env."""
SMALL = 30.0
"""Pixels below which an object is called small."""


@dataclass(frozen=True)
class Histogram:
    """Bars of equal width over depth, which is logarithmic; metres at both ends."""

    bars: tuple[tuple[float, bool], ...]
    """Height in 0..1 (of the highest), and whether it lies behind everything that counts."""
    low: float
    high: float
    near: float | None
    """Where the near plane is, in bars from the left; None if it is out of the picture."""
    far: float | None


def percent(share: float) -> str:
    """A share as a whole number of percent, where only none is 0 and only all is 100."""
    if math.isnan(share):
        return "–"
    whole = round(100 * share)
    if share > 0 and whole == 0:
        return "< 1 %"
    if share < 1 and whole == 100:
        return "> 99 %"
    return f"{whole} %"


def metres(value: float) -> str:
    """To three digits."""
    return f"{value:.3g} m"


def object_rows(report: CameraReport, unit: str = "envs") -> list[dict[str, Any]]:
    """Objects to be seen, the least seen first; then what the task hides. Scenery is left out.

    ``bad``: which of ``seen cut hidden`` an author should look at. ``moods``: how it is seen in each picture, ``good``,
    ``warn`` (cut, or much hidden), ``bad`` (not seen), ``none`` (absent).

    Args:
        unit: what the report is over: envs, steps.
    """
    rows: list[dict[str, Any]] = []
    wanted = report.wanted_objects()
    for thing in sorted(wanted, key=lambda thing: (thing.summary().seen, thing.name)):
        found = thing.summary()
        if not found.present:
            rows.append({"name": thing.name, "note": f"in none of these {unit}", "seen": ""})
            continue
        bad = []
        if found.seen < 1:
            bad.append("seen")
        if found.cut > 0:
            bad.append("cut")
        if found.wholly_hidden > 0 or found.hidden > MOSTLY_HIDDEN:
            bad.append("hidden")
        notes = []
        if found.present < len(report.envs):
            notes.append(f"in {found.present} of {len(report.envs)} {unit}")
        if found.covered > MOSTLY_HIDDEN:
            notes.append(f"{percent(found.covered)} behind other things")
        rows.append(
            {
                "name": thing.name,
                "note": ", ".join(notes),
                "seen": percent(found.seen),
                "pixels": f"{found.median_pixels:.0f}",
                "cut": percent(found.cut),
                "hidden": percent(found.hidden),
                "bad": bad,
                "moods": [_mood(thing, i) for i in range(len(report.envs))],
            }
        )
    hides = "the task hides it from this camera"
    return rows + [{"name": t.name, "note": hides, "seen": ""} for t in report.objects if t.never_drawn]


def headline(report: CameraReport, unit: str = "envs") -> str:
    """One sentence: is all well; `unit` as in `object_rows`."""
    wanted = [thing for thing in report.wanted_objects() if thing.present.any()]
    if not wanted:
        return f"There is no object to be seen in these {unit}."
    lacking = {thing.name: int((thing.present & (thing.pixels == 0)).sum()) for thing in wanted}
    worst = max(lacking, key=lambda name: lacking[name])
    if lacking[worst]:
        return f"{worst} is not seen in {lacking[worst]} of {len(report.envs)} {unit}."
    cut = {thing.name: int((thing.present & thing.cut).sum()) for thing in wanted}
    worst = max(cut, key=lambda name: cut[name])
    if cut[worst]:
        return f"Everything is seen; the border cuts {worst} in {cut[worst]} of {len(report.envs)} {unit}."
    return "Everything is seen, and nothing is cut."


def env_words(report: CameraReport, position: int) -> str:
    """What is worst in one env of the report, in a few words; empty where nothing is to be seen.

    Args:
        position: in `CameraReport.envs`.
    """
    found = [(_mark(thing, position), thing) for thing in report.wanted_objects() if thing.present[position]]
    if not found:
        return ""
    _, thing = min(found, key=lambda pair: pair[0])
    hidden = float(thing.hidden_share[position])
    if thing.pixels[position] == 0:
        return f"{thing.name} hidden" if thing.alone[position] > 0 else f"no {thing.name}"
    if hidden > MOSTLY_HIDDEN:
        return f"{thing.name} {percent(hidden)} hidden"
    covered = float(thing.covered_share[position])
    if covered > MOSTLY_HIDDEN:
        return f"{thing.name} {percent(covered)} behind things"
    if thing.cut[position]:
        return f"{thing.name} cut"
    pixels = f"{thing.name} {thing.pixels[position]:.0f} px"
    return f"{pixels}, small" if thing.pixels[position] < SMALL else pixels


def histogram(depth: DepthReport, near: float, far: float) -> Histogram | None:
    """The depths of all envs' pictures together; None where all of them are background.

    Args:
        near, far: the camera's planes, metres.
    """
    counts = depth.counts.sum(axis=0)
    filled = np.flatnonzero(counts)
    if not len(filled):
        return None
    first, last = max(0, int(filled[0]) - 1), min(len(counts), int(filled[-1]) + 2)
    ends = depth.farthest_object[np.isfinite(depth.farthest_object)]
    end = float(ends.max()) if len(ends) else math.inf
    part, middles = counts[first:last], np.sqrt(DEPTH_EDGES[:-1] * DEPTH_EDGES[1:])
    bars = tuple(
        (float(count) / float(part.max()), bool(middles[first + i] >= end)) for i, count in enumerate(part)
    )

    def place(plane: float) -> float | None:
        if not DEPTH_EDGES[first] <= plane <= DEPTH_EDGES[last]:
            return None
        at = np.interp(math.log(plane), np.log(DEPTH_EDGES), np.arange(len(DEPTH_EDGES)))
        return float(at) - first

    return Histogram(bars, float(DEPTH_EDGES[first]), float(DEPTH_EDGES[last]), place(near), place(far))


def _mood(thing: ObjectSeen, position: int) -> str:
    if not thing.present[position]:
        return "none"
    if thing.pixels[position] == 0:
        return "bad"
    hindered = max(float(thing.hidden_share[position]), float(thing.covered_share[position]))
    return "warn" if thing.cut[position] or hindered > 0.5 else "good"


def _mark(thing: ObjectSeen, position: int) -> float:
    return float(thing.marks()[position])

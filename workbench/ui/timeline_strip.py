"""What is drawn under the time slider, as numbers for the template ``timeline``: places are per cent of its width."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from workbench.session.history import FAIL, NOT_A_NUMBER, RESET, SUCCESS, TRUNCATED, WENT_BACK
from workbench.session.timeline import Strip
from workbench.session.view import SessionView

POINTS = 240
"""Of the reward's line, each the least and the greatest of its steps: a spike of one step stays visible."""
HEIGHT = 30.0
"""Units of the picture's height that the line has; the marks are above."""
MARKS: tuple[tuple[int, str, str], ...] = (
    (NOT_A_NUMBER, "odd", "reward is NaN or infinite"),
    (FAIL, "fail", "fail"),
    (SUCCESS, "success", "success"),
    (TRUNCATED, "limit", "time limit"),
    (WENT_BACK, "back", "went back"),
    (RESET, "reset", "reset"),
)
"""Which of them is drawn where several happened, in this order: the flag, its style, its name."""
MOST_MARKS = 150


def strip_values(strip: Strip, view: SessionView) -> dict[str, object]:
    """What the template is given."""
    past = view.timeline
    span = max(strip.high - strip.low, 1)

    def place(serial: int) -> float:
        return round(100 * (serial - strip.low) / span, 3)

    origins = dict(strip.branches)
    marks = []
    for serial, flags in strip.events[-MOST_MARKS:]:
        style, name = next((style, name) for flag, style, name in MARKS if flags & flag)
        if style == "back":
            origin = origins.get(serial)
            name = "from a recording" if origin is None else f"went back {serial - origin} steps"
        marks.append({"x": place(serial), "style": style, "name": name, "ago": past.last - serial})
    arcs = [
        {
            "a": place(max(origin, strip.low)),
            "b": place(at),
            "middle": (place(max(origin, strip.low)) + place(at)) / 2,
        }
        for at, origin in strip.branches
    ]
    bands = [
        {"x": place(a), "width": round(place(b) - place(a), 3), "odd": number % 2, "branch": a in origins}
        for number, (a, b) in enumerate(strip.stretches)
    ]
    shown = past.last if past.shown is None else past.shown
    return {
        "marks": marks,
        "arcs": arcs,
        "bands": bands,
        "lines": reward_lines(strip.reward),
        "cursor": place(min(max(shown, strip.low), strip.high)),
        "live": past.shown is None,
        "ago": past.last - shown,
        "where": where(view),
        "used": megabytes(past.used),
        "limit": megabytes(past.limit),
        "moments": past.moments,
        "kinds": [(style, name) for _, style, name in MARKS if any(m["style"] == style for m in marks)],
    }


def step_in_words(view: SessionView) -> str:
    """How far the selected env is into its episode: a single step is too small to be seen in the view."""
    task, step = view.task, view.step
    if task is None or step is None or view.selected_env >= len(step.elapsed_steps):
        return ""
    limit = f" / {task.max_episode_steps}" if task.max_episode_steps else ""
    env = "" if task.num_envs == 1 else f"env {view.selected_env}: "
    return f"{env}step {int(step.elapsed_steps[view.selected_env])}{limit}"


def where(view: SessionView) -> str:
    """Env, step of its episode and simulated time of what is shown."""
    words = step_in_words(view)
    if not words or view.task is None or view.step is None:
        return words
    return f"{words}, {view.step.elapsed_steps[view.selected_env] * view.task.control_dt:.2f} s"


def reward_lines(reward: NDArray[np.float32]) -> list[str]:
    """SVG polylines of the finite rewards over x 0..100 and y 0..`HEIGHT`, greatest on top, with a gap where there
    is none; no line without two different ones."""
    finite = reward[np.isfinite(reward)]
    if not len(finite) or finite.min() == finite.max():
        return []
    low, high = float(finite.min()), float(finite.max())
    known = np.where(np.isfinite(reward), reward, np.nan)
    if len(known) <= POINTS:
        places, values = np.arange(len(known)), known
    else:
        edges = np.linspace(0, len(known), POINTS // 2 + 1).astype(int)[:-1]
        values = np.stack([np.fmin.reduceat(known, edges), np.fmax.reduceat(known, edges)], 1).reshape(-1)
        places = np.repeat(edges, 2)
    x = 100 * places / (len(known) - 1)
    y = HEIGHT * (1 - (values - low) / (high - low))
    return polylines([None if np.isnan(b) else f"{a:.2f},{b:.1f}" for a, b in zip(x, y, strict=True)])


def polylines(points: Sequence[str | None]) -> list[str]:
    """What SVG's polylines are given for these points, with a gap at each None."""
    runs = [[point for point in run if point] for there, run in groupby(points, key=bool) if there]
    # A line of one point is not drawn; one of length zero with round ends is a dot.
    return [" ".join(run if len(run) > 1 else run * 2) for run in runs]


def megabytes(size: int) -> str:
    return f"{size / 1024**2:.0f}" if size >= 10 * 1024**2 else f"{size / 1024**2:.1f}"

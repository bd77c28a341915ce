"""What happened in an episode, and its numbers by name: what one jumps to, aligns at and draws as curves.

An event is a beginning: the first state of a run in which something is true. Besides ``success`` and ``fail`` every
other bool that ``evaluate`` returned makes one, since "when was it grasped" is asked as often as "when was it done".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workbench.recording.episode.episode import Episode
from workbench.session.history.curves import PREFIX

Style = Literal["reset", "success", "fail", "limit", "odd", "other"]
"""As the strip under the slider draws it."""
REWARD = "reward"
TERMS = "terms of the reward"
ACTION = "action"
MOST_LINES = 12
"""Columns of one entry; more cannot be told apart."""
_MOST_RUNS = 40
"""Beginnings of one entry. One that flickers at every step is no event."""


@dataclass(frozen=True)
class Happening:
    state: int
    name: str
    style: Style


def happenings(episode: Episode) -> tuple[Happening, ...]:
    """In order of time; the start is the first."""
    found = [Happening(0, "reset", "reset")]
    for name, values in episode.evaluate.items():
        yes = None if name.startswith(PREFIX) else _flag(values)
        if yes is not None:
            style: Style = "success" if name == "success" else "fail" if name == "fail" else "other"
            found += [Happening(state, name, style) for state in _beginnings(yes)]
    found += [
        Happening(state + 1, "time limit", "limit")
        for state in _beginnings(np.asarray(episode.truncated, bool))
    ]
    found += [
        Happening(state + 1, "reward is NaN or infinite", "odd")
        for state in _beginnings(~np.isfinite(np.asarray(episode.reward, np.float64)))
    ]
    return tuple(sorted(found, key=lambda h: (h.state, h.style == "other")))


def curves(episode: Episode) -> dict[str, dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]]:
    """All that can be drawn over time: by entry, then by line, the states (K,) and the numbers (K,) at them.

    Entries with several numbers a state (an action, the terms of a reward) have a line each.
    """
    states = np.arange(len(episode.reward) + 1)
    after = states[1:]
    found: dict[str, dict[str, tuple[NDArray, NDArray]]] = {
        REWARD: {REWARD: (after, _numbers(episode.reward))}
    }
    terms: dict[str, tuple[NDArray, NDArray]] = {}
    for name, values in episode.evaluate.items():
        if values.dtype.kind not in "fiub":
            continue
        if name.startswith(PREFIX):
            if values.ndim == 1 and len(terms) < MOST_LINES:
                terms[name.removeprefix(PREFIX)] = (after, _numbers(values)[1:])
            continue
        label = f"{name} (evaluate)" if name in (REWARD, TERMS, ACTION) else name
        found[label] = dict(_lines(name, values, states))
    for name, values in episode.batch.items():
        label = f"{name} (not per env)"
        found[label] = dict(_lines(label, values, states))
    if terms:
        found[TERMS] = terms
    if episode.action.shape[1:] and episode.action.shape[1]:
        action = np.asarray(episode.action, np.float64)[:, :MOST_LINES]
        found[ACTION] = {
            name: (after, action[:, index]) for index, name in enumerate(episode.action_names[:MOST_LINES])
        }
    return found


def success_words(episode: Episode) -> tuple[str, str]:
    """How it ended, and the mood of that: ``good``, ``bad`` or none."""
    success, fail = (_flag(episode.evaluate.get(name)) for name in ("success", "fail"))
    if fail is not None and len(fail) and fail[-1]:
        return "failed", "bad"
    if success is None or not len(success):
        return "no success defined", ""
    if success[-1]:
        return "success", "good"
    once = np.flatnonzero(success)
    return (f"success lost (it was there at step {once[0]})", "warn") if len(once) else ("no success", "bad")


def _lines(name: str, values: NDArray, states: NDArray) -> Iterator[tuple[str, tuple[NDArray, NDArray]]]:
    flat = _numbers(values.reshape(len(values), -1))
    for column in range(min(flat.shape[1], MOST_LINES)):
        label = name if values.ndim == 1 else f"{name}[{column}]"
        yield label, (states, flat[:, column])


def _numbers(values: NDArray) -> NDArray[np.float64]:
    return np.asarray(values, np.float64)


def _flag(values: NDArray | None) -> NDArray[np.bool_] | None:
    """(T + 1,) of an entry that is a yes or no; None of any other."""
    if values is None or not len(values) or values.size != len(values):
        return None
    flat = values.reshape(len(values))
    if flat.dtype.kind == "b":
        return flat
    if flat.dtype.kind != "f":
        return None
    # An entry that not every state had is kept as 0.0 and 1.0, with NaN for those that lack it.
    known = flat[np.isfinite(flat)]
    return np.nan_to_num(flat) != 0 if len(known) and np.isin(known, (0.0, 1.0)).all() else None


def _beginnings(yes: NDArray[np.bool_]) -> list[int]:
    before = np.concatenate([[False], yes[:-1]])
    starts = np.flatnonzero(yes & ~before)
    return starts[:1].tolist() if len(starts) > _MOST_RUNS else starts.tolist()

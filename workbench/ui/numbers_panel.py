"""The numbers of the task in the Reward tab: one row an entry, the selected env beside the whole batch.

What ``evaluate`` returns decides the rows: a bool is counted over the batch, a number averaged, a vector shortened. A
surprise (NaN, a string, None, an entry without a row for each env) is shown as it is and not left out, since it is what
an author looks for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.core.step import OtherEntry, StepResult
from workbench.session.number_text import lost_text, mean_text, number_text
from workbench.session.view import SessionView
from workbench.ui.fragments import render, short_text
from workbench.ui.parts import PagePart

LONGEST_VECTOR = 4
LONGEST_TEXT = 160
MOST_ROWS = 200


@dataclass(frozen=True)
class NumberRow:
    name: str
    selected: str
    batch: str
    mood: str = ""
    """``good`` or ``bad`` for success and failure of the selected env, else empty."""
    whole: str = ""
    """What is shown in place of both where the entry is not per env."""
    hint: str = ""
    """What else there is to know of the value."""


def number_rows(step: StepResult, selected_env: int, max_episode_steps: int | None) -> list[NumberRow]:
    """Elapsed steps, reward, success and fail first, then every other entry by its name."""
    env = selected_env
    of = f" / {max_episode_steps}" if max_episode_steps else ""
    rows = [
        NumberRow("elapsed steps", f"{_item(step.elapsed_steps, env)}{of}", _batch(step.elapsed_steps)),
        _reward_row(step, env),
    ]
    first = [key for key in ("success", "fail") if key in step.evaluate]
    rest = sorted(key for key in [*step.evaluate, *step.others] if key not in first)
    shown = first + rest[: MOST_ROWS - len(first)]
    for key in shown:
        if key in step.others:
            rows.append(_other_row(key, step.others[key], env))
            continue
        values = np.asarray(step.evaluate[key])
        mood = ""
        if key in first and values.ndim and env < len(values) and bool(np.any(values[env])):
            mood = "good" if key == "success" else "bad"
        rows.append(NumberRow(str(key), _item(values, env), _batch(values), mood))
    if hidden := len(first) + len(rest) - len(shown):
        rows.append(NumberRow(f"… and {hidden} more", "", ""))
    return rows


def _other_row(name: str, entry: OtherEntry, env: int) -> NumberRow:
    hint = entry.what if entry.whole else f"{entry.what}; only a part of it is shown, and recorded"
    if entry.per_env:
        return NumberRow(
            name, short_text(entry.texts[env], LONGEST_TEXT) if env < len(entry.texts) else "—", "", hint=hint
        )
    value = short_text("".join(entry.texts), LONGEST_TEXT) if entry.numbers is None else _value(entry.numbers)
    return NumberRow(name, "", "", whole=value, hint=f"not per env: {hint}")


def _reward_row(step: StepResult, env: int) -> NumberRow:
    """A reward is for an action: right after a reset there is none, which is not zero and not a NaN of the task's."""
    there = np.isfinite(step.reward) | ((step.elapsed_steps > 0) & (step.action is not None))
    there &= step.elapsed_steps > 0
    return NumberRow(
        "reward",
        _item(step.reward, env) if env < len(there) and there[env] else "—",
        _batch(step.reward[there]) if there.any() else "—",
    )


def _item(values: NDArray, env: int) -> str:
    if values.ndim == 0 or env >= len(values):
        return "—"
    return _value(np.asarray(values[env]))


def _value(item: NDArray) -> str:
    if item.ndim == 0:
        return _one(item)
    flat = item.reshape(-1)
    shown = ", ".join(_one(value) for value in flat[:LONGEST_VECTOR])
    more = f", … {len(flat)}" if len(flat) > LONGEST_VECTOR else ""
    return f"[{shown}{more}]"


def _one(value: NDArray) -> str:
    if value.dtype.kind == "b":
        return "yes" if value else "no"
    if value.dtype.kind in "iu":
        return str(int(value))
    if value.dtype.kind == "f":
        return _float(float(value))
    return repr(value.item())


def _float(value: float) -> str:
    return number_text(value, ".3f" if 1e-3 <= abs(value) < 1e4 or value == 0 else ".2e")


def _batch(values: NDArray) -> str:
    if values.ndim == 0:
        return _one(values)
    if values.ndim == 1 and values.dtype.kind == "b":
        return f"{int(values.sum())} of {len(values)}"
    if values.ndim > 1 and values.dtype.kind == "f":
        # Of a vector the envs are counted that have one anywhere in it.
        rows = values.reshape(len(values), -1)
        infinite = np.where(np.isinf(rows).any(axis=1), np.inf, 0.0)
        return lost_text(np.where(np.isnan(rows).any(axis=1), np.nan, infinite))
    if values.ndim == 1 and values.dtype.kind in "iuf" and len(values):
        if not np.isfinite(values).any():
            return lost_text(values)
        return f"mean {mean_text(values, _float if values.dtype.kind == 'f' else lambda mean: f'{mean:.1f}')}"
    return ""


class NumbersPanel(PagePart[SessionView]):
    every = 0.12

    def __init__(self, server: viser.ViserServer) -> None:
        self._handle = server.gui.add_html("")

    def key(self, view: SessionView) -> object:
        return view.task_serial, view.step_serial, view.selected_env

    def draw(self, view: SessionView) -> None:
        task, step = view.task, view.step
        rows = []
        if task is not None and step is not None:
            rows = number_rows(step, view.selected_env, task.max_episode_steps)
        self._handle.content = render(
            "numbers",
            rows=rows,
            env=view.selected_env,
            num_envs=0 if task is None else task.num_envs,
            has_success=step is not None and "success" in step.evaluate,
        )

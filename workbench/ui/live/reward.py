"""The Reward tab: a table of the task's numbers, and curves of reward, success and reward terms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.core.env.step_result import OtherEntry, StepResult
from workbench.machine.text import mean_text, nonfinite_text, number_text
from workbench.session.history.curves import MOST, Curves
from workbench.session.live.view import SessionView
from workbench.ui.widgets.line_chart import LONGEST, YES_OR_NO, ChartLine, LineChart
from workbench.ui.widgets.parts import PagePart
from workbench.ui.widgets.templates import render, short_text

HEIGHT, TERMS_HEIGHT = 150, 170
BATCH_COLOUR = "#868e96"
COLOURS = (
    "#228be6", "#f08c00", "#2f9e44", "#be4bdb", "#e03131", "#12b886",
    "#fab005", "#7950f2", "#fd7e14", "#15aabf", "#e64980", "#868e96",
)  # fmt: skip
NO_CURVES = Curves(0, np.zeros(0, np.int64), np.zeros((0, 1), np.float32), np.zeros((0, 1), np.float32))
NEWEST = slice(-LONGEST, None)
HOW_TO = (
    'For a curve of each part of the reward, put info["reward_terms"] = {"reach": reach, ...} (tensors of shape '
    "(num_envs,)) into the info that compute_dense_reward receives."
)


class CurvesPanel(PagePart[SessionView]):
    """Curves of the selected env and of the mean over the batch, from the history: selecting an env keeps its past."""

    every = 0.2

    def __init__(self, server: viser.ViserServer) -> None:
        gui = server.gui
        folder = gui.add_folder(None)
        self._reward, self._success = (LineChart(server, folder, HEIGHT) for _ in range(2))
        self._lost = gui.add_html("", visible=False)
        self._empty = gui.add_html(render("note", text="Curves appear after the second step."))
        self._terms = LineChart(server, gui.add_folder(None), TERMS_HEIGHT)
        self._about_terms = gui.add_html("", visible=False)

    def key(self, view: SessionView) -> object:
        drawn = None if view.curves is None else view.curves.serial
        return drawn, view.task_serial, view.step_serial, view.selected_env, view.timeline.shown

    def draw(self, view: SessionView) -> None:
        curves = NO_CURVES if view.curves is None or len(view.curves.tick) < 2 else view.curves
        self._empty.visible = curves is NO_CURVES
        lost = "" if self._empty.visible else said_of(curves.reward[-1])
        self._lost.content, self._lost.visible = render("warning", text=lost), bool(lost)
        x, env, terms = curves.tick[NEWEST], view.selected_env, curves.terms
        for chart, title, values, span in (
            (self._reward, "reward", curves.reward, None),
            (self._success, "success", curves.success, YES_OR_NO),
        ):
            lines = env_lines(values[NEWEST], env)
            shown = np.where(x == view.timeline.tick, lines[-1].values, np.nan)
            chart.draw(title, x, lines, None if view.timeline.shown is None else shown, span)
        dense = len(x) and view.task is not None and "dense" in view.task.reward_mode
        text = HOW_TO if dense and not terms else ""
        text = no_curve_text(curves.no_curve) if curves.no_curve else text
        self._about_terms.content, self._about_terms.visible = render("note", text=text), bool(text)
        lines = [
            ChartLine(name, values[NEWEST, min(env, values.shape[1] - 1)], colour, 1.6)
            for (name, values), colour in zip(terms.items(), COLOURS, strict=False)
        ]
        self._terms.draw(f"reward terms, env {env}", x, lines)


def said_of(reward: NDArray[np.float32]) -> str:
    """A warning with the number of envs whose reward is NaN or infinite; empty for none."""
    lost = nonfinite_text(reward)
    if not lost:
        return ""
    rest = (
        ": every curve has a gap there." if not np.isfinite(reward).any() else "; the mean is of the others."
    )
    return (
        f"The reward is {lost} envs{rest}"
        if len(reward) > 1
        else f"The reward is {number_text(float(reward[0]))}."
    )


def env_lines(values: NDArray[np.float32], env: int) -> list[ChartLine]:
    """The mean of the batch, if N > 1, and one env's column of `values` (T, N)."""
    env = min(env, values.shape[1] - 1)
    one = ChartLine(f"env {env}", values[:, env])
    if values.shape[1] == 1:
        return [one]
    return [ChartLine("mean of the batch", mean_of_numbers(values), BATCH_COLOUR, 1.4), one]


def mean_of_numbers(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """(T,) mean over the envs with a finite value; NaN where there is none."""
    there = np.isfinite(values)
    total = np.where(there, values, 0.0).sum(axis=1, dtype=np.float64)
    count = there.sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def no_curve_text(names: tuple[str, ...]) -> str:
    listed = ", ".join(names[:MOST]) + (f" and {len(names) - MOST} more" if len(names) > MOST else "")
    return f'No curve of {listed} in info["reward_terms"]: a curve needs one number for each env, of shape (num_envs,).'


# --- The table of numbers: one row for each entry, the selected env next to the whole batch ----


LONGEST_VECTOR = 4
LONGEST_TEXT = 160
MOST_ROWS = 200


@dataclass(frozen=True)
class NumberRow:
    """A row of the table.

    A bool is counted over the batch, a number averaged, a vector shortened. Surprises (NaN, a string, None, an entry that
    is not per env) are shown as they are: they are what an author looks for.
    """

    name: str
    selected: str
    batch: str
    mood: str = ""
    """``good`` or ``bad`` for success and failure of the selected env, else empty."""
    whole: str = ""
    """The value of an entry that is not per env, instead of `selected` and `batch`."""
    hint: str = ""
    """Further information about the value."""


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
    """The reward's row: a dash right after a reset, when there is none (neither zero nor a NaN of the task)."""
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
        # For vectors, count the envs with NaN or an infinite value in any component.
        rows = values.reshape(len(values), -1)
        infinite = np.where(np.isinf(rows).any(axis=1), np.inf, 0.0)
        return nonfinite_text(np.where(np.isnan(rows).any(axis=1), np.nan, infinite))
    if values.ndim == 1 and values.dtype.kind in "iuf" and len(values):
        if not np.isfinite(values).any():
            return nonfinite_text(values)
        return f"mean {mean_text(values, _float if values.dtype.kind == 'f' else lambda mean: f'{mean:.1f}')}"
    return ""


class NumbersPanel(PagePart[SessionView]):
    """The table of the task's numbers."""

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

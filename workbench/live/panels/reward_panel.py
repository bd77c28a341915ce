"""The Reward tab: a table of the task's numbers, and curves of reward, success and reward terms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.envs.step_result import TERM_PREFIX, OtherEntry, StepResult
from workbench.live.commands import ToggleCurve
from workbench.live.history.curves import REWARD, SUCCESS, Column, Curves, Group, columns_of
from workbench.live.panels.moment import MomentPart
from workbench.live.timeline_commands import SeekOnCurve
from workbench.live.view import SessionView
from workbench.machine.text import mean_text, nonfinite_text, number_text
from workbench.page.command import Command, name_of
from workbench.page.widgets.line_chart import YES_OR_NO, ChartLine, LineChart
from workbench.page.widgets.templates import render, short_text
from workbench.page.widgets.visitors import Visitor

CHART_PIXELS, LINES_CHART_PIXELS = 150, 170
"""Height of a chart with one entry, and of a chart with many lines."""
BATCH_COLOUR = "#868e96"
COLOURS = (
    "#228be6", "#f08c00", "#2f9e44", "#be4bdb", "#e03131", "#12b886",
    "#fab005", "#7950f2", "#fd7e14", "#15aabf", "#e64980", "#868e96",
)  # fmt: skip
MAX_LINES = len(COLOURS)
MAX_CHARTS = 12
"""Maximum number of entries of ``evaluate`` with a chart."""
MAX_NAMED = 12
CHOICE = "Choose curves"
HOW_TO = (
    'For a curve of each part of the reward, put info["reward_terms"] = {"reach": reach, ...} (tensors of shape '
    "(num_envs,)) into the info that compute_dense_reward receives."
)
AT_FIRST = (Group.REWARD, Group.TERM)
"""Groups that are drawn unless the user turns them off; success is drawn too."""
Entry = tuple[Group, str]
"""Key of a choice: a column, or all parts of an entry with several numbers."""


class CurvesPanel(MomentPart):
    """Curves of the selected env and of the mean over the batch, over all steps. Selecting another env shows its whole
    past.

    The user chooses the curves; the choice is kept per task. A press on a curve shows its step.

    Args:
        seek: Shows the moment after a control step.
    """

    does = (ToggleCurve, SeekOnCurve)

    def __init__(self, server: viser.ViserServer, seek: Callable[[int], None] = lambda tick: None) -> None:
        self._server, self._seek = server, seek
        gui = server.gui
        self._choice_folder = gui.add_folder(CHOICE, expand_by_default=False, visible=False)
        with self._choice_folder:
            self._choice = gui.add_html("")
        self._folder = gui.add_folder(None)
        self._charts: dict[Entry, LineChart] = {}
        self._toggled: dict[str, set[Entry]] = {}
        """Entries that the user has turned on or off, by task."""
        self._turned = 0
        self._task = ""
        self._asked: int | None = None
        """Step that was pressed last."""
        self._hint = gui.add_html("", visible=False)
        self._lost = gui.add_html("", visible=False)
        self._empty = gui.add_html(render("note", text="Curves appear after the second step."))
        self._about_terms = gui.add_html("", visible=False)

    def key(self, view: SessionView) -> object:
        drawn = None if view.curves is None else view.curves.serial
        return drawn, view.task_serial, view.step_serial, view.selected_env, view.timeline.shown, self._turned

    def draw(self, view: SessionView) -> None:
        curves, task = view.curves, view.task
        there = curves is not None and curves.serial >= 2
        self._empty.visible = not there
        self._hint.visible = self._choice_folder.visible = there
        self._draw_notes(view, curves if there else None)
        if curves is None or not there:
            for chart in self._charts.values():
                chart.hide()
            return
        self._task = "" if task is None else f"{task.file} {task.class_name}"
        entries = {entry_of(column): None for column in curves.columns}
        if task is not None and task.reward_mode == "none":
            entries.pop(entry_of(REWARD), None)
        chosen = [entry for entry in entries if self._is_on(entry)]
        self._draw_choice(list(entries), chosen)
        drawn = self._draw_charts(view, curves, chosen)
        for key, chart in self._charts.items():
            if key not in drawn:
                chart.hide()

    # --- choice of curves ----------------------------------------------------------------------------

    def _is_on(self, entry: Entry) -> bool:
        at_first = entry[0] in AT_FIRST or entry == entry_of(SUCCESS)
        return at_first != (entry in self._toggled.get(self._task, ()))

    def _toggle(self, entry: Entry) -> None:
        self._toggled[self._task] = self._toggled.get(self._task, set()) ^ {entry}
        self._turned += 1

    def _draw_choice(self, entries: Sequence[Entry], chosen: Sequence[Entry]) -> None:
        def press(entry: Entry) -> ToggleCurve:
            group, name = entry
            return ToggleCurve(group=group.value, name=name)

        names = {
            Group.REWARD: "reward",
            Group.TERM: "reward terms",
            Group.EVALUATE: "evaluate",
            Group.JOINT: "joints",
        }
        groups = [(names[group], [entry for entry in entries if entry[0] is group]) for group in Group]
        self._choice.content = render("curve_choice", groups=groups, chosen=chosen, toggle=press)

    # --- charts --------------------------------------------------------------------------------------

    def _draw_charts(self, view: SessionView, curves: Curves, chosen: Sequence[Entry]) -> set[Entry]:
        """Draw the chosen curves; returns the keys of the charts."""
        env, drawn = view.selected_env, set()
        singles = [entry for entry in chosen if entry[0] in (Group.REWARD, Group.EVALUATE)]
        for entry in singles[: MAX_CHARTS + 2]:
            columns = [column for column in curves.columns if entry_of(column) == entry]
            if columns[0].part is not None:
                self._draw_lines(entry, f"{entry[1]}, env {env}", curves, columns)
            else:
                self._draw_one(entry, view, curves, columns[0])
            drawn.add(entry)
        for group, title in ((Group.TERM, "reward terms"), (Group.JOINT, "joints")):
            columns = [
                column for column in curves.columns if column.group is group and self._is_on(entry_of(column))
            ]
            if columns:
                self._draw_lines((group, ""), f"{title}, env {env}", curves, columns)
                drawn.add((group, ""))
        return drawn

    def _draw_one(self, entry: Entry, view: SessionView, curves: Curves, column: Column) -> None:
        x, (one, mean) = curves.lines(((column, False), (column, True)))
        env, batch = (
            ChartLine(f"env {view.selected_env}", one),
            ChartLine("mean of the batch", mean, BATCH_COLOUR, 1.4),
        )
        dot = None
        if view.timeline.shown is not None and view.step is not None and len(x):
            dot = np.full(len(x), np.nan)
            dot[np.abs(x - view.timeline.tick).argmin()] = value_at(view, column)
        yes_or_no = column == SUCCESS or (view.step is not None and is_yes_or_no(view.step, column))
        several = len(curves.newest) > 1
        self._chart(entry).draw(
            column.name, x, [batch, env] if several else [env], dot, YES_OR_NO if yes_or_no else None
        )

    def _draw_lines(self, key: Entry, title: str, curves: Curves, columns: Sequence[Column]) -> None:
        """Several lines of the selected env in one chart."""
        x, values = curves.lines([(column, False) for column in columns[:MAX_LINES]])
        lines = [
            ChartLine(column.label, line, colour, 1.6)
            for column, line, colour in zip(columns, values, COLOURS, strict=False)
            if np.isfinite(line).any()
        ]
        self._chart(key).draw(title, x, lines)

    def _chart(self, key: Entry) -> LineChart:
        if key not in self._charts:
            first = {
                entry_of(REWARD): 1.0,
                entry_of(SUCCESS): 2.0,
                (Group.TERM, ""): 3.0,
                (Group.JOINT, ""): 1e5,
            }
            order = first.get(key, 10.0 + len(self._charts))
            height = CHART_PIXELS if key[1] else LINES_CHART_PIXELS
            self._charts[key] = LineChart(self._server, self._folder, height, order)
        return self._charts[key]

    # --- notes ---------------------------------------------------------------------------------------

    def _draw_notes(self, view: SessionView, curves: Curves | None) -> None:
        """
        Args:
            curves: None if none are drawn.
        """
        lost = "" if curves is None else said_of(curves.newest)
        self._lost.content, self._lost.visible = render("warning", text=lost), bool(lost)
        past, asked = view.timeline, self._asked
        gone = asked is not None and past.shown is not None and past.shown == past.first and asked < past.tick
        self._hint.content = render(
            "curve_hint", curve=name_of(SeekOnCurve), gone=asked if gone else None, kept=past.tick
        )
        dense = curves is not None and view.task is not None and "dense" in view.task.reward_mode
        terms = curves is not None and any(column.group is Group.TERM for column in curves.columns)
        text = HOW_TO if dense and not terms else ""
        text = no_curve_text(curves.no_curve) if curves is not None and curves.no_curve else text
        self._about_terms.content, self._about_terms.visible = render("note", text=text), bool(text)

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ToggleCurve(group=group, name=name):
                self._toggle((Group(group), name))
            case SeekOnCurve(step=step):
                self._asked = step
                self._seek(step)


def entry_of(column: Column) -> Entry:
    return column.group, column.name


def value_at(view: SessionView, column: Column) -> float:
    """Value of the selected env at the shown moment; NaN if it has none."""
    assert view.step is not None
    joints = () if view.task is None else view.task.joints
    values = columns_of(view.step, joints).get(column)
    return float("nan") if values is None else float(values[min(view.selected_env, len(values) - 1)])


def is_yes_or_no(step: StepResult, column: Column) -> bool:
    values = step.evaluate.get(column.name)
    return column.group is Group.EVALUATE and values is not None and values.dtype.kind == "b"


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


def no_curve_text(names: tuple[str, ...]) -> str:
    listed = ", ".join(names[:MAX_NAMED]) + (
        f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    )
    return f'No curve of {listed} in info["reward_terms"]: a curve needs one number for each env, of shape (num_envs,).'


# --- The table of numbers: one row for each entry, the selected env next to the whole batch ----


MAX_VECTOR_NUMBERS = 4
MAX_TEXT_CHARACTERS = 160
MAX_ROWS = 200


@dataclass(frozen=True)
class NumberRow:
    """A row of the table.

    A bool is counted over the batch, a number averaged, a vector shortened. Surprises (NaN, a string, None, an entry that
    is not per env) are shown unchanged: they are what an author looks for.
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
    about: str = ""
    """Text next to the name: the reward mode."""


def number_rows(
    step: StepResult, selected_env: int, max_episode_steps: int | None, reward_mode: str = ""
) -> list[NumberRow]:
    """Elapsed steps, reward if there is one, success and fail first, then every other entry by its name."""
    env = selected_env
    of = f" / {max_episode_steps}" if max_episode_steps else ""
    rows = [NumberRow("elapsed steps", f"{_item(step.elapsed_steps, env)}{of}", _batch(step.elapsed_steps))]
    if reward_mode != "none":
        about = "" if reward_mode == "dense" else reward_mode.replace("_dense", "")
        rows.append(_earned_row("reward", step.reward, step, env, about))
    first = [key for key in ("success", "fail") if key in step.evaluate]
    rest = sorted(key for key in [*step.evaluate, *step.others] if key not in first)
    shown = first + rest[: MAX_ROWS - len(first)]
    for key in shown:
        if key in step.others:
            rows.append(_other_row(key, step.others[key], env))
            continue
        values = np.asarray(step.evaluate[key])
        if key.startswith(TERM_PREFIX) and values.ndim == 1:
            rows.append(_earned_row(key, values, step, env))
            continue
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
            name,
            short_text(entry.texts[env], MAX_TEXT_CHARACTERS) if env < len(entry.texts) else "—",
            "",
            hint=hint,
        )
    value = (
        short_text("".join(entry.texts), MAX_TEXT_CHARACTERS)
        if entry.numbers is None
        else _value(entry.numbers)
    )
    return NumberRow(name, "", "", whole=value, hint=f"not per env: {hint}")


def _earned_row(name: str, values: NDArray, step: StepResult, env: int, about: str = "") -> NumberRow:
    """The row of the reward or of a reward term: a dash right after a reset, which has no reward (neither zero nor a NaN
    of the task)."""
    there = (step.elapsed_steps > 0) & (np.isfinite(values) | (step.action is not None))
    return NumberRow(
        name,
        _item(values, env) if env < len(there) and there[env] else "—",
        _batch(values[there]) if there.any() else "—",
        about=about,
    )


def _item(values: NDArray, env: int) -> str:
    if values.ndim == 0 or env >= len(values):
        return "—"
    return _value(np.asarray(values[env]))


def _value(item: NDArray) -> str:
    if item.ndim == 0:
        return _one(item)
    flat = item.reshape(-1)
    shown = ", ".join(_one(value) for value in flat[:MAX_VECTOR_NUMBERS])
    more = f", … {len(flat)}" if len(flat) > MAX_VECTOR_NUMBERS else ""
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


class NumbersPanel(MomentPart):
    """The table of the task's numbers."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._handle = server.gui.add_html("")

    def key(self, view: SessionView) -> object:
        return view.task_serial, view.step_serial, view.selected_env

    def draw(self, view: SessionView) -> None:
        task, step = view.task, view.step
        rows = []
        if task is not None and step is not None:
            rows = number_rows(step, view.selected_env, task.max_episode_steps, task.reward_mode)
        self._handle.content = render(
            "numbers",
            rows=rows,
            env=view.selected_env,
            num_envs=0 if task is None else task.num_envs,
            has_success=step is not None and "success" in step.evaluate,
        )

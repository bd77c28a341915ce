"""The Reward tab: a table of the task's numbers, and curves of the shown episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.envs.step_result import TERM_PREFIX, OtherEntry, StepResult
from workbench.live.commands import ChooseBeside, ToggleCurve
from workbench.live.events import EpisodeStepShown
from workbench.live.history.curves import REWARD, SUCCESS, Column, Group, columns_of, spans_of, without_curve
from workbench.live.history.moments import EpisodeNumbers
from workbench.live.panels.env_panel import ended_counts
from workbench.live.panels.moment import MomentPart
from workbench.live.session_protocol import LiveSession
from workbench.live.timeline_commands import SeekOnCurve
from workbench.live.view import SessionView
from workbench.machine.text import mean_text, nonfinite_text, number_text
from workbench.page.command import Command
from workbench.page.widgets.fields import choice
from workbench.page.widgets.line_chart import YES_OR_NO, ChartLine, LineChart
from workbench.page.widgets.parts import name_fold
from workbench.page.widgets.templates import render, short_text
from workbench.page.widgets.visitors import Visitor

CHART_PIXELS, LINES_CHART_PIXELS = 130, 150
"""Height of a chart with one entry, and of a chart with many lines."""
BESIDE_COLOUR = "#868e96"
COLOURS = (
    "#228be6", "#f08c00", "#2f9e44", "#be4bdb", "#e03131", "#12b886",
    "#fab005", "#7950f2", "#fd7e14", "#15aabf", "#e64980", "#868e96",
)  # fmt: skip
MAX_LINES = len(COLOURS)
MAX_CHARTS = 12
"""Maximum number of entries of ``evaluate`` with a chart."""
MAX_BESIDE = 10
"""Maximum number of other episodes in a chart."""
MAX_NAMED = 12
CHOICE = "Choose curves"
HOW_TO = (
    'For a curve of each part of the reward, put info["reward_terms"] = {"reach": reach, ...} (tensors of shape '
    "(num_envs,)) into the info that compute_dense_reward receives."
)
BESIDE = {"its last ten episodes": "last", "the other envs": "batch"}
AT_FIRST = (Group.REWARD, Group.TERM, Group.FORCE)
"""Groups that are drawn unless the user turns them off; success is drawn too."""
Entry = tuple[Group, str]
"""Key of a choice: a column, or all parts of an entry with several numbers."""


class CurvesPanel(MomentPart):
    """Curves of the selected env's episode, drawn over the curves of its previous episodes, or of the
    episodes of the other envs.

    The user chooses the curves; the choice is kept per task. A press on a curve, or a drag along it, shows the step.
    """

    does = (ToggleCurve, SeekOnCurve, ChooseBeside)

    def __init__(self, server: viser.ViserServer, session: LiveSession) -> None:
        self._server, self._session = server, session
        gui = server.gui
        self._beside: Literal["last", "batch"] = "last"
        self._over = choice(server, "Compare with", ChooseBeside, "beside", BESIDE, self._beside)
        self._choice_folder = gui.add_folder(CHOICE, expand_by_default=False, visible=False)
        with self._choice_folder:
            self._choice = gui.add_html("")
        self._folder = gui.add_folder(None)
        self._charts: dict[Entry, LineChart] = {}
        self._toggled: dict[str, set[Entry]] = {}
        """Entries that the user has turned on or off, by task."""
        self._turned = 0
        self._task = ""
        self._lost = gui.add_html("", visible=False)
        self._empty = gui.add_html(render("note", text="Curves appear after the second step."))
        self._about_terms = gui.add_html("", visible=False)

    def key(self, view: SessionView) -> object:
        return view.task_serial, view.step_serial, view.selected_env, view.timeline.shown, self._turned

    def urgent(self, view: SessionView) -> object:
        return super().urgent(view), self._turned

    def draw(self, view: SessionView) -> None:
        task, step = view.task, view.step
        there = task is not None and step is not None and view.timeline.moments > 0
        self._choice_folder.visible = there
        self._over.visible = there and task is not None and task.num_envs > 1
        self._over.show(self._beside)
        drawn: set[Entry] = set()
        if there and task is not None and step is not None:
            self._task = f"{task.file} {task.class_name}"
            columns = [
                column
                for column in columns_of(step, task.joints)
                if column != REWARD or task.reward_mode != "none"
            ]
            entries = list(dict.fromkeys(map(entry_of, columns)))
            chosen = [entry for entry in entries if self._is_on(entry)]
            self._draw_choice(entries, chosen)
            name_fold(self._choice_folder, CHOICE, f"{len(chosen)} of {len(entries)}")
            drawn = self._draw_charts(view, step, [one for one in columns if entry_of(one) in chosen])
        self._empty.visible = not drawn
        self._draw_notes(view)
        for key, chart in self._charts.items():
            if key not in drawn:
                chart.hide()

    # --- choice of curves ----------------------------------------------------------------------------

    def _is_on(self, entry: Entry) -> bool:
        at_first = entry[0] in AT_FIRST or entry == entry_of(SUCCESS)
        return at_first != (entry in self._toggled.get(self._task, ()))

    def _toggle(self, entry: Entry) -> None:
        self._toggled[self._task] = self._toggled.get(self._task, set()) ^ {entry}

    def _draw_choice(self, entries: Sequence[Entry], chosen: Sequence[Entry]) -> None:
        def press(entry: Entry) -> ToggleCurve:
            group, name = entry
            return ToggleCurve(group=group.value, name=name)

        names = {
            Group.REWARD: "reward",
            Group.TERM: "reward terms",
            Group.EVALUATE: "evaluate",
            Group.JOINT: "joints",
            Group.FORCE: "contact forces",
        }
        groups = [(names[group], [entry for entry in entries if entry[0] is group]) for group in Group]
        self._choice.content = render("curve_choice", groups=groups, chosen=chosen, toggle=press)

    # --- charts --------------------------------------------------------------------------------------

    def _draw_charts(self, view: SessionView, step: StepResult, columns: Sequence[Column]) -> set[Entry]:
        """Draw the curves of these columns; returns the keys of the visible charts."""
        by_chart: dict[Entry, list[Column]] = {}
        for column in columns:
            together = column.group in (Group.TERM, Group.JOINT)
            by_chart.setdefault((column.group, "") if together else entry_of(column), []).append(column)
        singles = [key for key in by_chart if key[1]]
        env = view.selected_env
        episodes = self._episodes(view, columns)
        begun = [one for one in episodes if len(one.steps)]
        if not begun:
            return set()
        first = min(int(one.steps[0]) for one in begun)
        last = max(int(one.steps[-1]) for one in begun)
        at = int(step.elapsed_steps[env])
        drawn: set[Entry] = set()
        for key, together in by_chart.items():
            if key in singles[MAX_CHARTS + 2 :]:
                continue
            own, alone = together[:MAX_LINES], len(together) == 1
            chosen = [(column, episodes[0]) for column in own]
            chosen += [(own[0], one) for one in episodes[1:]] if alone else []
            # Put the shown episode first: `points` takes its steps from the first line's extremes, so only
            # the peaks of that line are exact.
            x, values = spans_of(
                np.stack([_along(one, column, first, last) for column, one in chosen]), first=first
            ).points()
            lines = [ChartLine("", line, BESIDE_COLOUR, 0.8) for line in values[len(own) :]]
            lines += [
                ChartLine(f"env {env}" if alone else column.label, line, colour, 1.8)
                for column, line, colour in zip(own, values, COLOURS, strict=False)
            ]
            yes_or_no = all(is_yes_or_no(step, column) for column in own)
            titles = {Group.TERM: "reward terms", Group.JOINT: "joints"}
            title = key[1] or titles[key[0]]
            self._chart(key).draw(title, x, lines, at, YES_OR_NO if yes_or_no else None)
            if self._chart(key).visible:
                drawn.add(key)
        return drawn

    def _episodes(self, view: SessionView, columns: Sequence[Column]) -> list[EpisodeNumbers]:
        """The selected env's episode, then the episodes that it is drawn over."""
        env, last = view.selected_env, view.timeline.last
        before = MAX_BESIDE if self._beside == "last" or view.task is None or view.task.num_envs == 1 else 0
        found = list(self._session.look(lambda run: run.episodes(env, last, columns, before)))
        if before or view.task is None:
            return found
        others = [other for other in range(view.task.num_envs) if other != env][:MAX_BESIDE]
        for other in others:
            found += self._session.look(lambda run, other=other: run.episodes(other, last, columns, 0))
        return found

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
            with self._folder:
                self._charts[key] = LineChart(
                    self._server, height, lambda step: SeekOnCurve(step=step), order=order
                )
        return self._charts[key]

    # --- notes ---------------------------------------------------------------------------------------

    def _draw_notes(self, view: SessionView) -> None:
        step = view.step
        lost = "" if step is None or step.action is None else said_of(step.reward)
        self._lost.content, self._lost.visible = render("warning", text=lost), bool(lost)
        dense = step is not None and view.task is not None and "dense" in view.task.reward_mode
        terms = step is not None and any(column.group is Group.TERM for column in columns_of(step))
        no_curve = () if step is None else without_curve(step)
        text = no_curve_text(no_curve) if no_curve else HOW_TO if dense and not terms else ""
        self._about_terms.content, self._about_terms.visible = render("note", text=text), bool(text)

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ToggleCurve(group=group, name=name):
                self._toggle((Group(group), name))
            case ChooseBeside(beside=beside):
                self._beside = beside
            case SeekOnCurve(step=step):
                self._session.dispatch(EpisodeStepShown(self._session.view().selected_env, step))
        self._turned += 1


def _along(episode: EpisodeNumbers, column: Column, first: int, last: int) -> NDArray[np.float32]:
    """(last - first + 1,) numbers of an episode by step; NaN at steps without a number."""
    line = np.full(last - first + 1, np.nan, np.float32)
    line[episode.steps - first] = episode.values[column]
    return line


def entry_of(column: Column) -> Entry:
    return column.group, column.name


def is_yes_or_no(step: StepResult, column: Column) -> bool:
    if column == SUCCESS:
        return True
    values = step.evaluate.get(column.name)
    return column.group is Group.EVALUATE and values is not None and values.dtype.kind == "b"


def said_of(reward: NDArray[np.float32]) -> str:
    """A warning with the number of envs whose reward is NaN or infinite; empty for none."""
    lost = nonfinite_text(reward)
    if not lost:
        return ""
    rest = (
        ": every curve has a gap there."
        if not np.isfinite(reward).any()
        else "; the mean is over the other envs."
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
    tone: str = ""
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
    """Rows of the elapsed steps, the reward if there is one, success and fail; then one row for every other
    entry, sorted by name."""
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
        tone = ""
        if key in first and values.ndim and env < len(values) and bool(np.any(values[env])):
            tone = "good" if key == "success" else "bad"
        rows.append(NumberRow(str(key), _item(values, env), _batch(values), tone))
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
    """The row of the reward or of a reward term. Right after a reset there is no reward: the row shows a
    dash, not zero or NaN."""
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
    """The table of the task's numbers, and how its episodes ended."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._handle = server.gui.add_html("")
        self._outcomes = server.gui.add_html("")

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
        counts = [] if view.env_table is None else ended_counts(view.env_table)
        total = sum(count for _, _, count in counts)
        self._outcomes.content = render("outcomes", counts=counts, total=total) if total else ""

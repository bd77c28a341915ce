"""Reward, success and the reward's terms over time: the selected env, against the mean of the batch.

The session keeps the past of every env, so selecting another env takes another column of it and wipes nothing. What is
sent is bounded, and no more often than the eye follows.
"""

from __future__ import annotations

import numpy as np
import viser
import viser.uplot as uplot
from numpy.typing import NDArray

from workbench.session.number_text import lost_text, number_text
from workbench.session.reward_terms import MOST, TermCurves
from workbench.session.session import Session
from workbench.session.view import SessionView
from workbench.ui.fragments import render
from workbench.ui.line_chart import CURSOR, LONGEST, SELECTED_COLOUR, STEP, YES_OR_NO, LineChart, Span, line
from workbench.ui.parts import Part

HEIGHT = 150
BATCH_COLOUR = "#868e96"


class CurvesPanel(Part[SessionView]):
    every = 0.2

    def __init__(self, server: viser.ViserServer) -> None:
        folder = server.gui.add_folder(None)
        self._reward = LineChart(server, folder, HEIGHT)
        self._success = LineChart(server, folder, HEIGHT)
        self._lost = server.gui.add_html("", visible=False)
        self._empty = server.gui.add_html('<div class="wb-note">Curves appear with the second step.</div>')

    def key(self, view: SessionView) -> object:
        curves, past = view.curves, view.timeline
        if curves is None or len(curves.tick) < 2:
            return None
        return curves.serial, view.selected_env, curves.reward.shape[1], past.shown and past.tick

    def draw(self, view: SessionView) -> None:
        curves = view.curves
        drawable = curves is not None and len(curves.tick) > 1
        self._empty.visible = not drawable
        if curves is None or not drawable:
            self._reward.hide()
            self._success.hide()
            self._lost.visible = False
            return
        shown = None if view.timeline.shown is None else view.timeline.tick
        env = view.selected_env
        _draw(self._reward, "reward", curves.tick, curves.reward, env, None, shown)
        lost = said_of(curves.reward[-1])
        if lost:
            self._lost.content = render("warning", text=lost)
        self._lost.visible = bool(lost)
        _draw(self._success, "success", curves.tick, curves.success, env, YES_OR_NO, shown)


def _draw(
    chart: LineChart,
    title: str,
    tick: NDArray[np.int64],
    values: NDArray[np.float32],
    env: int,
    span: Span | None,
    shown: int | None,
) -> None:
    if np.isnan(values).all():
        chart.hide()
        return
    data, labels = curve_data(tick, values, env)
    series = chart_series(labels)
    if shown is not None:
        data, series = (*data, cursor_data(data, shown)), (*series, CURSOR)
    chart.draw(title, data, series, span)


def said_of(reward: NDArray[np.float32]) -> str:
    """What the curve does not show of a step: in how many envs its reward is no finite number. Empty for none."""
    lost = lost_text(reward)
    if not lost:
        return ""
    rest = ": no curve goes on there." if not np.isfinite(reward).any() else "; the mean is of the others."
    return (
        f"The reward is {lost} envs{rest}"
        if len(reward) > 1
        else f"The reward is {number_text(float(reward[0]))}."
    )


def curve_data(
    tick: NDArray[np.int64], values: NDArray[np.float32], env: int
) -> tuple[tuple[NDArray[np.float64], ...], tuple[str, ...]]:
    """The newest part of a curve as uPlot wants it: x, then one array a line, and their labels."""
    recent = slice(-LONGEST, None)
    x = tick[recent].astype(np.float64)
    one = values[recent, min(env, values.shape[1] - 1)].astype(np.float64)
    if values.shape[1] == 1:
        return (x, one), ("env 0",)
    return (x, mean_of_numbers(values[recent]), one), ("mean of the batch", f"env {env}")


def mean_of_numbers(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """(T,) over the envs whose value is a number; NaN where none is. One env's NaN is not to take the mean away."""
    there = np.isfinite(values)
    total = np.where(there, values, 0.0).sum(axis=1, dtype=np.float64)
    count = there.sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def cursor_data(data: tuple[NDArray[np.float64], ...], shown: int) -> NDArray[np.float64]:
    """One point on the selected env's line at the moment of the past that is shown, nothing elsewhere."""
    return np.where(data[0] == shown, data[-1], np.nan)


def chart_series(labels: tuple[str, ...]) -> tuple[uplot.Series, ...]:
    """The last one is the selected env's."""
    *others, selected = labels
    return (STEP, *(line(label, BATCH_COLOUR, 1.4) for label in others), line(selected, SELECTED_COLOUR, 1.8))


COLOURS = (
    "#228be6", "#f08c00", "#2f9e44", "#be4bdb", "#e03131", "#12b886",
    "#fab005", "#7950f2", "#fd7e14", "#15aabf", "#e64980", "#868e96",
)  # fmt: skip
HOW_TO = (
    'For a curve of each part of the reward, put info["reward_terms"] = {"reach": reach, ...} (tensors of shape '
    "(num_envs,)) into the info that compute_dense_reward is given."
)


class TermsPanel(Part[SessionView]):
    every = 0.25

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._session = session
        self._chart = LineChart(server, server.gui.add_folder(None), height=170)
        self._how_to = server.gui.add_html(render("note", text=HOW_TO), visible=False)
        self._no_curve = server.gui.add_html("", visible=False)

    def key(self, view: SessionView) -> object:
        return view.task_serial, view.step_serial, view.selected_env

    def draw(self, view: SessionView) -> None:
        curves = self._session.term_curves()
        if curves is not None and len(curves.tick) < 2:
            curves = None
        dense = view.task is not None and "dense" in view.task.reward_mode
        no_curve = () if curves is None else curves.no_curve
        self._how_to.visible = curves is not None and not curves.terms and not no_curve and dense
        self._no_curve.visible = bool(no_curve)
        if no_curve:
            self._no_curve.content = render("note", text=no_curve_text(no_curve))
        if curves is None or not curves.terms:
            self._chart.hide()
            return
        env = view.selected_env
        lines = (line(name, colour, 1.6) for name, colour in zip(curves.terms, COLOURS, strict=False))
        self._chart.draw(f"reward terms, env {env}", term_data(curves, env), (STEP, *lines))


def no_curve_text(names: tuple[str, ...]) -> str:
    listed = ", ".join(names[:MOST]) + (f" and {len(names) - MOST} more" if len(names) > MOST else "")
    return f'No curve of {listed} in info["reward_terms"]: a curve needs one number for each env, of shape (num_envs,).'


def term_data(curves: TermCurves, env: int) -> tuple[NDArray[np.float64], ...]:
    """As uPlot wants it: x, then one array a term."""
    recent = slice(-LONGEST, None)
    columns = (
        values[recent, min(env, values.shape[1] - 1)].astype(np.float64) for values in curves.terms.values()
    )
    return (curves.tick[recent].astype(np.float64), *columns)

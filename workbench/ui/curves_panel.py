"""Reward, success and the reward's terms over time: the selected env, against the mean of the batch.

The session keeps the past of every env, so selecting another env takes another column of it and wipes nothing. What is
sent is bounded, and no more often than the eye follows.
"""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.session.curves import MOST, Curves
from workbench.session.number_text import lost_text, number_text
from workbench.session.view import SessionView
from workbench.ui.fragments import render
from workbench.ui.line_chart import LONGEST, YES_OR_NO, Line, LineChart
from workbench.ui.parts import PagePart

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
    "(num_envs,)) into the info that compute_dense_reward is given."
)


class CurvesPanel(PagePart[SessionView]):
    every = 0.2

    def __init__(self, server: viser.ViserServer) -> None:
        gui = server.gui
        folder = gui.add_folder(None)
        self._reward, self._success = (LineChart(server, folder, HEIGHT) for _ in range(2))
        self._lost = gui.add_html("", visible=False)
        self._empty = gui.add_html(render("note", text="Curves appear with the second step."))
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
            Line(name, values[NEWEST, min(env, values.shape[1] - 1)], colour, 1.6)
            for (name, values), colour in zip(terms.items(), COLOURS, strict=False)
        ]
        self._terms.draw(f"reward terms, env {env}", x, lines)


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


def env_lines(values: NDArray[np.float32], env: int) -> list[Line]:
    """The mean of the batch, where there is one, and an env's own column of `values` (T, N)."""
    env = min(env, values.shape[1] - 1)
    one = Line(f"env {env}", values[:, env])
    if values.shape[1] == 1:
        return [one]
    return [Line("mean of the batch", mean_of_numbers(values), BATCH_COLOUR, 1.4), one]


def mean_of_numbers(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """(T,) over the envs whose value is a number; NaN where none is. One env's NaN is not to take the mean away."""
    there = np.isfinite(values)
    total = np.where(there, values, 0.0).sum(axis=1, dtype=np.float64)
    count = there.sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def no_curve_text(names: tuple[str, ...]) -> str:
    listed = ", ".join(names[:MOST]) + (f" and {len(names) - MOST} more" if len(names) > MOST else "")
    return f'No curve of {listed} in info["reward_terms"]: a curve needs one number for each env, of shape (num_envs,).'

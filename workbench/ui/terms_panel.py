"""The reward's terms of the selected env, one line each, or how to get them.

All in one chart: the question is which of them is stuck while the others grow.
"""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.session.reward_terms import MOST, TermCurves
from workbench.session.session import Session
from workbench.session.view import SessionView
from workbench.ui.fragments import render
from workbench.ui.line_chart import LONGEST, STEP, LineChart, line
from workbench.ui.parts import Part

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

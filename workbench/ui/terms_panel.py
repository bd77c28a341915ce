"""The reward's terms of the selected env, one line each, or how to get them.

All in one chart: the question is which of them is stuck while the others grow.
"""

from __future__ import annotations

import time

import numpy as np
import viser
import viser.uplot as uplot
from numpy.typing import NDArray

from workbench.session.reward_terms import TermCurves
from workbench.session.session import Session
from workbench.session.view import SessionView
from workbench.ui.curves_panel import LONGEST
from workbench.ui.fragments import render

REDRAW_EVERY = 0.25
COLOURS = (
    "#228be6", "#f08c00", "#2f9e44", "#be4bdb", "#e03131", "#12b886",
    "#fab005", "#7950f2", "#fd7e14", "#15aabf", "#e64980", "#868e96",
)  # fmt: skip
HOW_TO = (
    'For a curve of each part of the reward, put info["reward_terms"] = {"reach": reach, ...} (tensors of shape '
    "(num_envs,)) into the info that compute_dense_reward is given."
)


class TermsPanel:
    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server, self._session = server, session
        self._folder = server.gui.add_folder(None)
        self._how_to = server.gui.add_html(render("note", text=HOW_TO), visible=False)
        self._chart: viser.GuiUplotHandle | None = None
        self._names: tuple[str, ...] = ()
        self._drawn: tuple[int, int, int] | None = None
        self._drawn_at = 0.0

    def draw(self, view: SessionView) -> None:
        wanted = (view.task_serial, view.step_serial, view.selected_env)
        if wanted == self._drawn or time.monotonic() - self._drawn_at < REDRAW_EVERY:
            return
        self._drawn, self._drawn_at = wanted, time.monotonic()
        curves = self._session.term_curves()
        if curves is not None and len(curves.tick) < 2:
            curves = None
        dense = view.task is not None and "dense" in view.task.reward_mode
        self._how_to.visible = curves is not None and not curves.terms and dense
        if curves is None or not curves.terms:
            if self._chart is not None and self._chart.visible:
                self._chart.visible = False
            return
        self._draw_chart(curves, view.selected_env)

    def _draw_chart(self, curves: TermCurves, env: int) -> None:
        names, data = tuple(curves.terms), term_data(curves, env)
        series = (
            uplot.Series(label="step"),
            *(
                uplot.Series(label=name, stroke=colour, width=1.6, points={"show": False})
                for name, colour in zip(names, COLOURS, strict=False)
            ),
        )
        if self._chart is None:
            with self._folder:
                self._chart = self._server.gui.add_uplot(
                    data,
                    series,
                    title=f"reward terms, env {env}",
                    scales={"x": uplot.Scale(time=False)},
                    axes=(uplot.Axis(size=30), uplot.Axis(size=46)),
                    legend=uplot.Legend(show=True),
                    height=170,
                    padding=(6, 12, 0, 0),
                )
        elif names != self._names:
            # The data must fit the series in every state that the browser may see.
            with self._server.atomic():
                self._chart.series = series
                self._chart.data = data
        else:
            self._chart.data = data
        self._names = names
        if self._chart.title != f"reward terms, env {env}":
            self._chart.title = f"reward terms, env {env}"
        if not self._chart.visible:
            self._chart.visible = True


def term_data(curves: TermCurves, env: int) -> tuple[NDArray[np.float64], ...]:
    """As uPlot wants it: x, then one array a term."""
    recent = slice(-LONGEST, None)
    columns = (
        values[recent, min(env, values.shape[1] - 1)].astype(np.float64) for values in curves.terms.values()
    )
    return (curves.tick[recent].astype(np.float64), *columns)

"""Reward and success over time: the selected env against the mean of the batch.

The session keeps the past of every env, so selecting another env only takes another column of it:
nothing is wiped. What is sent is bounded, and no more often than the eye follows.
"""

from __future__ import annotations

import time

import numpy as np
import viser
import viser.uplot as uplot
from numpy.typing import NDArray

from workbench.session.view import Curves, SessionView

REDRAW_EVERY = 0.2
LONGEST = 600
"""Points of a curve. More do not fit in the panel's 300 pixels."""
SELECTED_COLOUR = "#228be6"
BATCH_COLOUR = "#868e96"
CURSOR = uplot.Series(
    label="shown", stroke="#f08c00", width=0, points={"show": True, "size": 10, "fill": "#f08c00"}
)


class CurvesPanel:
    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._charts: dict[str, viser.GuiUplotHandle] = {}
        self._folder = server.gui.add_folder(None)
        self._empty = server.gui.add_html('<div class="wb-note">Curves appear with the first step.</div>')
        self._drawn: tuple[int, int, int, int | None] | None = None
        self._drawn_at = 0.0

    def draw(self, view: SessionView) -> None:
        curves = view.curves
        drawable = curves is not None and len(curves.tick) > 1
        self._empty.visible = not drawable
        for chart in self._charts.values():
            if chart.visible and not drawable:
                chart.visible = False
        if curves is None or not drawable:
            return
        shown = None if view.timeline.shown is None else view.timeline.tick
        wanted = (curves.serial, view.selected_env, curves.reward.shape[1], shown)
        if wanted == self._drawn or time.monotonic() - self._drawn_at < REDRAW_EVERY:
            return
        self._drawn, self._drawn_at = wanted, time.monotonic()
        self._draw_chart("reward", curves, curves.reward, view.selected_env, None, shown)
        self._draw_chart("success", curves, curves.success, view.selected_env, (-0.05, 1.05), shown)

    def _draw_chart(
        self,
        title: str,
        curves: Curves,
        values: NDArray[np.float32],
        env: int,
        span: tuple[float, float] | None,
        shown: int | None,
    ) -> None:
        chart = self._charts.get(title)
        if np.isnan(values).all():
            if chart is not None:
                chart.visible = False
            return
        data, labels = curve_data(curves.tick, values, env)
        series = chart_series(labels)
        if shown is not None or not all(np.isfinite(line).all() for line in data[1:]):
            # uPlot finds no range for data with NaN in it.
            span = span or value_span(data[1:])
        if shown is not None:
            data, series = (*data, cursor_data(data, shown)), (*series, CURSOR)
        scales = {"x": uplot.Scale(time=False)} | ({} if span is None else {"y": uplot.Scale(range=span)})
        if chart is None:
            with self._folder:
                self._charts[title] = self._server.gui.add_uplot(
                    data,
                    series,
                    title=title,
                    scales=scales,
                    axes=(uplot.Axis(size=30), uplot.Axis(size=46)),
                    legend=uplot.Legend(show=True),
                    height=150,
                    padding=(6, 12, 0, 0),
                )
            return
        if chart.series != series or chart.scales != scales:
            # The data must fit the series in every state that the browser may see.
            with self._server.atomic():
                chart.series, chart.scales = series, scales
                chart.data = data
        else:
            chart.data = data
        chart.visible = True


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


def value_span(lines: tuple[NDArray[np.float64], ...]) -> tuple[float, float]:
    """A range that holds every finite value, with some room above and below."""
    values = np.concatenate(lines)
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    room = 0.08 * (high - low) or 0.5
    return low - room, high + room


def chart_series(labels: tuple[str, ...]) -> tuple[uplot.Series, ...]:
    lines = [uplot.Series(label="step")]
    for number, label in enumerate(labels):
        selected = number == len(labels) - 1
        lines.append(
            uplot.Series(
                label=label,
                stroke=SELECTED_COLOUR if selected else BATCH_COLOUR,
                width=1.8 if selected else 1.4,
                points={"show": False},
            )
        )
    return tuple(lines)

"""One chart of lines over steps, made when there is something to draw and kept from then on.

A chart that is made anew flickers, and viser's takes its lines, its range and its data as three properties: whoever
looks while one of them is already the new one sees a chart that cannot be drawn. So all that draw curves have the chart
through here, which sends together what belongs together, and no more than has changed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
import viser.uplot as uplot
from numpy.typing import NDArray

from workbench.ui.changed import show

LONGEST = 600
"""Points of a curve. More do not fit in the panel's 300 pixels."""
SELECTED_COLOUR = "#228be6"
STEP = uplot.Series(label="step")
"""What lies along x; the first of every chart's series."""
CURSOR = uplot.Series(
    label="shown", stroke="#f08c00", width=0, points={"show": True, "size": 10, "fill": "#f08c00"}
)

Span = tuple[float, float]


class LineChart:
    """A chart in a folder, once there is something to draw."""

    def __init__(
        self,
        server: viser.ViserServer,
        folder: viser.GuiFolderHandle,
        height: int,
        order: float | None = None,
    ) -> None:
        self._server, self._folder, self._height, self._order = server, folder, height, order
        self.handle: viser.GuiUplotHandle | None = None

    def hide(self) -> None:
        if self.handle is not None:
            show(self.handle, False)

    def draw(
        self,
        title: str,
        data: Sequence[NDArray[np.float64]],
        series: Sequence[uplot.Series],
        span: Span | None = None,
    ) -> None:
        """
        Args:
            title: Over the chart.
            data: Steps, then one array a line, each (K,).
            series: What each of them is.
            span: The range along y; None for that of the data, which must hold no NaN then: uPlot finds none.
        """
        data, series = tuple(data), tuple(series)
        scales = {"x": uplot.Scale(time=False)} | ({} if span is None else {"y": uplot.Scale(range=span)})
        if self.handle is None:
            with self._folder:
                self.handle = self._server.gui.add_uplot(
                    data,
                    series,
                    title=title,
                    scales=scales,
                    axes=(uplot.Axis(size=30), uplot.Axis(size=46)),
                    legend=uplot.Legend(show=True),
                    height=self._height,
                    padding=(6, 12, 0, 0),
                    order=self._order,
                )
            return
        if self.handle.title != title:
            self.handle.title = title
        if self.handle.series != series or self.handle.scales != scales:
            # The data must fit the series in every state that the browser may see.
            with self._server.atomic():
                self.handle.series, self.handle.scales = series, scales
                self.handle.data = data
        else:
            self.handle.data = data
        show(self.handle, True)


def line(label: str, colour: str, width: float) -> uplot.Series:
    """How a curve looks: a line without its points."""
    return uplot.Series(label=label, stroke=colour, width=width, points={"show": False})


def value_span(lines: Sequence[NDArray[np.float64]]) -> Span:
    """A range that holds every finite value, with some room above and below."""
    values = np.concatenate(lines)
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    room = 0.08 * (high - low) or 0.5
    return low - room, high + room

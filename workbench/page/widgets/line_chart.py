"""Line charts over steps, with gaps where a value is not finite."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser
import viser.uplot as uplot
from numpy.typing import NDArray

from workbench.page.door.viser_private import send_lines

ROTATED_CHARTS = 3
"""Number of charts used in turn, one of them shown. With two, a busy browser may miss that two changes followed each
other."""
MAX_POINTS = 600
"""Maximum number of points of a curve. More do not fit in the panel's 300 pixels."""
SELECTED_COLOUR = "#228be6"
STEP = uplot.Series(label="step")
"""The x axis; the first of every chart's series."""
CURSOR = uplot.Series(
    label="shown", stroke="#f08c00", width=0, points={"show": True, "size": 10, "fill": "#f08c00"}
)

Span = tuple[float, float]
YES_OR_NO: Span = (-0.05, 1.05)
"""Range of a curve of 0 and 1."""


@dataclass(frozen=True, eq=False)
class ChartLine:
    """One curve of a chart."""

    name: str
    values: NDArray
    """(K,) values; a value that is not finite is a gap."""
    colour: str = SELECTED_COLOUR
    width: float = 1.8


class LineChart:
    """A chart in a folder, created when there is something to draw.

    viser keeps the visible part of the x axis as a share of the data's range, and mixes two charts when uPlot rebuilds its
    chart, which happens on a change of anything but the data: from then on the axis shows another part of the data, in the
    end none. So a visible chart gets only new data, and other lines are drawn in another chart. uPlot finds no range for
    data with NaN, and draws through it: NaN is sent as a gap.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        folder: viser.GuiFolderHandle,
        height: int,
        order: float | None = None,
    ) -> None:
        self._server, self._folder, self._height, self._order = server, folder, height, order
        self._charts: list[viser.GuiUplotHandle] = []
        """The charts; at most one is visible, the last."""
        self._made_for: object = None

    @property
    def handle(self) -> viser.GuiUplotHandle | None:
        """The last drawn chart, if any."""
        return self._charts[-1] if self._charts else None

    def hide(self) -> None:
        if self.handle is not None:
            self.handle.visible = False

    def draw(
        self,
        title: str,
        x: NDArray,
        lines: Sequence[ChartLine],
        dot: NDArray | None = None,
        span: Span | None = None,
    ) -> None:
        """Draw lines; hide the chart if no line has a finite value, or K < 2.

        Args:
            title: Title above the chart.
            x: (K,) steps.
            lines: Lines over all of `x`.
            dot: (K,) finite at the single dot, NaN elsewhere.
            span: Range of the y axis; None fits the data.
        """
        if len(x) < 2 or not any(np.isfinite(line.values).any() for line in lines):
            self.hide()
            return
        dots = () if dot is None else (dot,)
        data = tuple(
            np.asarray(values, np.float64) for values in (x, *(line.values for line in lines), *dots)
        )
        series = (STEP, *map(_series, lines), *(CURSOR for _ in dots))
        wanted = (title, series, span)
        # The number of data rows must match the series in every state that the browser may receive.
        with self._server.atomic():
            if self.handle is None or wanted != self._made_for:
                self._change_to(title, data, series, span)
            chart = self._charts[-1]
            send_lines(chart, data, tuple(with_gaps(values) for values in data))
            chart.visible = True
        self._made_for = wanted

    def _change_to(
        self,
        title: str,
        data: tuple[NDArray[np.float64], ...],
        series: tuple[uplot.Series, ...],
        span: Span | None,
    ) -> None:
        """Draw in a hidden chart, which starts with a fresh x axis.

        The old chart is hidden, not removed: a busy browser would report an error for data of a removed chart.
        """
        scales = {"x": uplot.Scale(time=False)} | ({} if span is None else {"y": uplot.Scale(range=span)})
        self.hide()
        if len(self._charts) == ROTATED_CHARTS:
            chart = self._charts.pop(0)
            chart.title, chart.series, chart.scales = title, series, scales
            self._charts.append(chart)
            return
        with self._folder:
            chart = self._server.gui.add_uplot(
                data,
                series,
                title=title,
                scales=scales,
                axes=(uplot.Axis(size=30), uplot.Axis(size=56)),
                legend=uplot.Legend(show=True),
                height=self._height,
                padding=(6, 22, 0, 0),
                # All charts have the same position in the folder.
                order=self._order,
                visible=False,
            )
        self._order = chart.order
        self._charts.append(chart)


def _series(line: ChartLine) -> uplot.Series:
    return uplot.Series(label=line.name, stroke=line.colour, width=line.width, points={"show": False})


def with_gaps(values: NDArray[np.float64]) -> NDArray[np.float64] | list[float | None]:
    """A line for uPlot, with None, which uPlot shows as a gap, for values that are not finite."""
    finite = np.isfinite(values)
    if finite.all():
        return values
    return [value if there else None for value, there in zip(values.tolist(), finite.tolist(), strict=True)]


def part_round(count: int, place: int | None) -> slice:
    """At most `MAX_POINTS` of `count` points: around an index, or the newest."""
    end = count if place is None else min(max(place + MAX_POINTS // 2, MAX_POINTS), count)
    return slice(max(0, end - MAX_POINTS), end)


def span_of(lines: Sequence[NDArray[np.float64]]) -> Span | None:
    """The y range of a chart: fixed for curves of 0 and 1, else None (fit the data)."""
    values = np.concatenate([[], *lines])
    return YES_OR_NO if np.isin(values[np.isfinite(values)], (0.0, 1.0)).all() else None

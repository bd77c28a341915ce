"""Line charts over steps, with gaps where a value is not finite."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser
import viser.uplot as uplot
from numpy.typing import NDArray

from workbench.page.door.viser_private import send_lines

TAKING_TURNS = 3
"""Number of charts, one of them shown. With two, a busy browser may miss that two changes followed each other."""
LONGEST = 600
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
    """(K,) values, with a gap where one is not finite."""
    colour: str = SELECTED_COLOUR
    width: float = 1.8


class LineChart:
    """A chart in a folder, made when there is something to draw.

    viser keeps the visible part of the x axis as a share of the data's range, and computes it from two charts at once
    when uPlot rebuilds its chart, which it does for a change of anything but the data: from then on the axis shows
    another part of the data, in the end none. So a chart that is shown gets new data only, and other lines are drawn
    in another chart. uPlot finds no range for data with NaN, and draws through it: NaN is sent as a gap.
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
        """At most one is visible: the last."""
        self._made_for: object = None

    @property
    def handle(self) -> viser.GuiUplotHandle | None:
        """The chart that was drawn last, if any."""
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
        """Draw lines; hide the chart where no line has a finite value, or K < 2.

        Args:
            title: Over the chart.
            x: (K,) steps.
            lines: Each over all of `x`.
            dot: (K,) finite at the one dot, NaN elsewhere.
            span: The range of the y axis; None fits the data.
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
        # The data must fit the series in every state that the browser may see.
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
        """Draw in a chart that is not shown: it begins with a fresh x axis.

        It is hidden, not removed: a busy browser would report data that arrives for a chart that is gone.
        """
        scales = {"x": uplot.Scale(time=False)} | ({} if span is None else {"y": uplot.Scale(range=span)})
        self.hide()
        if len(self._charts) == TAKING_TURNS:
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
                # All of them at the same position of the folder.
                order=self._order,
                visible=False,
            )
        self._order = chart.order
        self._charts.append(chart)


def _series(line: ChartLine) -> uplot.Series:
    return uplot.Series(label=line.name, stroke=line.colour, width=line.width, points={"show": False})


def with_gaps(values: NDArray[np.float64]) -> NDArray[np.float64] | list[float | None]:
    """A line for uPlot: None, which uPlot shows as a gap, where a value is not finite."""
    finite = np.isfinite(values)
    if finite.all():
        return values
    return [value if there else None for value, there in zip(values.tolist(), finite.tolist(), strict=True)]


def part_round(count: int, place: int | None) -> slice:
    """At most `LONGEST` of `count` points: around a place, or the newest."""
    end = count if place is None else min(max(place + LONGEST // 2, LONGEST), count)
    return slice(max(0, end - LONGEST), end)


def span_of(lines: Sequence[NDArray[np.float64]]) -> Span | None:
    """The y range of a chart: fixed for curves of 0 and 1, else None (that of the data)."""
    values = np.concatenate([[], *lines])
    return YES_OR_NO if np.isin(values[np.isfinite(values)], (0.0, 1.0)).all() else None

"""One chart of lines over steps, made when there is something to draw.

viser keeps what part of the x axis one sees as a share of the data's range, and works that out from two charts at
once when uPlot makes its chart anew, which it does for a change of anything but the data. So after such a change the
axis shows another part of the data than before, for good, and in the end none of it. And uPlot finds no range for
data with NaN in it, and draws through it. So all that draw curves have the chart through here: only data are ever
sent to a chart that is shown, with gaps where there is no number, and for other lines another chart is shown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser
import viser.uplot as uplot
from numpy.typing import NDArray

from workbench.ui.server.viser_private import send_lines

TAKING_TURNS = 3
"""Charts of which one is shown. Of two, a browser that is busy might see no change where there were two in a row."""
LONGEST = 600
"""Points of a curve. More do not fit in the panel's 300 pixels."""
SELECTED_COLOUR = "#228be6"
STEP = uplot.Series(label="step")
"""What lies along x; the first of every chart's series."""
CURSOR = uplot.Series(
    label="shown", stroke="#f08c00", width=0, points={"show": True, "size": 10, "fill": "#f08c00"}
)

Span = tuple[float, float]
YES_OR_NO: Span = (-0.05, 1.05)
"""The range of a curve that is 0 or 1."""


@dataclass(frozen=True, eq=False)
class Line:
    """One curve, without its points."""

    name: str
    values: NDArray
    """(K,) with a gap where it is not finite."""
    colour: str = SELECTED_COLOUR
    width: float = 1.8


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
        self._charts: list[viser.GuiUplotHandle] = []
        """One of them is shown at most; the last one was last."""
        self._made_for: object = None

    @property
    def handle(self) -> viser.GuiUplotHandle | None:
        """The chart that was drawn last; None before there was something to draw."""
        return self._charts[-1] if self._charts else None

    def hide(self) -> None:
        if self.handle is not None:
            self.handle.visible = False

    def draw(
        self,
        title: str,
        x: NDArray,
        lines: Sequence[Line],
        dot: NDArray | None = None,
        span: Span | None = None,
    ) -> None:
        """Hide it where no line has a number, or there are no two places.

        Args:
            title: Over the chart.
            x: (K,) steps.
            lines: Each over all of `x`.
            dot: (K,) a number where one dot is to be, none elsewhere.
            span: The range along y; None for that of the data.
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
        """Make a chart that is not in the page the one to draw: there it begins anew, with its x axis too.

        It is not removed and added, since a browser that is busy meets the data of before after that, and says so.
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
                axes=(uplot.Axis(size=30), uplot.Axis(size=46)),
                legend=uplot.Legend(show=True),
                height=self._height,
                padding=(6, 12, 0, 0),
                # All in one place.
                order=self._order,
                visible=False,
            )
        self._order = chart.order
        self._charts.append(chart)


def _series(line: Line) -> uplot.Series:
    return uplot.Series(label=line.name, stroke=line.colour, width=line.width, points={"show": False})


def with_gaps(values: NDArray[np.float64]) -> NDArray[np.float64] | list[float | None]:
    """A line as uPlot wants it: None where it is not finite, which is a gap to uPlot as NaN is not."""
    finite = np.isfinite(values)
    if finite.all():
        return values
    return [value if there else None for value, there in zip(values.tolist(), finite.tolist(), strict=True)]


def part_round(count: int, place: int | None) -> slice:
    """`LONGEST` of so many points, as far as there are: round a place, or the newest."""
    end = count if place is None else min(max(place + LONGEST // 2, LONGEST), count)
    return slice(max(0, end - LONGEST), end)


def span_of(lines: Sequence[NDArray[np.float64]]) -> Span | None:
    """The range of a chart: of a yes or no always the same one, whether it changes or not; else that of the data."""
    values = np.concatenate([[], *lines])
    return YES_OR_NO if np.isin(values[np.isfinite(values)], (0.0, 1.0)).all() else None

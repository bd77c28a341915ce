"""One chart of lines over steps, made when there is something to draw.

viser keeps what part of the x axis one sees as a share of the data's range, and works that out from two charts at
once when uPlot makes its chart anew, which it does for a change of anything but the data. So after such a change the
axis shows another part of the data than before, for good, and in the end none of it. And uPlot finds no range for
data with NaN in it, and draws through it. So all that draw curves have the chart through here: only data are ever
sent to a chart that is there, with gaps where there is no number, and for other lines there is another chart.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
import viser.uplot as uplot
from numpy.typing import NDArray

from workbench.ui.changed import show
from workbench.ui.viser_seam import send_lines

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
        self._made_for: object = None
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
            data: Steps, then one array a line, each (K,); a line has a gap where it is not finite.
            series: What each of them is.
            span: The range along y; None for that of the data.
        """
        data, series = tuple(data), tuple(series)
        sent = tuple(with_gaps(values) for values in data)
        wanted = (title, series, span)
        if self.handle is not None and wanted == self._made_for:
            send_lines(self.handle, data, sent)
            show(self.handle, True)
            return
        # The data must fit the series in every state that the browser may see.
        with self._server.atomic():
            if self.handle is not None:
                self._order = self.handle.order
                self.handle.remove()
            with self._folder:
                self.handle = self._server.gui.add_uplot(
                    data,
                    series,
                    title=title,
                    scales={"x": uplot.Scale(time=False)}
                    | ({} if span is None else {"y": uplot.Scale(range=span)}),
                    axes=(uplot.Axis(size=30), uplot.Axis(size=46)),
                    legend=uplot.Legend(show=True),
                    height=self._height,
                    padding=(6, 12, 0, 0),
                    order=self._order,
                )
            send_lines(self.handle, data, sent)
        self._made_for = wanted


def line(label: str, colour: str, width: float) -> uplot.Series:
    """How a curve looks: a line without its points."""
    return uplot.Series(label=label, stroke=colour, width=width, points={"show": False})


def with_gaps(values: NDArray[np.float64]) -> NDArray[np.float64] | list[float | None]:
    """A line as uPlot wants it: None where it is not finite, which is a gap to uPlot as NaN is not."""
    finite = np.isfinite(values)
    if finite.all():
        return values
    return [value if there else None for value, there in zip(values.tolist(), finite.tolist(), strict=True)]


def span_of(lines: Sequence[NDArray[np.float64]]) -> Span | None:
    """The range of a chart: of a yes or no always the same one, whether it changes or not; else that of the data."""
    values = np.concatenate(lines)
    return YES_OR_NO if np.isin(values[np.isfinite(values)], (0.0, 1.0)).all() else None

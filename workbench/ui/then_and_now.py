"""The chart of one number as it was recorded, and as the new code has it: the record thin and grey, the new over it.

It is made when there is something to draw, and stays from then on: a chart that is made anew flickers.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
import viser.uplot as uplot
from numpy.typing import NDArray

from workbench.ui.changed import show
from workbench.ui.curves_panel import CURSOR, SELECTED_COLOUR, value_span

RECORD_COLOUR = "#adb5bd"
SERIES = (
    uplot.Series(label="step"),
    uplot.Series(label="as recorded", stroke=RECORD_COLOUR, width=1.2, points={"show": False}),
    uplot.Series(label="judged again", stroke=SELECTED_COLOUR, width=1.8, points={"show": False}),
)


class ThenAndNow:
    """The chart, in the present container, once there is something to draw."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._folder = server.gui.add_folder(None)
        self.handle: viser.GuiUplotHandle | None = None

    def hide(self) -> None:
        if self.handle is not None:
            show(self.handle, False)

    def draw(self, title: str, data: Sequence[NDArray[np.float64]]) -> None:
        """
        Args:
            title: Over the chart.
            data: Steps, the record, what is said now, each (K,); and a point at the moment that is shown, if one is.
        """
        data = tuple(data)
        series = SERIES if len(data) == 3 else (*SERIES, CURSOR)
        scales = {"x": uplot.Scale(time=False), "y": uplot.Scale(range=value_span(data[1:]))}
        if self.handle is None:
            with self._folder:
                self.handle = self._server.gui.add_uplot(
                    data,
                    series,
                    title=title,
                    scales=scales,
                    axes=(uplot.Axis(size=30), uplot.Axis(size=46)),
                    legend=uplot.Legend(show=True),
                    height=160,
                    padding=(6, 12, 0, 0),
                )
            return
        # The data must fit the series in every state that the browser may see.
        with self._server.atomic():
            self.handle.series, self.handle.scales, self.handle.title = series, scales, title
            self.handle.data = data
        show(self.handle, True)

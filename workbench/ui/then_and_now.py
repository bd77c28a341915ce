"""The chart of one number as it was recorded, and as the new code has it: the record thin and grey, the new over it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.ui.line_chart import CURSOR, SELECTED_COLOUR, STEP, LineChart, line, span_of

RECORD_COLOUR = "#adb5bd"
SERIES = (STEP, line("as recorded", RECORD_COLOUR, 1.2), line("judged again", SELECTED_COLOUR, 1.8))


class ThenAndNow:
    """The chart, in the present container, once there is something to draw."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._chart = LineChart(server, server.gui.add_folder(None), height=160)

    @property
    def handle(self) -> viser.GuiUplotHandle | None:
        """None before there was something to draw."""
        return self._chart.handle

    def hide(self) -> None:
        self._chart.hide()

    def draw(self, title: str, data: Sequence[NDArray[np.float64]]) -> None:
        """
        Args:
            title: Over the chart.
            data: Steps, the record, what is said now, each (K,); and a point at the moment that is shown, if one is.
        """
        series = SERIES if len(data) == 3 else (*SERIES, CURSOR)
        self._chart.draw(title, data, series, span_of(data[1:]))

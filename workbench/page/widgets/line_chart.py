"""Line charts over steps, as SVG, with gaps where a value is not finite."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.machine.text import number_text
from workbench.page.command import Command
from workbench.page.widgets.templates import render

MAX_POINTS = 600
"""Maximum number of points of a curve. More do not fit in the panel's 300 pixels."""
SELECTED_COLOUR = "#228be6"
MAX_TICKS = 4
Span = tuple[float, float]
ROUNDING = 1e-5
"""Numbers that differ by less than this share of the largest magnitude are drawn as a constant: float32 rounding
errors would fill the chart."""
YES_OR_NO: Span = (-0.05, 1.05)
"""Range of a curve of 0 and 1."""


@dataclass(frozen=True, eq=False)
class ChartLine:
    """One curve of a chart."""

    name: str
    """Name in the legend; a line with an empty name is not in the legend."""
    values: NDArray
    """(K,) values; a value that is not finite is a gap."""
    colour: str = SELECTED_COLOUR
    width: float = 1.8


class LineChart:
    """A chart in the present container, hidden until there is something to draw.

    Args:
        height: Height of the plot in pixels.
        press: Returns the command for a step that the user presses, or drags to; with None, the chart ignores
            presses.
        order: Position in the container; by default after the present content.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        height: int,
        press: Callable[[int], Command] | None = None,
        order: float | None = None,
    ) -> None:
        self._height, self._press = height, press
        self._html = server.gui.add_html("", order=order, visible=False)

    @property
    def visible(self) -> bool:
        return self._html.visible

    def hide(self) -> None:
        self._html.visible = False

    def draw(
        self,
        title: str,
        x: NDArray,
        lines: Sequence[ChartLine],
        at: float | None = None,
        span: Span | None = None,
    ) -> None:
        """Draw lines; hide the chart if no line has a finite value, or if there are fewer than two steps.

        Args:
            title: Title above the chart.
            x: (K,) steps, ascending.
            lines: Lines over all of `x`, the last one on top.
            at: Step of the cursor; the legend shows the values there.
            span: Range of the y axis; None fits the data.
        """
        self._html.visible = len(x) > 1 and any(np.isfinite(line.values).any() for line in lines)
        if self._html.visible:
            self._html.content = chart_html(title, x, lines, self._height, at, span, self._press)


def chart_html(
    title: str,
    x: NDArray,
    lines: Sequence[ChartLine],
    height: int = 150,
    at: float | None = None,
    span: Span | None = None,
    press: Callable[[int], Command] | None = None,
) -> str:
    """HTML of a chart; see `LineChart.draw`."""
    low, high = span or _span_of_all(lines)
    first, last = float(x[0]), float(x[-1])

    def across(step: float) -> float:
        return round(100 * (step - first) / (last - first), 3)

    def down(value: float) -> float:
        return round(100 * (high - value) / (high - low), 2)

    place = None if at is None else int(np.abs(x - at).argmin())
    return render(
        "chart",
        title=title,
        height=height,
        lines=[(line, _polylines(line.values, x, across, down)) for line in lines],
        legend=[
            (line, "" if place is None else _value_text(float(line.values[place])))
            for line in lines
            if line.name
        ],
        across=[(across(step), f"{step:g}") for step in ticks(first, last)],
        down=[(down(value), f"{value:g}") for value in ticks(low, high)],
        cursor=None if at is None or not first <= at <= last else across(at),
        press=None if press is None else press(round(first)),
        ends=(round(first), round(last)),
    )


def _value_text(value: float) -> str:
    """The value as text; a dash for NaN, which stands for a step without a value."""
    return "—" if np.isnan(value) else number_text(value, ".3g")


def _span_of_all(lines: Sequence[ChartLine]) -> Span:
    values = np.concatenate([np.asarray(line.values, np.float64) for line in lines])
    finite = values[np.isfinite(values)]
    return drawn_span(float(finite.min()), float(finite.max()))


def drawn_span(low: float, high: float) -> Span:
    """The range of an axis for finite numbers from `low` to `high`. A constant is in its middle."""
    most = max(abs(low), abs(high))
    if high - low > ROUNDING * most:
        return low, high
    middle, half = (low + high) / 2, max(most, 1.0) / 2
    return middle - half, middle + half


def _polylines(
    values: NDArray, x: NDArray, across: Callable[[float], float], down: Callable[[float], float]
) -> list[str]:
    there = np.isfinite(values)
    return polylines(
        [
            f"{across(float(step)):g},{down(float(value)):g}" if known else None
            for step, value, known in zip(x, values, there, strict=True)
        ]
    )


def polylines(points: Sequence[str | None]) -> list[str]:
    """Values for the attribute ``points`` of SVG polylines through these points; each None is a gap between
    two polylines."""
    runs = [[point for point in run if point] for there, run in groupby(points, key=bool) if there]
    # SVG does not draw a polyline of one point; one of length zero with round ends is a dot.
    return [" ".join(run if len(run) > 1 else run * 2) for run in runs]


def ticks(low: float, high: float, most: int = MAX_TICKS) -> list[float]:
    """Round numbers from `low` to `high`, at most `most`: multiples of 1, 2 or 5 times a power of ten."""
    size = high - low
    power = 10.0 ** math.floor(math.log10(size / most))
    step = next(power * times for times in (1, 2, 5, 10, 20) if size / (power * times) < most)
    first = math.ceil(low / step - 1e-9)
    return [float(f"{number * step:.12g}") for number in range(first, math.floor(high / step + 1e-9) + 1)]


def part_round(count: int, place: int | None) -> slice:
    """The slice of at most `MAX_POINTS` of `count` points: around the index `place`, or the newest points if
    `place` is None."""
    end = count if place is None else min(max(place + MAX_POINTS // 2, MAX_POINTS), count)
    return slice(max(0, end - MAX_POINTS), end)


def span_of(lines: Sequence[NDArray[np.float64]]) -> Span | None:
    """The y range of a chart: fixed for curves of 0 and 1, else None (fit the data)."""
    values = np.concatenate([[], *lines])
    return YES_OR_NO if np.isin(values[np.isfinite(values)], (0.0, 1.0)).all() else None

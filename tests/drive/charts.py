"""Reads the charts of a page from their HTML."""

from __future__ import annotations

import re
from dataclasses import dataclass
from html import unescape

import numpy as np
from numpy.typing import NDArray

_LINE = re.compile(r'<polyline points="([^"]*)" class="wb-line" style="stroke:(#\w+);')
_TICK = re.compile(r'class="wb-chart-(x|y) wb-num" style="(?:top:|--share:)([-\d.e]+)%?">([-\d.e+]+)<')
_LEGEND = re.compile(
    r'class="wb-mark wb-key wb-key-line"[^>]*></i>([^<]*?)(?: <span class="wb-num">([^<]*)</span>)?</span>'
)


@dataclass(frozen=True)
class Chart:
    """A chart as it is drawn; numbers are exact to about a thousandth of the axis."""

    title: str
    legend: tuple[tuple[str, str], ...]
    """Name of each named line, and its value at the cursor."""
    lines: tuple[tuple[str, NDArray[np.float64]], ...]
    """Colour and (K, 2) steps and numbers of each run of a line without a gap."""
    cursor: float | None
    """Step of the cursor."""

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.legend]

    def of(self, colour: str) -> NDArray[np.float64]:
        """(K, 2) steps and numbers of the lines of this colour."""
        return np.concatenate([np.zeros((0, 2)), *(points for tone, points in self.lines if tone == colour)])


def charts_in(html: str) -> list[Chart]:
    return [_read(part) for part in html.split('<div class="wb-chart">')[1:]]


def _line_through(points: NDArray[np.float64]) -> tuple[float, float]:
    slope, offset = np.polyfit(points[:, 0], points[:, 1], 1)
    return float(slope), float(offset)


def _read(html: str) -> Chart:
    places: dict[str, list[tuple[float, float]]] = {"x": [], "y": []}
    for axis, place, text in _TICK.findall(html):
        places[axis].append((float(place) * (100 if axis == "x" else 1), float(text)))
    (x0, x1), (y0, y1) = (_line_through(np.array(places[axis])) for axis in "xy")
    lines = []
    for points, colour in _LINE.findall(html):
        drawn = np.array([[float(number) for number in point.split(",")] for point in points.split()])
        lines.append((colour, np.stack([x1 + x0 * drawn[:, 0], y1 + y0 * drawn[:, 1]], axis=1)))
    cursor = re.search(r'<line x1="([\d.]+)" x2="\1" y1="0" y2="100" class="wb-cursor"', html)
    title = re.search(r"<b>([^<]*)</b>", html)
    assert title is not None
    legend = tuple((unescape(name.strip()), value) for name, value in _LEGEND.findall(html))
    at = None if cursor is None else x1 + x0 * float(cursor[1])
    return Chart(unescape(title[1]), legend, tuple(lines), at)

"""Reads the curves that a page shows from the canvas pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Page

from workbench.page.widgets.line_chart import SELECTED_COLOUR

COLUMNS_OF = """([colour]) => {
    const canvas = document.querySelector(".uplot canvas");
    if (!canvas || !canvas.width) return [];
    const { width, height } = canvas;
    const pixels = canvas.getContext("2d").getImageData(0, 0, width, height).data;
    const [red, green, blue] = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
    const found = [];
    for (let x = 0; x < width; x++) {
        for (let y = 0; y < height; y++) {
            const at = 4 * (y * width + x);
            const far = Math.abs(pixels[at] - red) + Math.abs(pixels[at + 1] - green) + Math.abs(pixels[at + 2] - blue);
            if (pixels[at + 3] > 127 && far < 60) { found.push(x / width); break; }
        }
    }
    return found;
}"""
"""Pixel columns of the first chart that contain the colour, as fractions of its width."""


def drawn(page: Page) -> NDArray[np.float64]:
    return np.array(page.evaluate(COLUMNS_OF, [SELECTED_COLOUR]))

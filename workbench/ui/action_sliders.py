"""A slider for every number of the action, given to every env while they are the action's source."""

from __future__ import annotations

import math

import viser

from workbench.session.messages import ActionDimension
from workbench.session.session import Session
from workbench.ui.checked import checked_number
from workbench.ui.controls import Control

UNBOUNDED = 1.0
"""A dimension without bounds gets a slider from -1 to 1."""


class ActionSliders:
    """A folder with one slider a dimension; there only while the source is ``sliders``."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server = server
        self._session = session
        self._dimensions: tuple[ActionDimension, ...] = ()
        self._controls: list[Control[viser.GuiSliderHandle, float]] = []
        self._folder = server.gui.add_folder(None, visible=False)
        with self._folder:
            self._centre = server.gui.add_button("Centre all", color="gray")
        self._centre.on_click(lambda _: self._send_centre())

    def build(self, dimensions: tuple[ActionDimension, ...], values: tuple[float, ...]) -> None:
        """Sliders of this action space, unless they are there already (a reload keeps them)."""
        if dimensions == self._dimensions:
            return
        for control in self._controls:
            control.handle.remove()
        self._dimensions, self._controls = dimensions, []
        with self._folder:
            for number, dimension in enumerate(dimensions):
                low, high = slider_bounds(dimension)
                start = values[number] if number < len(values) else (low + high) / 2
                self._controls.append(
                    Control(
                        self._server.gui.add_slider(
                            dimension.name,
                            min=low,
                            max=high,
                            step=(high - low) / 200,
                            initial_value=min(max(start, low), high),
                        ),
                        read=lambda value, low=low, high=high, name=dimension.name: checked_number(
                            value, low, high, name
                        ),
                        send=lambda _: self._send(),
                    )
                )

    def draw(self, shown: bool, values: tuple[float, ...]) -> None:
        self._folder.visible = shown
        if shown and len(values) == len(self._controls):
            for dimension, control, value in zip(self._dimensions, self._controls, values, strict=True):
                low, high = slider_bounds(dimension)
                control.show(min(max(value, low), high))

    def _send(self) -> None:
        # All of them at their newest: two sliders moved at once arrive in any order.
        values = []
        for dimension, control in zip(self._dimensions, self._controls, strict=True):
            low, high = slider_bounds(dimension)
            values.append(checked_number(control.handle.value, low, high, dimension.name))
        self._session.set_sliders(tuple(values))

    def _send_centre(self) -> None:
        self._session.set_sliders(tuple(sum(slider_bounds(d)) / 2 for d in self._dimensions))


def slider_bounds(dimension: ActionDimension) -> tuple[float, float]:
    low = dimension.low if math.isfinite(dimension.low) else -UNBOUNDED
    high = dimension.high if math.isfinite(dimension.high) else UNBOUNDED
    return (low, high) if low < high else (low, low + 1e-6)

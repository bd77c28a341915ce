"""Fields of several numbers on one camera, each shown in so many digits, sent when they were left to settle.

A field takes numbers between its bounds, or says why not; that they are numbers, and as many as it has, is known by then
(`workbench.ui.control_values`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser

from workbench.ui.camera_moves import rounded
from workbench.ui.checked import checked_number
from workbench.ui.controls import Control
from workbench.ui.placing import FARTHEST

TYPED = 0.3
"""Seconds without another number after which the last is taken: the arrows beside a field are held down."""

Send = Callable[[tuple[float, ...]], None]


def vector_field(
    gui: viser.GuiApi, label: str, digits: int, step: float, hint: str, send: Send
) -> Control[Any, Any]:
    """Three numbers, metres or parts of a unit vector."""
    handle = gui.add_vector3(label, (0.0, 0.0, 0.0), step=step, hint=hint)
    return _field(handle, label, digits, -FARTHEST, FARTHEST, send)


def pair_field(
    gui: viser.GuiApi,
    label: str,
    digits: int,
    step: float,
    low: float,
    high: float,
    send: Send,
    hint: str,
) -> Control[Any, Any]:
    """Two numbers."""
    handle = gui.add_vector2(label, (0.0, 0.0), step=step, hint=hint)
    return _field(handle, label, digits, low, high, send)


def number_field(
    gui: viser.GuiApi,
    label: str,
    digits: int,
    step: float,
    low: float,
    high: float,
    send: Callable[[float], None],
    name: str,
) -> Control[Any, Any]:
    """One number; `name` says in a sentence what it is."""
    handle = gui.add_number(label, low, step=step, hint=f"The {name}.")
    handle.precision = digits
    return Control(
        handle,
        read=lambda value: checked_number(value, low, high, name),
        send=send,
        shown=lambda number: rounded([number], digits)[0],
        settle=TYPED,
    )


def _field(handle: Any, label: str, digits: int, low: float, high: float, send: Send) -> Control[Any, Any]:
    # Digits that are shown and can be typed; viser takes them from the step.
    handle.precision = digits
    return Control(
        handle,
        read=lambda value: tuple(checked_number(n, low, high, label) for n in value),
        send=send,
        shown=lambda numbers: rounded(numbers, digits),
        settle=TYPED,
    )

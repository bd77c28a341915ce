"""A length as a person says it."""

from __future__ import annotations

import math

_UNITS = (("m", 1.0, 1.0), ("cm", 1e-2, 1e-2), ("mm", 1e-3, 1e-4), ("µm", 1e-6, 1e-6), ("nm", 1e-9, 0.0))
"""Name, size, and from where on it is used."""


def length(metres: float) -> str:
    """``3.2 cm``, ``0.4 mm``, ``70 nm``, ``0``."""
    if metres == 0:
        return "0"
    if not math.isfinite(metres):
        return "more than can be told"
    unit, size = next((unit, size) for unit, size, least in _UNITS if metres >= least)
    return f"{metres / size:.2g} {unit}"

"""Numbers and lengths as text, NaN and infinite ones too: one way for the page, the terminal and the files.

Short, since it is one decision that everything that shows a number must share.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

_UNITS = (("m", 1.0, 1.0), ("cm", 1e-2, 1e-2), ("mm", 1e-3, 1e-4), ("µm", 1e-6, 1e-6), ("nm", 1e-9, 0.0))
"""Name, size, and from where on it is used."""


def number_text(value: float, form: str = ".4g") -> str:
    """``0.25``, ``NaN``, ``infinite``, ``-infinite``."""
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "infinite" if value > 0 else "-infinite"
    return format(value, form)


def lost_text(values: ArrayLike) -> str:
    """How many of these are no finite numbers: ``NaN in 3 of 16``, ``NaN in 3, infinite in 1 of 16``; else empty."""
    flat = np.asarray(values).reshape(-1)
    counts = {"NaN": int(np.isnan(flat).sum()), "infinite": int(np.isinf(flat).sum())}
    told = ", ".join(f"{word} in {count}" for word, count in counts.items() if count)
    return f"{told} of {len(flat)}" if told else ""


def mean_text(values: ArrayLike, say: Callable[[float], str] = number_text) -> str:
    """The mean of those that are finite, and how many are not: ``0.25, NaN in 3 of 16``."""
    flat = np.asarray(values, np.float64).reshape(-1)
    finite = flat[np.isfinite(flat)]
    return ", ".join(
        part for part in (say(float(finite.mean())) if len(finite) else "", lost_text(flat)) if part
    )


def length(metres: float) -> str:
    """As a person says it: ``3.2 cm``, ``0.4 mm``, ``70 nm``, ``0``."""
    if metres == 0:
        return "0"
    if not math.isfinite(metres):
        return "more than can be told"
    unit, size = next((unit, size) for unit, size, least in _UNITS if metres >= least)
    return f"{metres / size:.2g} {unit}"

"""Numbers as text, NaN and infinite ones too: one way for the page, the terminal and the files.

Short, since it is one decision that everything that shows a number must share.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike


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

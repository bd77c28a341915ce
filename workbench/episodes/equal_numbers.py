"""Tolerances for comparing the numbers of two runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SAME_SHARE, SAME_NUMBER = 1e-5, 1e-7
"""Tolerances, of which the larger one applies: `SAME_SHARE` is a fraction of the largest recorded number,
`SAME_NUMBER` an absolute difference."""


def gap(old: NDArray, new: NDArray) -> NDArray[np.float64]:
    """Absolute difference; infinite where only one number is NaN, zero where both are NaN or the same
    infinity."""
    a, b = np.asarray(old, np.float64), np.asarray(new, np.float64)
    with np.errstate(invalid="ignore"):
        apart = np.abs(b - a)
    if not np.isfinite(apart).all():
        apart[(np.isnan(a) & np.isnan(b)) | (a == b)] = 0.0
        apart[np.isnan(apart)] = np.inf
    return apart


def numbers_differ(old: NDArray, new: NDArray, least: float = SAME_NUMBER) -> NDArray[np.bool_]:
    """True where numbers differ.

    Args:
        least: absolute difference up to which numbers count as equal.
    """
    return too_far(old, gap(old, new), least)


def too_far(
    old: NDArray, apart: NDArray, least: float = SAME_NUMBER, axis: int | None = None
) -> NDArray[np.bool_]:
    """True where `apart` exceeds both `least` and `SAME_SHARE` times the largest finite magnitude in `old`
    (if `axis` is 1: in the same row of `old`)."""
    if not apart.any():
        return apart > 0
    scale = np.abs(old).max(axis=axis, initial=0.0, where=np.isfinite(old), keepdims=True)
    return apart > np.maximum(SAME_SHARE * scale, least)

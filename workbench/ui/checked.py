"""Checks of a value that a page sent, against what the session can do with it.

`workbench.ui.control_values` has checked before viser stored it that the control can hold the value: type, range,
options. What a control cannot say (is there still an env 7, how long may a name be) is asked here, where the value
is used. A value that is refused is refused with a sentence for the person, not quietly bent into another one: the
session keeps what it had, and the control goes back to showing that. Only the rounding of a browser's arithmetic
at the ends of a slider is set right in silence.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from typing import TypeVar

import numpy as np

Choice = TypeVar("Choice")

LARGEST_FLOAT = sys.float_info.max
ROUNDING = 1e-6
"""Part of a slider's range by which its value may lie beyond the ends: ``low + n * step``, added up in a
browser, passes ``high`` by a few units in the last place."""


def checked_number(value: object, low: float, high: float, name: str) -> float:
    """``value`` as a float in ``[low, high]``.

    Args:
        value: What the control holds: of any type, of any size.
        low: Least value; -inf where there is none.
        high: Greatest value; inf where there is none.
        name: What the sentence calls the value.

    Raises:
        ValueError: It is not a real number (a bool is none here), is not finite, or lies outside.
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise ValueError(f"The {name} is not a number.")
    value = value.item() if isinstance(value, np.generic) else value
    # Compared before it is converted: float() fails on an int of more than 308 digits.
    if not -LARGEST_FLOAT <= value <= LARGEST_FLOAT:
        raise ValueError(f"The {name} is not a finite number.")
    slack = 0.0 if math.isinf(high - low) else (high - low) * ROUNDING
    if not low - slack <= value <= high + slack:
        raise ValueError(f"The {name} {_range(low, high)}.")
    return min(max(float(value), float(low)), float(high))


def _range(low: float, high: float) -> str:
    if math.isinf(high):
        return f"is at least {low:g}"
    return f"is at most {high:g}" if math.isinf(low) else f"goes from {low:g} to {high:g}"


def checked_int(value: object, low: int, high: int, name: str) -> int:
    """``value`` as a whole number in ``[low, high]``; 3.0 is 3, as browsers have only one kind of number.

    Raises:
        ValueError: It is not a whole number, or lies outside.
    """
    if isinstance(value, (float, np.floating)) and float(value).is_integer():
        value = int(value)
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)):
        raise ValueError(f"The {name} is not a whole number.")
    if not low <= value <= high:
        raise ValueError(f"The {name} goes from {low} to {high}." if low <= high else f"There is no {name}.")
    return int(value)


def checked_choice(value: object, options: Iterable[Choice], name: str) -> Choice:
    """The one of ``options`` that equals ``value`` and is of its type (True is not 1).

    Raises:
        ValueError: There is none.
    """
    for option in options:
        if type(option) is type(value) and option == value:
            return option
    raise ValueError(f"That {name} is not one of those on offer.")


def checked_text(value: object, longest: int, name: str) -> str:
    """``value`` as one line of at most ``longest`` characters, all of them printable. Not escaped: text is
    escaped where it goes into HTML or markdown.

    Raises:
        ValueError: It is not a text, is longer, or has line breaks, control or direction characters.
    """
    if not isinstance(value, str):
        raise ValueError(f"The {name} is not a text.")
    if len(value) > longest:
        raise ValueError(f"The {name} is longer than {longest} characters.")
    if not value.isprintable():
        raise ValueError(f"The {name} has characters that cannot be shown, such as a line break.")
    return value

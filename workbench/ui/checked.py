"""What a control claims, made into what the control can say.

viser takes a control's value from the browser as it comes: a slider from 0 to 10 holds 99999 if a
client says so, a dropdown holds a text that is not among its options, and only the Python type is
forced. The page itself never sends such values, but the page is not the only thing that can speak the
protocol, and an option list may have changed between the click and its arrival. An env index of 99999
must not reach the worker. So a panel passes every ``handle.value`` through one of these before it uses
it. They are pure and never raise on a value; what cannot be made sense of becomes the fallback.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TypeVar

import numpy as np

Choice = TypeVar("Choice")


def checked_number(value: object, low: float, high: float, fallback: float) -> float:
    """``value`` held between ``low`` and ``high`` (infinities too: they are beyond a bound); ``fallback``,
    held in the same way, for NaN and for what is not a real number. A bool is not a number here.

    Raises:
        ValueError: ``low`` is greater than ``high``, or one of the three numbers of the control is NaN.
    """
    if not low <= high or math.isnan(fallback):
        raise ValueError(f"A control from {low} to {high} that falls back to {fallback} does not exist.")
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        value = fallback
    # Compared before it is converted: float() raises on an int of more than 308 digits.
    if value > high:
        return float(high)
    if value < low:
        return float(low)
    return checked_number(fallback, low, high, low) if value != value else float(value)


def checked_int(value: object, low: int, high: int, fallback: int) -> int:
    """`checked_number` for whole numbers; a fraction goes to the nearest one (halves to the even one).

    Raises:
        ValueError: ``low`` is greater than ``high``.
    """
    if low > high:
        raise ValueError(f"A control from {low} to {high} does not exist.")
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        value = fallback
    if value > high:
        return high
    if value < low:
        return low
    return (
        checked_int(fallback, low, high, low)
        if value != value
        else round(float(value) if isinstance(value, np.floating) else value)
    )


def checked_choice(value: object, options: Iterable[Choice], fallback: Choice) -> Choice:
    """The one of ``options`` that equals ``value`` and is of its type (True is not 1); else ``fallback``,
    which need not be one of them (a dropdown without options has to say something)."""
    for option in options:
        if type(option) is type(value) and option == value:
            return option
    return fallback


def checked_text(value: object, longest: int, fallback: str) -> str:
    """``value`` as one line of at most ``longest`` printable characters, without blanks around it;
    ``fallback`` if it is not a text or nothing is left. Not escaped: what goes into HTML or markdown is
    escaped where it goes in."""
    if not isinstance(value, str):
        return fallback
    line = "".join(character for character in value if character.isprintable()).strip()[:longest].strip()
    return line or fallback

"""What a control claims, checked against what the control can say.

viser takes a control's value from the browser as it comes: a slider from 0 to 10 holds 99999 if a
client says so, a dropdown holds a text that is not among its options, and only the Python type is
forced. The page itself never sends such values, but the page is not the only thing that can speak the
protocol, and a list of options may have changed between the click and its arrival. An env index of
99999 must not reach the worker.

So a panel passes every ``handle.value`` through one of these before it uses it. A value that the
control cannot have is refused with a sentence for the person, not quietly bent into another one: the
session keeps what it had, and the control goes back to showing that. Only the rounding of a browser's
arithmetic at the ends of a slider is set right in silence.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

import numpy as np

Choice = TypeVar("Choice")

ROUNDING = 1e-6
"""Part of a slider's range by which its value may lie beyond the ends: ``low + n * step``, added up in a
browser, passes ``high`` by a few units in the last place."""


def checked_number(value: object, low: float, high: float, name: str) -> float:
    """``value`` as a float in ``[low, high]``.

    Args:
        value: What the control holds: of any type, of any size.
        low: Least value.
        high: Greatest value.
        name: What the sentence calls the value.

    Raises:
        ValueError: It is not a real number (a bool is none here), is NaN, or lies outside.
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise ValueError(f"The {name} is not a number.")
    if value != value:
        raise ValueError(f"The {name} is not a number.")
    slack = (high - low) * ROUNDING
    # Compared before it is converted: float() fails on an int of more than 308 digits.
    if not low - slack <= value <= high + slack:
        raise ValueError(f"The {name} goes from {low:g} to {high:g}.")
    return min(max(float(value), float(low)), float(high))


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

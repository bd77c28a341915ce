"""Checks of values that a page sends, against their control and against the session."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import numpy as np
import viser

Choice = TypeVar("Choice")

LARGEST_FLOAT = sys.float_info.max
ROUNDING = 1e-6
"""Part of a slider's range by which a value may lie outside: ``low + n * step``, computed in a browser, passes ``high``
by a few units in the last place."""


def checked_number(value: object, low: float, high: float, name: str) -> float:
    """``value`` as a float in ``[low, high]``.

    Args:
        value: What the control holds, of any type and size.
        low: Least value, or -inf.
        high: Greatest value, or inf.
        name: Name of the value in the error message.

    Raises:
        ValueError: Not a real number (a bool is none here), not finite, or outside.
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise ValueError(f"The {name} is not a number.")
    value = value.item() if isinstance(value, np.generic) else value
    # Compared before the conversion: float() fails on an int of more than 308 digits.
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
    """``value`` as a whole number in ``[low, high]``; 3.0 is 3, since browsers have one type of number.

    Raises:
        ValueError: Not a whole number, or outside.
    """
    if isinstance(value, (float, np.floating)) and float(value).is_integer():
        value = int(value)
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)):
        raise ValueError(f"The {name} is not a whole number.")
    if not low <= value <= high:
        raise ValueError(f"The {name} goes from {low} to {high}." if low <= high else f"There is no {name}.")
    return int(value)


def checked_choice(value: object, options: Iterable[Choice], name: str) -> Choice:
    """The option that equals ``value`` and has its type (True is not 1).

    Raises:
        ValueError: There is none.
    """
    for option in options:
        if type(option) is type(value) and option == value:
            return option
    raise ValueError(f"That is not one of the choices for {name}.")


LARGEST_INT = 2**53
"""A browser's whole numbers are exact up to here. msgpack ends at 2 ** 64."""
LONGEST_LINE = 10_000
LONGEST_TEXT = 100_000
"""Characters of a text field with several lines, such as a camera pasted as JSON."""
_NAME, _LONGEST = "name_of_control", "longest_of_control"
"""Attributes set on viser's handles, which cannot be keys of a dictionary."""


def name_control(control: Any, name: str) -> None:
    """Name a control whose label says nothing, for messages and for tests that look for it."""
    setattr(control, _NAME, name)


def name_of(control: Any) -> str:
    """Its label, unless it was given a name."""
    return getattr(control, _NAME, "") or control.label


def limit_text(control: Any, longest: int) -> None:
    """Limit the characters of a text field; a single line then takes printable ones only (no control or direction
    characters)."""
    setattr(control, _LONGEST, longest)


def check_value(control: Any, value: object) -> None:
    """Check type, range, options and number of components of a value before viser stores it.

    viser converts to the Python type and checks nothing else: it stores 99999 for a slider from 0 to 10, and an
    integer that msgpack cannot write ends the connection of every page, again at each reconnect. What only the
    session knows (is there still an env 7) is checked by the panel that reads the value.

    Args:
        control: An input of viser's.
        value: As decoded: a bool, number, text or list of these.

    Raises:
        ValueError: The control cannot hold that; the message is for the person at the page.
    """
    name = name_of(control) or "value"
    if isinstance(control, viser.GuiCheckboxHandle):
        if not isinstance(value, bool):
            raise ValueError(f"The {name} is on or off.")
    elif isinstance(control, viser.GuiButtonHandle):
        # viser takes any value of a button as a press.
        if value is not True:
            raise ValueError(f"The {name} is a button and takes no value.")
    elif isinstance(control, (viser.GuiDropdownHandle, viser.GuiButtonGroupHandle)):
        checked_choice(value, control.options, name)
    elif isinstance(control, viser.GuiTextHandle):
        _check_text(control, value, name)
    elif isinstance(control, (viser.GuiSliderHandle, viser.GuiNumberHandle)):
        _check_number(value, control.value, control.min, control.max, name)
    elif isinstance(control, (viser.GuiVector2Handle, viser.GuiVector3Handle)):
        _check_components(value, control.value, control.min, control.max, name)
    else:
        raise ValueError(f"The {name} cannot be set from a page.")


def _check_text(control: viser.GuiTextHandle, value: object, name: str) -> None:
    limit = getattr(control, _LONGEST, None)
    longest = limit or (LONGEST_TEXT if control.multiline else LONGEST_LINE)
    if not isinstance(value, str):
        raise ValueError(f"The {name} must be a text.")
    if len(value) > longest:
        raise ValueError(f"The {name} takes at most {longest} characters, not {len(value)}.")
    if "\0" in value or (not control.multiline and len(value.splitlines()) > 1):
        raise ValueError(f"The {name} takes one line of text.")
    if limit and not control.multiline and not value.isprintable():
        raise ValueError(f"The {name} has characters that cannot be shown.")


def _check_number(value: object, now: float, low: Any, high: Any, name: str) -> None:
    if isinstance(now, int):
        checked_int(value, -LARGEST_INT if low is None else low, LARGEST_INT if high is None else high, name)
    else:
        checked_number(value, -math.inf if low is None else low, math.inf if high is None else high, name)


def _check_components(
    value: object,
    now: Sequence[float],
    low: Sequence[float] | None,
    high: Sequence[float] | None,
    name: str,
) -> None:
    if not isinstance(value, list) or len(value) != len(now):
        raise ValueError(f"The {name} has {len(now)} numbers.")
    for i, part in enumerate(value):
        _check_number(part, now[i], None if low is None else low[i], None if high is None else high[i], name)

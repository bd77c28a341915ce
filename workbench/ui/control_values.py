"""Checks what a page claims that a control holds, before viser stores it and sends it to every other page.

viser forces the Python type and nothing else: it stores 99999 for a slider from 0 to 10, and an integer that
msgpack cannot write ends the connection of every page, again at each reconnect. A control says itself what it
can hold (its type, least and greatest value, options, number of components); that is checked here, once, for all
controls. What only the session knows (does env 7 still exist, is that the name of a policy) is checked by the
panel that reads the value, with `workbench.ui.checked`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import viser

from workbench.ui.checked import checked_choice, checked_int, checked_number

LARGEST_INT = 2**53
"""Up to here a browser counts in ones. msgpack ends at 2 ** 64."""
LONGEST_LINE = 10_000
LONGEST_TEXT = 100_000
"""Characters of a text field with several lines, such as a camera that is pasted as JSON."""
_NAME = "name_of_control"
"""Attribute: viser's handles have no other place for it, and cannot be a dictionary's keys."""


def name_control(control: Any, name: str) -> None:
    """Of a control whose label says nothing: what a sentence calls it, and what it is found by."""
    setattr(control, _NAME, name)


def name_of(control: Any) -> str:
    """Its label, unless it was given a name."""
    return getattr(control, _NAME, "") or control.label


def check_value(control: Any, value: object) -> None:
    """
    Args:
        control: An input of viser's.
        value: As decoded: a bool, number, text or list of these.

    Raises:
        ValueError: The control cannot hold that; the sentence is for the person at the page.
    """
    name = name_of(control) or "value"
    if isinstance(control, viser.GuiCheckboxHandle):
        if not isinstance(value, bool):
            raise ValueError(f"The {name} is on or off.")
    elif isinstance(control, viser.GuiButtonHandle):
        # For viser any value of a button is a press.
        if value is not True:
            raise ValueError(f"The {name} can be pressed, and no more.")
    elif isinstance(control, (viser.GuiDropdownHandle, viser.GuiButtonGroupHandle)):
        checked_choice(value, control.options, name)
    elif isinstance(control, viser.GuiTextHandle):
        _check_text(control, value, name)
    elif isinstance(control, (viser.GuiSliderHandle, viser.GuiNumberHandle)):
        _check_number(value, control.value, control.min, control.max, name)
    elif isinstance(control, (viser.GuiVector2Handle, viser.GuiVector3Handle)):
        _check_components(value, control.value, control.min, control.max, name)
    elif isinstance(control, viser.GuiMultiSliderHandle):
        count = len(control.value)
        _check_components(value, control.value, (control.min,) * count, (control.max,) * count, name)
    elif isinstance(control, (viser.GuiRgbHandle, viser.GuiRgbaHandle)):
        count = len(control.value)
        _check_components(value, control.value, (0,) * count, (255,) * count, name)
    else:
        raise ValueError(f"The {name} takes nothing from a page.")


def _check_text(control: viser.GuiTextHandle, value: object, name: str) -> None:
    longest = LONGEST_TEXT if control.multiline else LONGEST_LINE
    if not isinstance(value, str):
        raise ValueError(f"The {name} is a text.")
    if len(value) > longest:
        raise ValueError(f"The {name} takes {longest} characters; those are {len(value)}.")
    if "\0" in value or (not control.multiline and len(value.splitlines()) > 1):
        raise ValueError(f"The {name} takes one line of text.")


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

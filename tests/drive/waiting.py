"""Waits for what another thread or process does."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
PATIENCE = 90.0
"""Seconds after which what has not come is a failed test."""

interrupts: list[Callable[[], None]] = []
"""Asked at every look: one that raises ends the wait, where what is waited for can no longer come."""


def until(
    reached: Callable[[], T | None],
    what: str,
    seconds: float = PATIENCE,
    seen: Callable[[], object] | None = None,
) -> T:
    """The first true answer of `reached`; without one in time the test fails and says what `seen` saw."""
    deadline, pause = time.monotonic() + seconds, 0.01
    while not (answer := reached()):
        for interrupt in interrupts:
            interrupt()
        if time.monotonic() > deadline:
            raise AssertionError(
                f"{what} did not come within {seconds:g} s" + (f": {seen()}" if seen else "")
            )
        time.sleep(pause)
        pause = min(1.2 * pause, 0.1)  # a page that is asked all the time comes to nothing else
    return answer

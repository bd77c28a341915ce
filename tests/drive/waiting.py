"""Waits for another thread or process."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
TIMEOUT_SECONDS = 90.0
"""Timeout after which a wait fails its test."""

interrupts: list[Callable[[], None]] = []
"""Called at every poll; one that raises ends the wait early when its result can no longer come."""


def until(
    reached: Callable[[], T | None],
    what: str,
    seconds: float = TIMEOUT_SECONDS,
    seen: Callable[[], object] | None = None,
) -> T:
    """Poll `reached` until it is true and return its result; on timeout fail the test with the result of `seen`."""
    deadline, pause = time.monotonic() + seconds, 0.01
    while not (answer := reached()):
        for interrupt in interrupts:
            interrupt()
        if time.monotonic() > deadline:
            raise AssertionError(
                f"{what} did not come within {seconds:g} s" + (f": {seen()}" if seen else "")
            )
        time.sleep(pause)
        pause = min(1.2 * pause, 0.1)  # a page that is polled constantly does nothing else
    return answer

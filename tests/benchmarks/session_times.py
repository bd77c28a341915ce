"""Times until a session's view is as wanted."""

from __future__ import annotations

import time
from collections.abc import Callable

from workbench.app.session import Session
from workbench.live.view import SessionView


def seconds_until(
    session: Session, reached: Callable[[SessionView], object], timeout_seconds: float = 300.0
) -> float:
    """Wait until the view is as wanted; returns the seconds. Ends the script on timeout."""
    began, seen = time.monotonic(), -1
    while time.monotonic() - began < timeout_seconds:
        if reached(session.view()):
            return time.monotonic() - began
        seen = session.wait(seen, 0.2)
    raise SystemExit(f"the awaited view did not come within {timeout_seconds:.0f} s")

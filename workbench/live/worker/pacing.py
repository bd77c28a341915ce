"""Realtime pacing of control steps, rates, and throttled progress reports."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

_MAX_DEBT_SECONDS = 0.1
"""Maximum lag, in wall time, that is caught up."""


@dataclass
class Pacer:
    """A budget of simulated time, as in mjlab's base viewer.

    Wall time, multiplied by the speed, adds to the budget; a step subtracts ``control_dt``, and is due when
    the budget is large enough. So the speed is right for steps of any cost, even if the loop is uneven. Lag
    beyond `_MAX_DEBT_SECONDS` is dropped, or a burst of steps would follow each slow picture.
    """

    control_dt: float
    """Simulated seconds of one control step."""
    speed: float = 1.0
    """Simulated seconds per wall second; ``inf`` means that a step is always due."""
    _budget: float = 0.0
    _last: float | None = None

    def start(self, now: float) -> None:
        """Start or restart the clock; the first step is due at once."""
        self._last, self._budget = now, self.control_dt

    def due(self, now: float) -> bool:
        """Whether a step may be taken at wall time `now` (seconds, monotonic)."""
        if self._last is None:
            self.start(now)
        assert self._last is not None
        if math.isinf(self.speed):
            return True
        earned = (now - self._last) * self.speed
        most = self.control_dt + _MAX_DEBT_SECONDS * self.speed
        self._budget, self._last = min(self._budget + earned, most), now
        return self._budget >= self.control_dt * (1 - 1e-9)

    def spend(self) -> None:
        """Subtract a control step from the budget."""
        if not math.isinf(self.speed):
            self._budget -= self.control_dt

    def wait(self) -> float:
        """Wall seconds until the next step is due, as seen at the last `due`."""
        if math.isinf(self.speed):
            return 0.0
        return max(0.0, (self.control_dt - self._budget) / self.speed)


@dataclass
class Rate:
    """Events per second over the last `window` seconds; over the last two events, if fewer than two lie in
    that time."""

    window: float = 1.0
    _times: deque[float] = field(default_factory=deque)

    def tick(self, now: float) -> None:
        self._times.append(now)
        self.per_second(now)  # drops older events

    def per_second(self, now: float) -> float:
        # Keep at least two: steps that take longer than the window have a rate too.
        while len(self._times) > 2 and now - self._times[0] > self.window:
            self._times.popleft()
        if len(self._times) < 2:
            return 0.0
        first, last = self._times[0], self._times[-1]
        # The pending step lowers the rate if it takes longer than all counted steps together.
        return (len(self._times) - 1) / max(last - first, now - last, 1e-9)

    def clear(self) -> None:
        self._times.clear()


@dataclass
class Shares:
    """Share of the last `window` seconds that each kind of work took."""

    window: float = 2.0
    _spent: deque[tuple[float, str, float]] = field(default_factory=deque)
    _since: float = -math.inf

    def add(self, what: str, seconds: float, now: float) -> None:
        """Add work of kind `what` that took `seconds` and ended at `now`."""
        self._spent.append((now, what, seconds))
        while now - self._spent[0][0] > self.window:
            self._spent.popleft()

    def of(self, what: str, now: float) -> float:
        """The share (0 to 1) that work of kind `what` took of the last `window` seconds, or of the time since
        `clear` if that is shorter."""
        begin = max(now - self.window, self._since)
        spent = sum(
            min(seconds, at - begin) for at, name, seconds in self._spent if name == what and at > begin
        )
        return min(1.0, spent / max(now - begin, 1e-9))

    def clear(self, now: float) -> None:
        self._spent.clear()
        self._since = now


def throttled(report: Callable[..., None], seconds: float) -> Callable[..., None]:
    """A function that calls `report` at most once in `seconds`, and not in the first `seconds`. It drops all other calls."""
    last = time.monotonic()

    def report_if_due(*arguments: Any) -> None:
        nonlocal last
        if time.monotonic() - last > seconds:
            last = time.monotonic()
            report(*arguments)

    return report_if_due

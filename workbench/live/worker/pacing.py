"""Realtime pacing: when the next control step is due, how many are made, how often progress is reported."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

_LONGEST_DEBT = 0.1
"""Most wall seconds of simulation that are caught up with."""


@dataclass
class Pacer:
    """A budget of simulated time, as in mjlab's base viewer.

    Wall time earns simulated time (times the speed), a step spends ``control_dt`` of it, and a step is due when there is
    enough. So the speed is right for steps of any cost, even if the loop is uneven. What the machine cannot keep up with
    is forgotten after `_LONGEST_DEBT`, or one slow picture would be followed by a burst.
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
        most = self.control_dt + _LONGEST_DEBT * self.speed
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
    """Events per second over the last second or so; over the last two seconds for slower events."""

    window: float = 1.0
    _times: deque[float] = field(default_factory=deque)

    def tick(self, now: float) -> None:
        self._times.append(now)
        self.per_second(now)  # forgets what is older

    def per_second(self, now: float) -> float:
        # Two are kept: steps that take longer than the window have a rate too.
        while len(self._times) > 2 and now - self._times[0] > self.window:
            self._times.popleft()
        if len(self._times) < 2:
            return 0.0
        first, last = self._times[0], self._times[-1]
        # The one that is due may take longer than the ones before.
        return (len(self._times) - 1) / max(last - first, now - last, 1e-9)

    def clear(self) -> None:
        self._times.clear()


@dataclass
class Shares:
    """Share of the last seconds that each kind of work took."""

    window: float = 2.0
    _spent: deque[tuple[float, str, float]] = field(default_factory=deque)
    _since: float = -math.inf

    def add(self, what: str, seconds: float, now: float) -> None:
        """Add work of kind `what` that took `seconds` and ended at `now`."""
        self._spent.append((now, what, seconds))
        while now - self._spent[0][0] > self.window:
            self._spent.popleft()

    def of(self, what: str, now: float) -> float:
        """Share (0 to 1) of the window, or of the time since `clear` while that is shorter."""
        begin = max(now - self.window, self._since)
        spent = sum(
            min(seconds, at - begin) for at, name, seconds in self._spent if name == what and at > begin
        )
        return min(1.0, spent / max(now - begin, 1e-9))

    def clear(self, now: float) -> None:
        self._spent.clear()
        self._since = now


def throttled(report: Callable[..., None], seconds: float) -> Callable[..., None]:
    """`report`, called at most every `seconds` and not in the first `seconds`; other calls are dropped."""
    last = time.monotonic()

    def report_if_due(*arguments: Any) -> None:
        nonlocal last
        if time.monotonic() - last > seconds:
            last = time.monotonic()
            report(*arguments)

    return report_if_due

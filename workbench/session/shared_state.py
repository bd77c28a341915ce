"""What a session knows, behind the one lock, and how a page hears that something of it is new.

Pages, the worker's thread, the file watcher and the recorder all change it. A page asks for everything at once
(`Session.view`), so it needs only be told *that* there is something: a counter, and a wait for its next value.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from workbench.session.live_state import LiveState


class SharedState:
    """See the module's text."""

    def __init__(self, state: LiveState) -> None:
        self.lock = threading.Lock()
        """Of `state`; to be held for moments only."""
        self.state = state
        self._changed = threading.Condition(self.lock)
        self._count = 0
        self._closing = False

    @contextmanager
    def changing(self) -> Iterator[LiveState]:
        """The state, with the lock held, to set fields of it; then notes that they are new."""
        with self.lock:
            yield self.state
        self.note()

    def note(self) -> None:
        """Something is new. Not to be called with the lock held."""
        with self._changed:
            self._count += 1
            self._changed.notify_all()

    def wait(self, seen: int, timeout: float) -> int:
        """Block until something is new since the counter `seen`; returns the counter as it is now."""
        with self._changed:
            self._changed.wait_for(lambda: self._count != seen or self._closing, timeout)
            return self._count

    def close(self) -> None:
        """From now on nobody waits."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()

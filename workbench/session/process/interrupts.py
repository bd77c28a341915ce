"""Stopping the author's code by hand, where that is possible, and never the workbench's own.

A signal's handler runs in the main thread between two bytecodes, and may raise there: a Python loop that
never ends is left with a traceback that names the author's line. It must not raise anywhere else: half a
message in the pipe would end the session. So a signal counts only inside `Interrupts.run`, and what must be
whole in there is done under `Interrupts.shielded`. Native code that does not come back, and a loop that
catches everything, cannot be left in this way; the server sees that it goes on, and says so.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from workbench.authoring.problem import Interrupted

INTERRUPT_SIGNAL = signal.SIGUSR1
"""Not SIGINT, for which libraries and authors install handlers of their own."""
STACK_SIGNAL = signal.SIGUSR2
"""Makes the worker write its stack into the file that it was given, without the interpreter's help."""


class Interrupts:
    """Of the worker's main thread; see the module's text."""

    def __init__(self) -> None:
        self._allowed = False
        self._waiting = False
        self._began = 0.0

    def install(self) -> None:
        """From now on the signal is heard; before, it would end the process."""
        signal.signal(INTERRUPT_SIGNAL, self._on_signal)

    def run(self, work: Callable[[], object]) -> None:
        """Do `work`, which a signal may leave.

        Raises:
            Interrupted: it did.
        """
        self._began, self._waiting = time.monotonic(), False
        try:
            self._allowed = True
            work()
        finally:
            self._allowed = False

    @contextmanager
    def shielded(self) -> Iterator[None]:
        """What is done in here is done whole; a signal that came meanwhile is raised afterwards."""
        before, self._allowed = self._allowed, False
        try:
            yield
        finally:
            self._allowed = before
        if before and self._waiting:
            self._raise()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self._allowed:
            self._raise()
        # Between two pieces of work there is nothing to stop; under a shield it is raised at its end.
        self._waiting = True

    def _raise(self) -> None:
        self._waiting = False
        raise Interrupted(f"stopped by hand after {time.monotonic() - self._began:.1f} s")

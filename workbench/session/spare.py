"""A second worker that waits, warmed up, for the first one to die.

A worker that starts from nothing imports torch, SAPIEN and ManiSkill (4 s and more), makes a render system and
has its shaders compiled (5 to 19 s on a software renderer). Somebody whose task has just crashed should not
wait for that. So once a task runs, another process does all of it in the background and then sleeps; it
costs memory (`memory` says how much) and no time. When it is taken, the next one is begun a while later.
"""

from __future__ import annotations

import time

from workbench.jobs.wire import Answer, Call
from workbench.session.messages import WarmUp
from workbench.session.process import WorkerProcess

_DELAY = 5.0
"""Seconds after a task was loaded in which the machine is left to the page."""
_MOST_FAILURES = 2
"""Spares that may die of their warming up; after that the machine cannot have one."""


class SpareWorker:
    """At most one waiting process. Used on one thread, which must live as long as the processes."""

    def __init__(self, warm_up: WarmUp) -> None:
        self._warm_up = warm_up
        self._process: WorkerProcess | None = None
        self._ready = False
        self._failures = 0
        self._due: float | None = None

    def begin_soon(self) -> None:
        """The first worker is well: there may be a spare, after a while."""
        if self._process is None and self._due is None and self._failures < _MOST_FAILURES:
            self._due = time.monotonic() + _DELAY

    def attend(self) -> None:
        """Start one if it is due, and notice how it does; takes no time."""
        if self._process is None:
            if self._due is not None and time.monotonic() >= self._due:
                self._due = None
                # What it prints is of ManiSkill's and the renderer's making, and was seen before.
                self._process = WorkerProcess(lambda stream, piece: False)
                self._process.send(Call(0, self._warm_up))
            return
        try:
            while (event := self._process.receive(timeout=0)) is not None:
                self._ready = self._ready or isinstance(event, Answer)
        except EOFError:
            self._failures += 1
            self.stop()
            self.begin_soon()

    def take(self) -> WorkerProcess | None:
        """The spare, which is the caller's from now on; None if there is none. It may not be quite ready."""
        self.attend()
        taken, self._process, self._ready, self._due = self._process, None, False, None
        return taken

    @property
    def ready(self) -> bool:
        return self._process is not None and self._ready

    @property
    def memory(self) -> int:
        """Bytes that it holds; 0 when there is none."""
        process = self._process
        return 0 if process is None else process.memory()

    def kill(self) -> None:
        """Have it end, without waiting for it; `stop` does that."""
        if self._process is not None:
            self._process.kill()

    def stop(self) -> None:
        """End it; it has nothing to lose."""
        process, self._process, self._ready, self._due = self._process, None, False, None
        if process is not None:
            process.stop(grace=0.0)

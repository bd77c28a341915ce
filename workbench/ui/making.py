"""Something is made from recordings in a process of its own, while the page goes on.

Encoding a film takes a core for a while, and drawing a scene takes a renderer that the server's process must not
import (a crash in a driver would take the page along). What is stopped before it is finished leaves nothing.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import tempfile
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType

from workbench.jobs.pool import Deal, PoolError, Processes, Share, Work
from workbench.machine.software_vulkan import ensure_render_device
from workbench.ui.fragments import sentence
from workbench.ui.make_shared import Made, Wanted, make

END_SECONDS = 5.0
SAY_EVERY = 0.1
"""Seconds. A sheet of pictures is quick, and a line a frame would be more to read than to make."""


@dataclass(frozen=True)
class MakingView:
    """How it stands."""

    running: bool = False
    done: float = 0.0
    """0..1"""
    doing: str = ""
    problem: str = ""
    """Why it could not be made, in a sentence; empty if it could, or was stopped."""
    made: tuple[Made, ...] = ()
    """All that was made so far, the newest first."""


class Making:
    """At most one thing at a time. All methods may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._view = MakingView()
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None
        self._scratch: Path | None = None

    def view(self) -> MakingView:
        return self._view

    def scratch(self) -> Path:
        """A folder for what is fetched by the page and then not needed any more; gone after `close`."""
        with self._lock:
            if self._scratch is None:
                self._scratch = Path(tempfile.mkdtemp(prefix="workbench-shared-"))
            return self._scratch

    def start(self, wanted: Wanted) -> bool:
        """Begin; False where something is made already."""
        with self._lock:
            if self._view.running:
                return False
            self._stopped.clear()
            self._view = MakingView(running=True, doing="starting", made=self._view.made)
            self._thread = threading.Thread(target=self._run, args=(wanted,), name="making", daemon=True)
            self._thread.start()
            return True

    def stop(self) -> None:
        """End what is made now; nothing of it stays. Returns at once."""
        self._stopped.set()

    def close(self) -> None:
        """Stop, wait for the end of the process, and take the scratch folder away."""
        self.stop()
        if self._thread is not None:
            # One that hangs is ended with this process, by its `machine.family`.
            self._thread.join(END_SECONDS)
        if self._scratch is not None:
            shutil.rmtree(self._scratch, ignore_errors=True)

    def _run(self, wanted: Wanted) -> None:
        came: list[Made | str] = []
        work = Work(_make, (wanted,), Made | str, tuple[float, str], "that makes it")
        deal: Deal[Made | str, tuple[float, str]] = Deal(
            range(1), lambda number, one: came.append(one), self._hear, self._stopped.is_set
        )
        try:
            Processes().run(work, deal)
        except OSError as error:
            came.append(f"The process that makes it could not be started: {error}.")
        except PoolError as error:
            came.append(sentence(str(error)))
        with self._lock:
            made = tuple(one for one in came if isinstance(one, Made))
            problem = "".join(one for one in came if isinstance(one, str) and not self._stopped.is_set())
            self._view = MakingView(problem=problem, made=(*made, *self._view.made))

    def _hear(self, news: tuple[float, str]) -> None:
        with self._lock:
            self._view = replace(self._view, done=news[0], doing=news[1])


class _Stopped(BaseException):
    """Goes through the blocks that take half-written files away."""


def _make(wanted: Wanted, share: Share) -> None:
    """In the other process."""
    said_at = 0.0

    def on_progress(done: float, doing: str) -> None:
        nonlocal said_at
        if time.monotonic() - said_at >= SAY_EVERY:
            said_at = time.monotonic()
            share.say((done, doing))

    def look(number: int, frame: FrameType | None) -> None:
        if share.limit() == 0:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            raise _Stopped

    if share.next() is None:
        return
    # By a signal: a film of an episode takes a while in which nobody says how far it is.
    signal.signal(signal.SIGALRM, look)
    signal.setitimer(signal.ITIMER_REAL, SAY_EVERY, SAY_EVERY)
    if wanted.what == "scene":
        os.environ.update(ensure_render_device(install=False).env)
    made: Made | str
    with contextlib.suppress(_Stopped):
        try:
            made = make(wanted, on_progress)
        except (ValueError, OSError, RuntimeError) as error:
            made = str(error)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        share.tell(0, made)

"""Threads that report exceptions and restart, and threads that run only on idle cores."""

from __future__ import annotations

import logging
import os
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

logger = logging.getLogger(__name__)

FIRST_BACKOFF_SECONDS, MAX_BACKOFF_SECONDS = 0.05, 5.0
"""Backoff before a thread is restarted; doubled at each failure."""
_POLL_SECONDS = 0.05
"""Interval between checks whether a caller waits."""

_listeners: list[Callable[[str], None]] = []
_lock = threading.Lock()


def watched_thread(name: str, work: Callable[[], None]) -> threading.Thread:
    """A thread (not started yet) that runs `work` until it returns, and restarts it after each exception.

    `work` must be restartable, such as a loop over a queue.
    """

    def keep_at_it() -> None:
        pause = FIRST_BACKOFF_SECONDS
        while True:
            try:
                return work()
            except Exception as error:
                report_failure(f"The thread '{name}' failed and is started again", error)
            threading.Event().wait(pause)
            pause = min(2 * pause, MAX_BACKOFF_SECONDS)

    return threading.Thread(target=keep_at_it, name=name, daemon=True)


def report_failure(what: str, error: BaseException) -> None:
    """Report a failure of the workbench itself to the listeners, or to the log if there are none.

    Args:
        what: a sentence without its full stop.
    """
    text = f"{what}: {type(error).__name__}: {error}. This is a fault of the workbench.\n"
    text += "".join(traceback.format_exception(error))
    with _lock:
        listeners = list(_listeners)
    if not listeners:
        logger.error("%s", text)
    for listener in listeners:
        try:
            listener(text)
        except Exception:
            # The listener itself may fail, for example because its terminal is gone.
            logger.exception("%s", text)


def listen(listener: Callable[[str], None]) -> None:
    """Call `listener`, on any thread, with the text of each failure, until `stop_listening`."""
    with _lock:
        _listeners.append(listener)


def stop_listening(listener: Callable[[str], None]) -> None:
    with _lock:
        if listener in _listeners:
            _listeners.remove(listener)


@contextmanager
def on_free_cores(wanted: Callable[[], bool]) -> Iterator[None]:
    """Context in which the threads of this process, and threads that they start, run only on cores that are idle.

    A nice value is not enough: on two busy cores, play at unlimited speed was slower next to a process at
    nice 10. The other processes that use the cores must be in the session of this process (see
    `begin_family`).

    Args:
        wanted: polled; after it returns True, the threads run normally, since a caller waits for this process.
    """
    done = threading.Event()
    low = {int(thread) for thread in os.listdir("/proc/self/task")}

    def watch() -> None:
        while not done.wait(_POLL_SECONDS) and not wanted():
            pass
        _schedule(os.SCHED_OTHER, {int(thread) for thread in os.listdir("/proc/self/task")})

    watching = threading.Thread(target=watch, name="on-free-cores", daemon=True)
    watching.start()
    _schedule(os.SCHED_IDLE, low)
    try:
        yield
    finally:
        done.set()
        watching.join()


def _schedule(policy: int, threads: set[int]) -> None:
    for thread in threads:
        # The thread may have ended, or a container may forbid the call.
        with suppress(OSError):
            os.sched_setscheduler(thread, policy, os.sched_param(0))

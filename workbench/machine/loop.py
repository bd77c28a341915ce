"""The asyncio loop on whose thread all state of sessions changes.

Requests of pages, events of workers and results of jobs are *changes*, which run one after the other, each to
its end. So the state needs no lock, and no reader sees a half-made change. Nothing may block the loop:
blocking calls (a disk, another process) are awaited, or run in a `BlockingPool`. Commands that serve pages
run the loop in the main thread (`loop_in_main`); elsewhere a daemon thread runs it, from the first use until
the process ends.
"""

from __future__ import annotations

import asyncio
import functools
import queue
import signal
import threading
from collections.abc import Callable, Coroutine
from concurrent import futures
from typing import Any, ParamSpec, TypeVar

from workbench.machine.processes.watched_thread import report_failure

_POLL_SECONDS = 0.05
"""Interval at which `result_of` calls `check`."""
_tasks: set[asyncio.Task[Any]] = set()
Value = TypeVar("Value")
Args = ParamSpec("Args")


_here = threading.local()
_beginning = threading.Lock()
_begun: asyncio.AbstractEventLoop | None = None


def _loop() -> asyncio.AbstractEventLoop:
    global _begun
    with _beginning:
        if _begun is None:
            _begun = _new_loop()
            threading.Thread(target=_run, args=(_begun.run_forever,), name="loop", daemon=True).start()
        return _begun


def _new_loop() -> asyncio.AbstractEventLoop:
    loop = asyncio.new_event_loop()
    loop.set_exception_handler(_report)
    return loop


def _run(run: Callable[[], Value]) -> Value:
    _here.is_loop = True
    return run()


def loop_in_main(command: Callable[Args, Value]) -> Callable[Args, Value]:
    """Wrap a command to run on its own thread, where it may block, while the loop runs on the calling thread.

    The calling thread must be the main thread of a process that has not used the loop before and does not use it after the
    command.

    Raises:
        KeyboardInterrupt: on Ctrl-C, until the command calls `on_signal`. The command's thread keeps running.
    """

    @functools.wraps(command)
    def called(*args: Args.args, **kwargs: Args.kwargs) -> Value:
        global _begun
        with _beginning:
            assert _begun is None, "the loop runs on another thread already"
            loop = _begun = _new_loop()
        work = functools.partial(command, *args, **kwargs)
        task = loop.create_task(BlockingPool("command").run(work))
        # Without a handler, Python raises KeyboardInterrupt in whatever change is running.
        loop.add_signal_handler(signal.SIGINT, task.cancel)
        try:
            return _run(lambda: loop.run_until_complete(task))
        except asyncio.CancelledError:
            raise KeyboardInterrupt from None

    return called


def on_signal(number: signal.Signals, change: Callable[[], object]) -> None:
    """Run a change at each signal of this number. The loop must run in the main thread."""
    do(lambda: _loop().add_signal_handler(number, change))


def _report(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Report the exception of a task that is not awaited."""
    report_failure(context["message"], context.get("exception") or RuntimeError("of unknown cause"))


def is_here() -> bool:
    """Whether this is the loop's thread."""
    return getattr(_here, "is_loop", False)


def do(change: Callable[[], Value]) -> Value:
    """Run a change on the loop and wait for it; returns its result, or raises its exception."""
    if is_here():
        return change()
    made: futures.Future[Value] = futures.Future()

    def make() -> None:
        try:
            made.set_result(change())
        except BaseException as error:
            made.set_exception(error)

    _loop().call_soon_threadsafe(make)
    return made.result()


def post(change: Callable[[], object]) -> None:
    """Schedule a change on the loop. Its exception is reported."""

    def make() -> None:
        try:
            change()
        except Exception as error:
            report_failure("A change failed", error)

    _loop().call_soon_threadsafe(make)


def on_loop(method: Callable[Args, Value]) -> Callable[Args, Value]:
    """Wrap a method to run on the loop, from any calling thread."""

    @functools.wraps(method)
    def called(*args: Args.args, **kwargs: Args.kwargs) -> Value:
        return do(functools.partial(method, *args, **kwargs))

    return called


def begin(work: Coroutine[Any, Any, Value]) -> asyncio.Task[Value]:
    """Start a coroutine on the loop. Must be called on the loop's thread."""
    task = _loop().create_task(work)
    _tasks.add(task)  # asyncio itself holds tasks weakly
    task.add_done_callback(_tasks.discard)
    return task


def later(seconds: float, change: Callable[[], object]) -> asyncio.TimerHandle:
    """Schedule a change after `seconds`; the returned handle cancels it. Must be called on the loop's
    thread."""
    return _loop().call_later(seconds, change)


def submit(work: Coroutine[Any, Any, Value]) -> futures.Future[Value]:
    """Start a coroutine on the loop, from another thread."""
    return asyncio.run_coroutine_threadsafe(work, _loop())


def result_of(work: Coroutine[Any, Any, Value], check: Callable[[], None] = lambda: None) -> Value:
    """Run a coroutine on the loop and wait for its result. Must not be called on the loop's thread.

    Args:
        check: polled while waiting; its exception cancels the work, and is raised.
    """
    future = submit(work)
    while True:
        done, _ = futures.wait([future], _POLL_SECONDS)
        if done:
            return future.result()
        try:
            check()
        except BaseException:
            future.cancel()
            raise


def wait_for_disk(done: futures.Future[Any] | None) -> None:
    """Wait for a result of a `BlockingPool`, at most one second, since a disk may hang. Returns at once on the loop."""
    if done is not None and not is_here():
        futures.wait([done], timeout=1.0)


class ChangeCounter:
    """Counts changes, for pages that wait for the next one. Thread-safe."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.count = 0
        self._closing = False

    def notify(self) -> None:
        """Count a change and wake all waiters."""
        with self._changed:
            self.count += 1
            self._changed.notify_all()

    def wait(self, seen: int, timeout: float) -> int:
        """Block until the count differs from `seen`, at most `timeout` seconds; returns the count."""
        with self._changed:
            self._changed.wait_for(lambda: self.count != seen or self._closing, timeout)
            return self.count

    def close(self) -> None:
        """Wake all waiters; from now on `wait` returns at once."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()


class BlockingPool:
    """A thread that runs blocking calls one after the other. It starts at the first use, and the process does not wait for
    it at exit: a call that hangs on a disk cannot be ended."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._work: queue.SimpleQueue[tuple[Callable[[], Any], futures.Future[Any]] | None] = (
            queue.SimpleQueue()
        )
        self._thread: threading.Thread | None = None
        self._ended = False

    def begin(self, work: Callable[[], Value]) -> futures.Future[Value]:
        """Queue `work` behind earlier work. After `end`, the returned future is already cancelled. Must be
        called on the loop's thread."""
        made: futures.Future[Value] = futures.Future()
        if self._ended:
            made.cancel()
            return made
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            self._thread.start()
        self._work.put((work, made))
        return made

    async def run(self, work: Callable[[], Value]) -> Value:
        """Queue `work` and wait for its result. Cancelling the caller does not stop `work`."""
        return await asyncio.wrap_future(self.begin(work))

    def end(self) -> None:
        """End the thread when all queued work is done."""
        self._ended = True
        self._work.put(None)

    def close(self, within: float | None = None) -> None:
        """End the thread when all queued work is done, and wait for that up to `within` seconds (None: for
        ever). Must not be called on the loop's thread."""
        do(self.end)  # on the loop, where `begin` may be about to start the thread
        if self._thread is not None:
            self._thread.join(within)

    def _run(self) -> None:
        while (next_work := self._work.get()) is not None:
            work, made = next_work
            # Skip a future that was cancelled before it began.
            if not made.set_running_or_notify_cancel():
                continue
            try:
                made.set_result(work())
            except BaseException as error:
                made.set_exception(error)

"""The one thread on which the state of sessions changes: an asyncio loop.

What pages ask for, what a worker says and what jobs come to are changes, made one after the other, each whole. So no lock
guards what they change, and what is read is of one moment. Nothing on the loop blocks: what does (a disk, another process)
is awaited, or done by an `BlockingPool`. Commands that serve pages run the loop in the main thread (`loop_in_main`); elsewhere a
daemon thread runs it from the first use on, as long as the process lasts.
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
"""Seconds between two checks whether a result is still wanted."""
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
    """Make a command run on a thread of its own, where it may block, and the loop on the calling thread meanwhile. That is
    the main thread of a process that has not used the loop before and does not use it after the command.

    Raises:
        KeyboardInterrupt: on Ctrl-C, until the command calls `on_signal`. The command's thread is left behind.
    """

    @functools.wraps(command)
    def called(*args: Args.args, **kwargs: Args.kwargs) -> Value:
        global _begun
        with _beginning:
            assert _begun is None, "the loop runs on another thread already"
            loop = _begun = _new_loop()
        work = functools.partial(command, *args, **kwargs)
        task = loop.create_task(BlockingPool("command").run(work))
        # Else Python raises it in whatever change the loop is making.
        loop.add_signal_handler(signal.SIGINT, task.cancel)
        try:
            return _run(lambda: loop.run_until_complete(task))
        except asyncio.CancelledError:
            raise KeyboardInterrupt from None

    return called


def on_signal(number: signal.Signals, change: Callable[[], object]) -> None:
    """Make a change at each signal of this number. The loop must run in the main thread."""
    do(lambda: _loop().add_signal_handler(number, change))


def _report(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Report what a task raised that nobody awaits."""
    report_failure(context["message"], context.get("exception") or RuntimeError("of unknown cause"))


def is_here() -> bool:
    """Whether this is the loop's thread."""
    return getattr(_here, "is_loop", False)


def do(change: Callable[[], Value]) -> Value:
    """Make a change on the loop, and wait for it; returns what it returns, and raises what it raises."""
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
    """Make a change on the loop soon. What it raises is reported."""

    def make() -> None:
        try:
            change()
        except Exception as error:
            report_failure("A change failed", error)

    _loop().call_soon_threadsafe(make)


def on_loop(method: Callable[Args, Value]) -> Callable[Args, Value]:
    """Make a method run on the loop, from any calling thread."""

    @functools.wraps(method)
    def called(*args: Args.args, **kwargs: Args.kwargs) -> Value:
        return do(functools.partial(method, *args, **kwargs))

    return called


def begin(work: Coroutine[Any, Any, Value]) -> asyncio.Task[Value]:
    """Begin work on the loop; called there."""
    task = _loop().create_task(work)
    _tasks.add(task)  # asyncio itself holds tasks weakly
    task.add_done_callback(_tasks.discard)
    return task


def later(seconds: float, change: Callable[[], object]) -> asyncio.TimerHandle:
    """Make a change after some seconds, unless it is cancelled; called on the loop."""
    return _loop().call_later(seconds, change)


def submit(work: Coroutine[Any, Any, Value]) -> futures.Future[Value]:
    """Begin work on the loop, from another thread."""
    return asyncio.run_coroutine_threadsafe(work, _loop())


def result_of(work: Coroutine[Any, Any, Value], check: Callable[[], None] = lambda: None) -> Value:
    """Wait for work on the loop; called on another thread than the loop.

    Args:
        check: called often meanwhile; what it raises cancels the work, and is raised.
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
    """Wait for the result of an `BlockingPool`, at most one second: a disk may hang. Called on another thread than the loop."""
    if done is not None and not is_here():
        futures.wait([done], timeout=1.0)


class ChangeCounter:
    """Counts the changes of something, for pages that wait for the next. Thread-safe."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.count = 0
        self._closing = False

    def notify(self) -> None:
        """There was a change."""
        with self._changed:
            self.count += 1
            self._changed.notify_all()

    def wait(self, seen: int, timeout: float) -> int:
        """Block until the count differs from `seen`; returns the count."""
        with self._changed:
            self._changed.wait_for(lambda: self.count != seen or self._closing, timeout)
            return self.count

    def close(self) -> None:
        """Wake all that wait; `wait` returns at once from now on."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()


class BlockingPool:
    """A thread that runs blocking calls one after the other. It begins with the first use, and the end of the process
    does not wait for it: a call into a disk that hangs cannot be ended."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._work: queue.SimpleQueue[tuple[Callable[[], Any], futures.Future[Any]] | None] = (
            queue.SimpleQueue()
        )
        self._thread: threading.Thread | None = None
        self._ended = False

    def begin(self, work: Callable[[], Value]) -> futures.Future[Value]:
        """Queue `work` behind the work begun before; it is cancelled if the thread has ended. Called on the loop."""
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
        """End the thread when all queued work is done, and wait for that, at most so many seconds; called on another thread
        than the loop."""
        self.end()
        if self._thread is not None:
            self._thread.join(within)

    def _run(self) -> None:
        while (next_work := self._work.get()) is not None:
            work, made = next_work
            # A future that was cancelled before it began is left out.
            if not made.set_running_or_notify_cancel():
                continue
            try:
                made.set_result(work())
            except BaseException as error:
                made.set_exception(error)

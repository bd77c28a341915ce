"""A worker beside the one that plays, for the jobs of one lane: started when first wanted, asked one thing at a time.

Judging the past, drawing it again, looking at cameras over many seeds: each takes seconds or minutes, while the worker that
plays must go on playing. So each has a process of its own, with a lower priority. It costs some seconds to start
and some 0.75 GB, so it is kept between jobs and ended when there was none in a while (`Lane`).

A process answers in order. A job that is stopped leaves one answer owed: it is taken later (`settle`), or the process is
ended. One that dies ends the job that asked it, and the next starts another.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from workbench.machine.family import describe_exit
from workbench.session.lane import Job, JobFailed
from workbench.session.message_reader import Unreadable
from workbench.session.messages import Event, Request
from workbench.session.process import WorkerProcess

_LOOK = 0.05
"""Seconds between two looks at whether the job is to stop."""
_NICENESS = 10
_Kind = TypeVar("_Kind", bound=Event)


class BackgroundProcess:
    """See the module's text. All but `pid` on the lane's thread."""

    def __init__(self, that: str, to: str) -> None:
        """
        Args:
            that: what it does, as in "the process *that judges* was killed by SIGKILL".
            to: what for, as in "no process could be started *to judge with*".
        """
        self._that, self._to = that, to
        self._process: WorkerProcess | None = None
        self._owed: tuple[type[Event], ...] = ()

    @property
    def pid(self) -> int | None:
        """None while there is no process."""
        process = self._process
        return None if process is None else process.pid

    @property
    def there(self) -> bool:
        return self._process is not None

    def start(self) -> None:
        """Have one.

        Raises:
            JobFailed: none could be started.
        """
        if self._process is None:
            try:
                self._process = _start()
            except OSError as error:
                raise JobFailed(f"no process could be started {self._to}: {error}") from error

    def send(self, request: Request) -> None:
        assert self._process is not None
        self._process.send(request)

    def answer(self, job: Job, *kinds: type[_Kind]) -> _Kind:
        """The next event of these kinds; others are dropped.

        Raises:
            Stopped: nobody waits for it any more; it is still owed.
            JobFailed: the process died.
        """
        self._owed = kinds
        while True:
            job.check()
            try:
                event = self._receive()
            except EOFError as error:
                why = self._why_gone(error)
                self.end()
                job.check()
                raise JobFailed(f"the process {self._that} {why}") from None
            if isinstance(event, kinds):
                return event

    def owes(self, kind: type[Event]) -> bool:
        """Whether a job was stopped while it waited for this."""
        return kind in self._owed

    def settle(
        self,
        patience: float,
        give_up: Callable[[], bool] = lambda: False,
        for_this: type[Event] | None = None,
    ) -> None:
        """Take the answer that is still owed, or end the process that does not give it in so many seconds.

        Args:
            give_up: asked meanwhile; True leaves it owed, for a process that is about to be ended.
            for_this: wait for this instead, which is the answer to the last of several requests.
        """
        if for_this is not None:
            self._owed = (for_this,)
        deadline = time.monotonic() + patience
        try:
            while self._owed and not give_up():
                if time.monotonic() > deadline:
                    self.end()
                    return
                self._receive()
        except EOFError:
            self.end()  # of what it was asked for last; the next job starts another

    def end(self) -> None:
        """End it, if there is one. `pid` is its own until it has ended."""
        if self._process is not None:
            self._process.stop(grace=0.0)
        self._process, self._owed = None, ()

    def _why_gone(self, error: EOFError) -> str:
        if isinstance(error, Unreadable):
            return f"sent what cannot be read ({error}) and was ended"
        return describe_exit(None if self._process is None else self._process.exit_code())

    def _receive(self) -> Event | None:
        """What is owed; None if it has not come yet."""
        assert self._process is not None
        event = self._process.receive(timeout=_LOOK)
        if not isinstance(event, self._owed):
            return None
        self._owed = ()
        return event


def _start() -> WorkerProcess:
    # What the author's code prints in it is heard of the worker that plays, and not said twice.
    # With a low priority: after the one that plays, where there are fewer cores than work.
    return WorkerProcess(lambda stream, piece: False, _NICENESS)

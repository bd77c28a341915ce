"""A recording by several processes: the episodes are dealt out from here, so they are the same as in one.

Each process opens the task and has its share of the envs and of the cores. It asks for the number of the next episode
when an env is free, says when one is over, and is told which are kept; it writes its files itself. Ctrl-C in the
terminal reaches all of them at once, so they do not listen to it: this one does, and tells them. One that dies takes
its episodes under way along, and the recording ends with a sentence; what it left is mended at the next start.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from workbench.authoring.problem import Problem, TaskError
from workbench.core.rules import Finding
from workbench.recording.landing import RecordingError
from workbench.session.dealer import Dealer
from workbench.session.process import describe_exit
from workbench.session.record import (
    Progress,
    Recorded,
    RecordOptions,
    Written,
    run_episodes,
    with_given_actions,
)

_LOOK = 0.1
_ENDING_SECONDS = 120.0
"""In which a process that was told to stop must have written what is over."""


def record_in_processes(
    what: RecordOptions,
    dealer: Dealer,
    on_activity: Callable[[str], None],
    on_progress: Callable[[Progress], None],
    stop: Callable[[], bool],
    on_finding: Callable[[Finding], None],
) -> Recorded:
    """See `record.record`, which this is the other way of doing; raises as it does."""
    workers = _start(what)
    parent = _Parent(workers, dealer, on_activity, on_progress, on_finding)
    try:
        parent.serve(stop)
    except KeyboardInterrupt:
        # Asked for a second time: they may be where nothing reaches them. What they had written is mended later.
        parent.kill()
        raise
    finally:
        parent.end()
    parent.written.sort(key=lambda episode: episode.index)
    return Recorded(tuple(parent.written), dealer.tried, stop(), parent.put_right)


def shares(num_envs: int, workers: int) -> list[int]:
    """Envs of each process; no process without one."""
    workers = min(workers, num_envs)
    return [num_envs // workers + (i < num_envs % workers) for i in range(workers)]


def _start(what: RecordOptions) -> dict[Connection, BaseProcess]:
    context = multiprocessing.get_context("spawn")
    workers: dict[Connection, BaseProcess] = {}
    envs = shares(what.options.num_envs, what.workers)
    cores = sorted(os.sched_getaffinity(0))
    for i, count in enumerate(envs):
        ours, theirs = context.Pipe()
        share = replace(what, workers=1, options=replace(what.options, num_envs=count))
        own_cores = cores[i :: len(envs)] or cores
        process = context.Process(target=_work, args=(theirs, share, own_cores), daemon=True)
        process.start()
        theirs.close()  # or its end would not be seen
        workers[ours] = process
    return workers


class _Parent:
    def __init__(
        self,
        workers: dict[Connection, BaseProcess],
        dealer: Dealer,
        on_activity: Callable[[str], None],
        on_progress: Callable[[Progress], None],
        on_finding: Callable[[Finding], None],
    ) -> None:
        self._workers, self._dealer = workers, dealer
        self._on_activity, self._on_progress = on_activity, on_progress
        self._on_finding = on_finding
        self._found: set[object] = set()
        """Each process finds the same, and it is told once."""
        self._steps = 0
        self._busy = set(workers)
        self._whose: dict[int, Connection] = {}
        """Which process has an episode."""
        self.written: list[Written] = []
        self.put_right = 0

    def serve(self, stop: Callable[[], bool]) -> None:
        told, since = False, 0.0
        while self._busy:
            if stop() and not told:
                told, since = True, time.monotonic()
                for connection in self._busy:
                    self._tell(connection, ("stop", None))
            if told and time.monotonic() - since > _ENDING_SECONDS:
                raise RecordingError(
                    "a process that records did not end in time; its episodes are mended later"
                )
            for connection in wait(list(self._busy), _LOOK):
                assert isinstance(connection, Connection)
                try:
                    word, value = connection.recv()
                except (EOFError, OSError):
                    raise RecordingError(
                        f"a process that records {describe_exit(self._exit_code(connection))}; what was over is kept"
                    ) from None
                self._hear(connection, word, value)

    def kill(self) -> None:
        for process in self._workers.values():
            process.kill()

    def end(self) -> None:
        for connection in self._busy:
            self._tell(connection, ("stop", None))
        deadline = time.monotonic() + _ENDING_SECONDS
        for connection, process in self._workers.items():
            while process.is_alive() and connection in self._busy and time.monotonic() < deadline:
                self._take_what_is_written(connection)
            process.join(timeout=10.0)
            if process.is_alive():
                process.kill()
                process.join()
            connection.close()

    def _take_what_is_written(self, connection: Connection) -> None:
        try:
            while connection.poll(_LOOK):
                word, value = connection.recv()
                if word == "next":
                    self._tell(connection, ("index", None))
                elif word == "written":
                    self.written.append(value)
                elif word == "done":
                    self._busy.discard(connection)
                    return
        except (EOFError, OSError):
            self._busy.discard(connection)

    def _hear(self, connection: Connection, word: str, value: Any) -> None:
        if word == "next":
            index = self._dealer.next()
            if index is not None:
                self._whose[index] = connection
            self._tell(connection, ("index", index))
        elif word == "ended":
            self._dealer.ended(*value)
            for index, keep in self._dealer.decided():
                self._tell(self._whose[index], ("decided", (index, keep)))
        elif word == "written":
            self.written.append(value)
            self._on_progress(Progress(self._dealer.kept, self._steps))
        elif word == "steps":
            self._steps += value
            self._on_progress(Progress(self._dealer.kept, self._steps))
        elif word == "activity":
            self._on_activity(value)
        elif word == "finding":
            if value.key not in self._found:
                self._found.add(value.key)
                self._on_finding(value)
        elif word == "done":
            self.put_right += value
            self._busy.discard(connection)
        elif word == "failed":
            self._busy.discard(connection)
            if isinstance(value, Problem):
                raise TaskError(value)
            raise RecordingError(value)

    def _exit_code(self, connection: Connection) -> int | None:
        process = self._workers[connection]
        process.join(timeout=2.0)
        self._busy.discard(connection)
        return process.exitcode

    def _tell(self, connection: Connection, message: tuple[str, Any]) -> None:
        try:
            connection.send(message)
        except (BrokenPipeError, OSError):
            pass  # it is gone, and `serve` says so when it reads


# --- in the process --------------------------------------------------------------------------------


class _FarDealing:
    """The dealer, on the other side of a pipe."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._decided: list[tuple[int, bool]] = []
        self.stopped = False

    def next(self) -> int | None:
        if self.stopped:
            return None
        self._connection.send(("next", None))
        while True:
            word, value = self._connection.recv()
            if word == "index":
                return value
            self._note(word, value)

    def ended(self, index: int, success: bool) -> None:
        self._connection.send(("ended", (index, success)))

    def decided(self) -> list[tuple[int, bool]]:
        while self._connection.poll(0):
            self._note(*self._connection.recv())
        told, self._decided = self._decided, []
        return told

    def wait(self) -> None:
        if not self._decided and not self.stopped:
            self._note(*self._connection.recv())

    def _note(self, word: str, value: Any) -> None:
        if word == "decided":
            self._decided.append(value)
        elif word == "stop":
            self.stopped = True


def _work(connection: Connection, what: RecordOptions, cores: list[int]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # PhysX and the software renderer take a thread for each core that the process may use.
    os.sched_setaffinity(0, cores)
    dealing = _FarDealing(connection)
    try:
        what, given = with_given_actions(what)
        put_right = run_episodes(
            what,
            given,
            dealing,
            lambda written: connection.send(("written", written)),
            lambda activity: connection.send(("activity", activity)),
            lambda steps: connection.send(("steps", steps)),
            lambda: dealing.stopped,
            lambda finding: connection.send(("finding", finding)),
        )
        connection.send(("done", put_right))
    except TaskError as error:
        connection.send(("failed", error.problem))
    except (EOFError, BrokenPipeError):
        return  # the process that started this one is gone
    except (OSError, ValueError, RuntimeError) as error:
        connection.send(("failed", str(error)))

"""A process that records its share of the episodes; `record_workers` starts it and deals them out.

It is started as ``python -m workbench.session.record_worker SOCKET PARENT``: a file descriptor and the process id of
the command. First come its cores and what is to be recorded, then the dealing; what it answers is in `record_workers`.
"""

from __future__ import annotations

import os
import sys
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from workbench.machine.guarded_terminal import guard_terminal
from workbench.machine.quick_imports import quick_imports
from workbench.session.breakpoints import ONE_PROCESS, refuse_breakpoints
from workbench.session.family import begin_family

if TYPE_CHECKING:
    from workbench.session.record import RecordOptions


def main() -> None:
    """Entry of the process."""
    connection, parent = map(int, sys.argv[1:3])
    begin_family(parent)
    guard_terminal()
    refuse_breakpoints(ONE_PROCESS)
    try:
        _work(Connection(connection))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return  # the process that started this one is gone


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


def _work(connection: Connection) -> None:
    # PhysX and the software renderer take a thread for each core that the process may use.
    os.sched_setaffinity(0, connection.recv())
    with quick_imports():
        from workbench.authoring.problem import TaskError, nobody_presses_ctrl_c
        from workbench.session.record import run_episodes, with_given_actions

    nobody_presses_ctrl_c()
    what: RecordOptions = connection.recv()
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
    except (EOFError, BrokenPipeError, ConnectionResetError):
        raise  # not a file that cannot be written: nobody is there to be told
    except (OSError, ValueError, RuntimeError) as error:
        connection.send(("failed", str(error)))


if __name__ == "__main__":
    main()

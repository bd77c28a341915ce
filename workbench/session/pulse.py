"""What the worker is doing now, readable while it hangs: a page of memory that both processes see.

A worker that loops for ever sends nothing, and one that is paused sends nothing either. To tell them apart
without asking (the one that hangs would not answer), the worker notes in shared memory when it begins and
ends a piece of work: two small writes a control step, no message. The clock is CLOCK_MONOTONIC, which is the
same in every process of the machine.
"""

from __future__ import annotations

import mmap
import os
import struct
import time
from dataclasses import dataclass
from typing import Literal, get_args

Doing = Literal[
    "starting",
    "idle",
    "warming up",
    "loading",
    "stepping",
    "resetting",
    "drawing",
    "importing the policy",
    "waiting for a debugger",
]
_DOINGS: tuple[Doing, ...] = get_args(Doing)
_LAYOUT = struct.Struct("=QdB")
"""Number of the piece of work, its beginning in seconds, index into `_DOINGS`."""
_PID, _PID_AT = struct.Struct("=I"), 64
"""Of the worker; 0 until it has begun."""
_HELD_AT = 128
"""A byte: 1 while a debugger holds it."""


@dataclass(frozen=True)
class Beat:
    """What a worker was doing when it was looked at."""

    number: int
    """Counts pieces of work: the same number a while later is the same piece. 0 until the first."""
    doing: Doing
    since: float
    """``time.monotonic()`` of its beginning."""
    held: bool = False
    """A debugger makes it stand still, or is waited for."""

    @property
    def seconds(self) -> float:
        """How long it has been at it; 0 for a worker that waits to be asked."""
        return 0.0 if self.doing == "idle" or self.number == 0 else max(0.0, time.monotonic() - self.since)


def make_pulse() -> int:
    """The memory, as a file descriptor that can be passed on; the caller closes it."""
    fd = os.memfd_create("workbench-pulse")
    os.ftruncate(fd, mmap.PAGESIZE)
    return fd


class PulseWriter:
    """The worker's side."""

    def __init__(self, fd: int) -> None:
        self._memory = mmap.mmap(fd, mmap.PAGESIZE)
        _PID.pack_into(self._memory, _PID_AT, os.getpid())
        self._number = 0

    def begin(self, doing: Doing) -> None:
        self._number += 1
        _LAYOUT.pack_into(self._memory, 0, self._number, time.monotonic(), _DOINGS.index(doing))

    def hold(self, held: bool) -> None:
        """A debugger makes the worker stand still, or lets it go on."""
        self._memory[_HELD_AT] = held


class PulseReader:
    """The server's side."""

    def __init__(self, fd: int) -> None:
        self._memory = mmap.mmap(fd, mmap.PAGESIZE, prot=mmap.PROT_READ)

    @property
    def pid(self) -> int:
        """Process id of the worker; 0 until it has begun."""
        return _PID.unpack_from(self._memory, _PID_AT)[0]

    def read(self) -> Beat:
        # Written by another process without a lock: a torn reading is one that changes when read again.
        for _ in range(100):
            first = self._memory[: _LAYOUT.size]
            if first == self._memory[: _LAYOUT.size]:
                break
        number, since, doing = _LAYOUT.unpack(first)
        return Beat(number, _DOINGS[min(doing, len(_DOINGS) - 1)], since, self._memory[_HELD_AT] == 1)

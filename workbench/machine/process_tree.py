"""The processes that a process started, read from ``/proc`` in tens of microseconds."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

_PAGE = os.sysconf("SC_PAGE_SIZE")


def children(pid: int) -> list[int]:
    """Process ids of its children, zombies too; empty when it is gone."""
    found: list[int] = []
    try:
        for thread in os.listdir(f"/proc/{pid}/task"):
            found += map(int, _read(f"/proc/{pid}/task/{thread}/children").split())
    except FileNotFoundError:
        # A kernel without that file, or a thread or the process that has ended meanwhile.
        return _children_by_parent(pid)
    except OSError:
        return found
    return found


def family(pid: int) -> list[int]:
    """A process and all that descend from it."""
    members = {pid: None}
    waiting = [pid]
    while waiting:
        new = [child for child in children(waiting.pop()) if child not in members]
        members |= dict.fromkeys(new)
        waiting += new
    return list(members)


def resident_memory(pid: int) -> int:
    """Bytes of the process that are in memory, shared ones too; 0 when it is gone."""
    try:
        return int(_read(f"/proc/{pid}/statm").split()[1]) * _PAGE
    except (OSError, IndexError):
        return 0


def allocated_memory(pid: int) -> int:
    """Bytes in memory that the process itself has filled; 0 when it is gone. Of `resident_memory` what is no file: of
    mapped libraries the kernel may drop hundreds of megabytes while something else is allocated."""
    try:
        _, resident, shared, *_ = _read(f"/proc/{pid}/statm").split()
        return (int(resident) - int(shared)) * _PAGE
    except (OSError, ValueError):
        return 0


def proportional_memory(pids: Iterable[int]) -> int:
    """Bytes that processes have in memory together, a page that several of them share counted once.

    Of what is shared with others a part is counted (PSS). Takes milliseconds for each process that has a gigabyte.
    """
    return sum(map(_proportional, pids))


def main_thread_ended(pid: int) -> bool:
    """Whether its main thread has ended and others have not, as also for a moment in the midst of any end."""
    try:
        return _state_and_parent(pid)[0] == "Z" and len(os.listdir(f"/proc/{pid}/task")) > 1
    except OSError:
        return False


def _proportional(pid: int) -> int:
    try:
        for line in _read(f"/proc/{pid}/smaps_rollup").splitlines():
            if line.startswith(b"Pss:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError):
        # Of another user, or on its way out.
        return resident_memory(pid)
    return 0


def _children_by_parent(pid: int) -> list[int]:
    if not Path(f"/proc/{pid}").exists():
        return []
    return [int(name) for name in os.listdir("/proc") if name.isdigit() and _state_and_parent(name)[1] == pid]


def _state_and_parent(pid: int | str) -> tuple[str, int]:
    try:
        # The name, in brackets, may hold anything.
        state, parent = _read(f"/proc/{pid}/stat").rpartition(b")")[2].split()[:2]
    except (OSError, ValueError):
        return "", 0
    return state.decode(), int(parent)


def _read(path: str) -> bytes:
    with open(path, "rb", buffering=0) as file:
        return file.read()

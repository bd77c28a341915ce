"""How much memory a worker may have, and how much it has.

A limit on address space (``RLIMIT_AS``) is of no use here: torch and the renderer reserve far more than they use,
and fail in ways that name nothing. What counts is the memory that the worker and all that it started have together,
so the server looks at it ten times a second and ends a worker that has more than it may, with a message, before the kernel must choose a
victim. Should the kernel be quicker all the same, the worker has told it to be chosen first (``oom_score_adj``).
"""

from __future__ import annotations

import math
import re
import time
from pathlib import Path

import psutil

from workbench.machine.processes.family import family, proportional_memory, resident_memory

_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}
_SIZE = re.compile(r"(?P<number>\d+(\.\d+)?)\s*(?P<unit>[kmgt]?)i?b?", re.IGNORECASE)
_SHARE = 0.8
"""Of the memory that this machine, or the container, has."""
_LEAST = 2**30
"""Bytes; a worker that has only imported uses about half of this."""
_CONTAINER_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
_COUNT_EVERY = 2.0


def parse_memory(text: str) -> int | None:
    """Bytes of ``8GB``, ``800 MiB`` (both count by 1024), ``auto``; None for ``none``.

    Raises:
        ValueError: it is none of these, or too little for any worker.
    """
    word = text.strip().lower()
    if word == "none":
        return None
    if word == "auto":
        return max(_LEAST, int(_SHARE * total_memory()))
    size = size_in_bytes(word)
    if size is None or math.isinf(size):
        raise ValueError(f"--memory-limit takes a size such as 8GB, auto, or none; got {text!r}")
    if size < _LEAST:
        raise ValueError(
            f"--memory-limit must be at least 1GB: a worker that has built nothing uses half of it, not {text}"
        )
    return int(size)


def size_in_bytes(text: str) -> float | None:
    """Of ``8GB``, ``1.5 GiB``, ``800m`` (all count by 1024) or a plain number; None for what is no size."""
    found = _SIZE.fullmatch(text.strip())
    return None if found is None else float(found["number"]) * _UNITS[found["unit"].lower()]


def total_memory() -> int:
    """Bytes that there are for all: of the machine, or of the container if that has less."""
    total = psutil.virtual_memory().total
    for path in _CONTAINER_LIMITS:
        try:
            total = min(total, int(Path(path).read_text()))
        except (OSError, ValueError):
            continue  # no such container, or "max"
    return total


class FamilyMemory:
    """What a process's descendants have in memory together, looked at ten times a second.

    What a forked child shares with its parent counts once: the sum of resident memory (RSS) counts a worker of 1 GB with
    seven children as 8 GB, and would end it for nothing. The kernel divides shared pages among those who have them
    (PSS), but takes milliseconds to count them, so that is asked every two seconds, and at once where the memory seems
    too much. In between, what is new counts as not shared.
    """

    def __init__(self, pid: int) -> None:
        """
        Args:
            pid: is not counted itself.
        """
        self._pid = pid
        self._shared = 0
        self._counted = 0.0

    def look(self, limit: int | None = None) -> int:
        """Bytes, never more than there are where that is above `limit`."""
        members = family(self._pid)[1:]
        resident = sum(map(resident_memory, members))
        if len(members) < 2:
            self._shared = 0
            return resident
        now = time.monotonic()
        if now - self._counted > _COUNT_EVERY or (limit is not None and resident - self._shared > limit):
            self._shared = max(0, resident - proportional_memory(members))
            self._counted = now
        return resident - self._shared


def in_words(size: int) -> str:
    """``8.0 GB``, ``310 MB``; by 1024."""
    return f"{size / 2**30:.1f} GB" if size >= 2**30 else f"{size / 2**20:.0f} MB"

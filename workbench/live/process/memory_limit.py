"""Measures a worker's memory, and reads ``--memory-limit``."""

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
"""Share of the memory of the machine or the container that ``auto`` allows."""
_MIN_BYTES = 2**30
"""Lowest allowed limit; a worker that has done only its imports uses about half of it."""
_CONTAINER_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
_PSS_PERIOD_SECONDS = 2.0


def parse_memory(text: str) -> int | None:
    """Bytes of ``8GB``, ``800 MiB`` (units are powers of 1024) or ``auto``; None for ``none``.

    Raises:
        ValueError: the text has another form, or the limit is too small for any worker.
    """
    word = text.strip().lower()
    if word == "none":
        return None
    if word == "auto":
        return max(_MIN_BYTES, int(_SHARE * total_memory()))
    size = size_in_bytes(word)
    if size is None or math.isinf(size):
        raise ValueError(f"--memory-limit takes a size such as 8GB, auto, or none; got {text!r}")
    if size < _MIN_BYTES:
        raise ValueError(
            f"--memory-limit must be at least 1GB, not {text}: a worker that has built nothing uses half a GB"
        )
    return int(size)


def size_in_bytes(text: str) -> float | None:
    """Bytes of ``8GB``, ``1.5 GiB``, ``800m`` (in powers of 1024) or a plain number; None for other text."""
    found = _SIZE.fullmatch(text.strip())
    return None if found is None else float(found["number"]) * _UNITS[found["unit"].lower()]


def total_memory() -> int:
    """Bytes of memory of the machine, or of the container if that has less."""
    total = psutil.virtual_memory().total
    for path in _CONTAINER_LIMITS:
        try:
            total = min(total, int(Path(path).read_text()))
        except (OSError, ValueError):
            continue  # not in such a container, or its limit is "max"
    return total


class FamilyMemory:
    """Memory of all descendants of a process, measured ten times a second.

    The server ends a worker above its limit before the OOM killer acts. ``RLIMIT_AS`` does not work: torch and the renderer
    reserve far more address space than they use, and would fail without naming this limit as the cause.

    Pages that a forked child shares with its parent count once: summed resident memory (RSS) would count a worker of
    1 GB with seven children as 8 GB. Reading the proportional set size (PSS) takes milliseconds, so it is read every two
    seconds, and at once if the memory seems above the limit. Between two readings, new memory counts as not
    shared.
    """

    def __init__(self) -> None:
        self._shared = 0
        self._counted = 0.0

    def measure(self, pid: int, limit: int | None = None) -> int:
        """Memory in bytes; exact if the quick estimate is above `limit`.

        Args:
            pid: the process, which is not counted itself.
        """
        members = family(pid)[1:]
        resident = sum(map(resident_memory, members))
        if len(members) < 2:
            self._shared = 0
            return resident
        now = time.monotonic()
        if now - self._counted > _PSS_PERIOD_SECONDS or (
            limit is not None and resident - self._shared > limit
        ):
            self._shared = max(0, resident - proportional_memory(members))
            self._counted = now
        return resident - self._shared


def format_size(size: int) -> str:
    """``8.0 GB``, ``310 MB``; units are powers of 1024."""
    return f"{size / 2**30:.1f} GB" if size >= 2**30 else f"{size / 2**20:.0f} MB"

"""Makes system calls fail: the n-th call that changes the disk, alone or with all later ones."""

from __future__ import annotations

import errno
import io
import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

CHANGING = (
    "open",
    "write",
    "pwrite",
    "fsync",
    "ftruncate",
    "link",
    "rename",
    "replace",
    "unlink",
    "mkdir",
    "rmdir",
)
_BACKGROUND_THREADS = ("episode-journals",)
"""Names of threads that make calls at unpredictable times."""


@contextmanager
def refused(
    at: int = 0, names: tuple[str, ...] = CHANGING, number: int = errno.EIO, then: int = 0
) -> Iterator[list[str]]:
    """Make call number `at` (from 1; 0 for none) of these functions of `os` fail with the error `number`.

    Yields the list of calls in their order, each as "rename a.json".

    Args:
        then: the error of all later calls; 0 for none.
    """
    calls: list[str] = []
    opened = io.open

    def of(name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def called(*args: Any, **kwargs: Any) -> Any:
            if threading.current_thread().name in _BACKGROUND_THREADS or (
                real is opened and not _creates(*args, **kwargs)
            ):
                return real(*args, **kwargs)
            calls.append(f"{name} {os.path.basename(_path(args[0]))}")
            error = number if len(calls) == at else then if at and len(calls) > at else 0
            if error:
                raise OSError(error, os.strerror(error), _path(args[0]))
            return real(*args, **kwargs)

        return called

    with ExitStack() as patches:
        for name in names:
            patches.enter_context(mock.patch.object(os, name, of(name, getattr(os, name))))
        if "open" in names:
            patches.enter_context(mock.patch.object(io, "open", of("open", opened)))
        yield calls


def _creates(file: object, mode: str = "r", *_: object, **__: object) -> bool:
    """Whether `io.open` creates a file. It also wraps descriptors of `os.open`, which is counted as a call itself."""
    return not isinstance(file, int) and "r" not in mode


def _path(held: object) -> str:
    try:
        return os.readlink(f"/proc/self/fd/{held}") if isinstance(held, int) else os.fspath(held)  # type: ignore[arg-type]
    except OSError:
        return str(held)


def descriptors() -> list[str]:
    """Paths of the files on disk that this process has open."""
    held = (_path(int(number)) for number in os.listdir("/proc/self/fd"))
    return sorted(path for path in held if path.startswith("/") and not path.startswith(("/dev", "/proc")))


def left_open(before: list[str]) -> list[str]:
    """Files that are open now and were not before. Files closed meanwhile belong to a thread of an earlier test."""
    return sorted((Counter(descriptors()) - Counter(before)).elements())

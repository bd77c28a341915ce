"""Kills this process, with a message, if native code does not return. Run as a script, this is the watching process."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

PICTURE_SECONDS = 180.0
"""Timeout of one picture. The first picture of a process takes seconds, since shaders are compiled."""
_MAX_MESSAGE_BYTES = 2000
"""Maximum size of a message: a write of this size to a pipe is atomic."""


@dataclass
class _Watcher:
    """The process that watches this one."""

    pid: int
    """Id of the watched process. A fork of that process is not watched."""
    seconds: float
    process: subprocess.Popen[bytes] | None = None
    pipe: int = -1
    within: bool = False


_watcher: _Watcher | None = None


def end_after(seconds: float = PICTURE_SECONDS) -> None:
    """Kill this process when work within `limited` takes longer than `seconds`. Without this call, `limited` does
    nothing."""
    global _watcher
    end_limit()
    _watcher = _Watcher(os.getpid(), seconds)


def end_limit() -> None:
    """Cancel `end_after`."""
    global _watcher
    watcher, _watcher = _watcher, None
    if watcher is not None and watcher.process is not None and watcher.pid == os.getpid():
        os.close(watcher.pipe)
        watcher.process.wait()


@contextmanager
def limited(message: str) -> Iterator[None]:
    """Context for native work that may not return, such as waiting for a driver.

    Python's own threads and signal handlers do not run meanwhile, so another process watches: at the timeout
    it prints `message` to stderr and kills this process. The other process starts at the first use and takes
    6 MB; each use takes 20 us.
    """
    watcher = _watcher
    if watcher is None or watcher.within or watcher.pid != os.getpid():
        yield
        return
    if watcher.process is None:
        _start(watcher)
    _send_line(watcher, " ".join(message.split()).encode()[:_MAX_MESSAGE_BYTES])
    watcher.within = True
    try:
        yield
    finally:
        watcher.within = False
        _send_line(watcher, b"")


def _send_line(watcher: _Watcher, line: bytes) -> None:
    with suppress(BrokenPipeError):  # the watcher was killed: nothing is limited from now on
        os.write(watcher.pipe, line + b"\n")


def _start(watcher: _Watcher) -> None:
    # Imported here, since this file also runs as a script with only the standard library.
    from workbench.machine.processes.child_environment import script_command

    read, watcher.pipe = os.pipe()
    try:
        watcher.process = subprocess.Popen(
            script_command(__file__, str(read), str(watcher.pid), str(watcher.seconds)),
            pass_fds=[read],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            process_group=0,  # Ctrl-C in the terminal must reach only the watched process
        )
    finally:
        os.close(read)


def _watch(fd: int, pid: int, seconds: float) -> None:
    """Read a line at the start of each piece of work (its message) and an empty line at its end, until the
    process `pid` is gone. If a piece of work takes longer than `seconds`, print its message and kill the
    process."""
    message, deadline, left = b"", None, b""
    while True:
        wait = None if deadline is None else max(0.0, deadline - time.monotonic())
        if select.select([fd], [], [], wait)[0]:
            if not (read := os.read(fd, 65536)):
                return
            *lines, left = (left + read).split(b"\n")
            if lines:
                message = lines[-1]
                deadline = time.monotonic() + seconds if message else None
        elif deadline is not None:
            if os.getppid() == pid:
                print(message.decode(errors="replace"), file=sys.stderr, flush=True)
                os.kill(pid, signal.SIGKILL)
            return


if __name__ == "__main__":
    _watch(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))

"""The worker as a child process: start it, talk to it, hear what it prints, know when it dies.

A plain subprocess with one end of a socket pair: no standard input (a task that reads it gets end of
file, not a hang), its own process group (Ctrl-C in the terminal is for the server, which then ends the
worker in good order), and its output read line by line so that an author's prints reach the page.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection

from workbench.session.messages import Event, Quit, Request

_LONGEST_LINE = 2000


class WorkerProcess:
    """One worker. Events are taken by `receive`; requests go out by `send` from any thread."""

    def __init__(self, on_line: Callable[[str, str], None], env: Mapping[str, str] | None = None) -> None:
        """
        Args:
            on_line: called with ``stdout`` or ``stderr`` and a line, on threads of this object.
            env: environment variables to set on top of this process's own.
        """
        ours, theirs = socket.socketpair()
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "workbench.session.worker", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
                env={**os.environ, "PYTHONUNBUFFERED": "1", **(env or {})},
            )
        finally:
            theirs.close()
        self._connection = Connection(ours.detach())
        self._send_lock = threading.Lock()
        self._on_line = on_line
        self._readers = [
            threading.Thread(target=self._read_lines, args=(name, stream), name=f"worker-{name}", daemon=True)
            for name, stream in (("stdout", self._process.stdout), ("stderr", self._process.stderr))
        ]
        for reader in self._readers:
            reader.start()

    @property
    def pid(self) -> int:
        return self._process.pid

    def send(self, request: Request) -> bool:
        """False when the worker is gone; `receive` then says so too."""
        try:
            with self._send_lock:
                self._connection.send(request)
        except (BrokenPipeError, OSError):
            return False
        return True

    def receive(self, timeout: float | None = None) -> Event | None:
        """The next event; None after `timeout` seconds without one.

        Raises:
            EOFError: the worker hung up (see `exit_code`).
        """
        try:
            if not self._connection.poll(timeout):
                return None
            return self._connection.recv()
        except (ConnectionResetError, OSError) as error:
            raise EOFError from error

    def exit_code(self) -> int | None:
        """As ``subprocess`` gives it: negative is the signal that ended it. Waits a little for it."""
        try:
            return self._process.wait(timeout=2.0)
        except subprocess.TimeoutExpired:
            return None

    def kill(self) -> None:
        """End it now with all that it started; `receive` then raises EOFError."""
        self._kill_group()

    def stop(self, grace: float = 1.0) -> None:
        """Ask it to end, and after `grace` seconds end it with all that it started."""
        self.send(Quit())
        try:
            self._process.wait(timeout=grace)
        except subprocess.TimeoutExpired:
            pass
        self._kill_group()
        self._process.wait()
        for reader in self._readers:
            reader.join(timeout=1.0)
        self._connection.close()

    def _kill_group(self) -> None:
        try:
            os.killpg(self._process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass  # it and all its children are gone already

    def _read_lines(self, name: str, stream: object) -> None:
        # readline with a limit: an author who prints a gigabyte without a newline must not fill us up.
        with stream as lines:  # type: ignore[attr-defined]
            while chunk := lines.readline(_LONGEST_LINE):
                self._on_line(name, chunk.decode(errors="replace").rstrip("\n"))


def describe_exit(code: int | None) -> str:
    """In words: ``was killed by SIGSEGV``, ``ended with exit code 3``."""
    if code is None:
        return "stopped answering"
    if code < 0:
        return f"was killed by {signal.Signals(-code).name}"
    return f"ended with exit code {code}"

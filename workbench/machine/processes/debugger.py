"""Lets a debugger attach to a worker, and sets what ``breakpoint()`` and ``pdb.set_trace()`` do without a
terminal."""

from __future__ import annotations

import importlib.util
import os
import pdb
import socket
import sys
import threading
from collections.abc import Callable
from typing import Any, NoReturn

DEFAULT_PORT = 5678
"""Port that editors use by default."""
HOST = "127.0.0.1"
"""Loopback address only, since a client that attaches can run any code."""


class CannotDebug(ValueError):
    """debugpy cannot listen; the message has the reason."""


def listen_for_debugger(port: int, hold: Callable[[bool], None]) -> None:
    """Listen for a debugger, and let ``breakpoint()`` stop in it. Call once, on the main thread.

    Args:
        hold: called on the main thread with True when a debugger suspends it, and with False when it continues.

    Raises:
        CannotDebug: the port is taken, or debugpy is missing or of an unknown version.
    """
    # Without this debugpy prints four lines of warning about Python's frozen modules at each start.
    os.environ.setdefault("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    try:
        import debugpy.server
        import pydevd  # pyright: ignore[reportMissingImports]  debugpy.server puts it on sys.path
    except ImportError as error:
        raise CannotDebug(f"debugpy cannot be imported: {error}") from error
    _report_suspension(pydevd.PyDB, hold)
    # Without this, each process that a task starts would wait for its own debugger.
    debugpy.configure(subProcess=False)
    try:
        debugpy.listen((HOST, port))
    except RuntimeError as error:
        raise CannotDebug(str(error)) from error
    _stop_at_breakpoints(debugpy.is_client_connected, pydevd.settrace, port)


def wait_for_debugger(hold: Callable[[bool], None]) -> None:
    """Wait until a debugger has attached and set its breakpoints."""
    import debugpy

    hold(True)
    try:
        debugpy.wait_for_client()
    finally:
        hold(False)


def may_be_debugged() -> bool:
    """Whether a debugger has attached to this process, or can."""
    return "debugpy" in sys.modules


def debug_here(on_message: Callable[[str], None]) -> None:
    """Wait for a debugger in a process without a supervisor.

    Raises:
        ValueError: debugpy cannot listen.
    """
    port = port_for_debugger(None)
    listen_for_debugger(port, lambda held: None)
    on_message(f"waiting for a debugger at {HOST}:{port}")
    wait_for_debugger(lambda held: None)


def _report_suspension(debugger: Any, hold: Callable[[bool], None]) -> None:
    """Wrap the one method in which debugpy suspends threads, to call `hold`; debugpy has no event for
    suspensions.

    Without this, the supervisor would treat a worker at a breakpoint as hanging.
    """
    wait_suspended = getattr(debugger, "do_wait_suspend", None)
    if wait_suspended is None:
        from importlib.metadata import version

        raise CannotDebug(
            f"debugpy {version('debugpy')} is not known to the workbench; install debugpy==1.8.22"
        )

    def reported(self: Any, thread: threading.Thread, *arguments: Any, **keywords: Any) -> Any:
        if thread is not threading.main_thread():
            return wait_suspended(self, thread, *arguments, **keywords)
        hold(True)
        try:
            return wait_suspended(self, thread, *arguments, **keywords)
        finally:
            hold(False)

    debugger.do_wait_suspend = reported


def _stop_at_breakpoints(attached: Callable[[], bool], settrace: Callable[..., None], port: int) -> None:
    passed: set[tuple[str, int]] = set()

    def stop(*arguments: Any, **keywords: Any) -> None:
        caller = sys._getframe(1)
        if attached():
            settrace(suspend=True, trace_only_current_thread=True, stop_at_frame=caller)
            return
        place = caller.f_code.co_filename, caller.f_lineno
        if place not in passed:
            passed.add(place)
            message = f"{place[0]}:{place[1]}: a breakpoint was skipped, since no debugger is attached to {HOST}:{port}"
            print(message, file=sys.stderr)

    if os.environ.get("PYTHONBREAKPOINT") != "0":
        sys.breakpointhook = stop
    pdb.set_trace = stop


def port_for_debugger(wanted: int | None) -> int:
    """A free port of this machine: `wanted`; if `wanted` is None, `DEFAULT_PORT`, or any other port if
    `DEFAULT_PORT` is taken.

    Raises:
        ValueError: debugpy is not installed, or `wanted` is taken or not a port.
    """
    if importlib.util.find_spec("debugpy") is None:
        raise ValueError("--debug needs debugpy, which is not installed: pip install debugpy")
    if wanted is not None and not 0 <= wanted < 2**16:
        raise ValueError(f"--debug-port must be from 0 to {2**16 - 1}, not {wanted}")
    for port in (DEFAULT_PORT, 0) if wanted is None else (wanted,):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError as error:
                reason = error
                continue
            return probe.getsockname()[1]
    raise ValueError(f"cannot listen on --debug-port {wanted}: {reason.strerror}")


def listening_text(port: int, waits: bool) -> str:
    """Log line with the address at which a debugger can attach."""
    at = f"{HOST}:{port}"
    if waits:
        return f"the worker waits for a debugger at {at}; the task is loaded when one has attached"
    return f"the worker listens for a debugger at {at}"


# --- processes without a debugger -------------------------------------------------------------------


OPEN_WITH_DEBUG = "remove this line, or open with --debug and attach a debugger"
ONE_PROCESS = "remove this line, or use --workers 1 without --cluster in a terminal, where Python's own debugger answers"


class NoDebugger(RuntimeError):
    """The author's code calls a debugger in a process without a terminal."""


def refuse_breakpoints(advice: str) -> None:
    """Make ``breakpoint()`` and ``pdb.set_trace()`` raise `NoDebugger` at their own line, in this process.

    Python's debugger would read the end of its input and raise a bare ``BdbQuit`` at the next line.
    ``PYTHONBREAKPOINT`` stays in effect if it is 0 or names another function than ``pdb.set_trace``.

    Args:
        advice: what to do instead, appended after a colon.
    """

    def refuse_breakpoint(*arguments: Any, **keywords: Any) -> NoReturn:
        raise NoDebugger(f"this line stops for a debugger, and there is no terminal to ask in: {advice}")

    if os.environ.get("PYTHONBREAKPOINT", "") in ("", "pdb.set_trace"):
        sys.breakpointhook = refuse_breakpoint
    pdb.set_trace = refuse_breakpoint


def pass_breakpoints() -> None:
    """Make ``breakpoint()`` and ``pdb.set_trace()`` do nothing in this process, which runs in the background."""

    def pass_breakpoint(*arguments: Any, **keywords: Any) -> None:
        pass

    sys.breakpointhook = pdb.set_trace = pass_breakpoint

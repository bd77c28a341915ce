"""The worker's debugger: debugpy listens on this machine only, and what it holds is noted for the server.

A worker at a breakpoint answers nothing, as one that hangs does. So whoever watches over it must know: debugpy has no word
for "the main thread stands still", and the one method that it stands still in is wrapped here.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import pdb
import socket
import sys
import threading
from collections.abc import Callable
from typing import Any

USUAL_PORT = 5678
"""Which editors propose to attach to."""
HOST = "127.0.0.1"
"""Nothing else: whoever attaches runs what they like."""


class CannotDebug(ValueError):
    """No debugger can be listened for; the text says why."""


def listen_for_debugger(port: int, hold: Callable[[bool], None]) -> None:
    """From now on a debugger can attach, and ``breakpoint()`` stops for one. Called once, on the main thread.

    Args:
        hold: called on the main thread with True when a debugger makes it stand still, with False when it goes on.

    Raises:
        CannotDebug: the port is taken, or debugpy is not there or another than is known.
    """
    # Python's own modules are not what is debugged; without this it warns of them in four lines on each start.
    os.environ.setdefault("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    try:
        import debugpy.server
        import pydevd  # pyright: ignore[reportMissingImports]  debugpy.server puts it on sys.path
    except ImportError as error:
        raise CannotDebug(f"debugpy cannot be imported: {error}") from error
    _tell_when_held(pydevd.PyDB, hold)
    # The processes that a task starts are not the worker, and would each wait for a debugger of their own.
    debugpy.configure(subProcess=False)
    try:
        debugpy.listen((HOST, port))
    except RuntimeError as error:
        raise CannotDebug(str(error)) from error
    _stop_at_breakpoints(debugpy.is_client_connected, pydevd.settrace, port)


def wait_for_debugger(hold: Callable[[bool], None]) -> None:
    """Return when one has attached and set its breakpoints."""
    import debugpy

    hold(True)
    try:
        debugpy.wait_for_client()
    finally:
        hold(False)


def debug_here(say: Callable[[str], None]) -> None:
    """Wait for a debugger in a process that nobody watches over.

    Raises:
        ValueError: no debugger can be listened for.
    """
    port = port_for_debugger(None)
    listen_for_debugger(port, lambda held: None)
    say(f"waiting for a debugger at {HOST}:{port}")
    wait_for_debugger(lambda held: None)


def _tell_when_held(debugger: Any, hold: Callable[[bool], None]) -> None:
    stand_still = getattr(debugger, "do_wait_suspend", None)
    if stand_still is None:
        version = importlib.metadata.version("debugpy")
        raise CannotDebug(f"debugpy {version} is not known to the workbench; install debugpy==1.8.22")

    def told(self: Any, thread: threading.Thread, *arguments: Any, **keywords: Any) -> Any:
        if thread is not threading.main_thread():
            return stand_still(self, thread, *arguments, **keywords)
        hold(True)
        try:
            return stand_still(self, thread, *arguments, **keywords)
        finally:
            hold(False)

    debugger.do_wait_suspend = told


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
            said = f"{place[0]}:{place[1]}: a breakpoint was passed, since no debugger is attached to {HOST}:{port}"
            print(said, file=sys.stderr)

    if os.environ.get("PYTHONBREAKPOINT") != "0":
        sys.breakpointhook = stop
    pdb.set_trace = stop


def port_for_debugger(wanted: int | None) -> int:
    """A port of this machine that is free now: the one that is wanted, or the usual one, or another.

    Raises:
        ValueError: debugpy is not installed, or the wanted port is taken or none.
    """
    if importlib.util.find_spec("debugpy") is None:
        raise ValueError("--debug needs debugpy, which is not installed: pip install debugpy")
    if wanted is not None and not 0 <= wanted < 2**16:
        raise ValueError(f"--debug-port must be from 0 to {2**16 - 1}, not {wanted}")
    for port in (USUAL_PORT, 0) if wanted is None else (wanted,):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError as error:
                reason = error
                continue
            return probe.getsockname()[1]
    raise ValueError(f"--debug-port {wanted} cannot be listened on: {reason.strerror}")


def listening_for_a_debugger(port: int, waits: bool) -> str:
    """In the log."""
    at = f"{HOST}:{port}"
    if waits:
        return f"the worker waits for a debugger at {at}; the task is loaded when one has attached"
    return f"the worker listens for a debugger at {at}"

"""What is said of a worker's debugger, and which port it gets: the server's side of `debugger`."""

from __future__ import annotations

import importlib.util
import socket

from workbench.session.messages import DebuggerListens

USUAL_PORT = 5678
"""Which editors propose to attach to."""
HOST = "127.0.0.1"
"""Nothing else: whoever attaches runs what they like."""


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


def listening_for_a_debugger(event: DebuggerListens) -> str:
    """The line of the log."""
    if event.why_not:
        return f"no debugger can attach: {event.why_not}"
    at = f"{HOST}:{event.port}"
    if event.waits:
        return f"the worker waits for a debugger at {at}; the task is loaded when one has attached"
    return f"the worker listens for a debugger at {at}"

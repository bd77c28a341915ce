"""A debugger client like an editor's: the Debug Adapter Protocol over a socket."""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path
from typing import Any

TIMEOUT_SECONDS = 30.0


class DebugClient:
    """Attaches to a worker that listens on localhost."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=TIMEOUT_SECONDS)
        self._file = self._socket.makefile("rb")
        self._number = 0
        self._events: list[dict[str, Any]] = []
        self.ask("initialize", adapterID="test", linesStartAt1=True, pathFormat="path")
        attach = self._send("attach", justMyCode=False)
        self.event("initialized")
        self._attach = attach

    def begin(self) -> None:
        """Report that all breakpoints are set, so that the worker continues."""
        self.ask("configurationDone")
        self._response(self._attach)

    def stop_at(self, file: Path, *lines: int) -> list[bool]:
        """Set the breakpoints of a file; return whether each was accepted."""
        set_ = self.ask(
            "setBreakpoints", source={"path": str(file)}, breakpoints=[{"line": line} for line in lines]
        )
        return [each["verified"] for each in set_["breakpoints"]]

    def stopped_at(self) -> tuple[int, str, int]:
        """Wait until the worker stops; return the thread, and file and line of its innermost frame."""
        thread = self.event("stopped")["threadId"]
        frame = self.ask("stackTrace", threadId=thread, levels=1)["stackFrames"][0]
        return thread, frame["source"]["path"], frame["line"]

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Send a request and wait for its response."""
        return self._response(self._send(command, **arguments))

    def event(self, name: str) -> dict[str, Any]:
        """The next event of this kind that was not returned yet."""
        while True:
            for event in self._events:
                if event["event"] == name:
                    self._events.remove(event)
                    return event.get("body", {})
            self._read()

    def close(self) -> None:
        self._file.close()
        self._socket.close()

    def _send(self, command: str, **arguments: Any) -> int:
        self._number += 1
        message = {"seq": self._number, "type": "request", "command": command, "arguments": arguments}
        body = json.dumps(message).encode()
        self._socket.sendall(b"Content-Length: %d\r\n\r\n%s" % (len(body), body))
        return self._number

    def _response(self, number: int) -> dict[str, Any]:
        deadline = time.monotonic() + TIMEOUT_SECONDS
        while time.monotonic() < deadline:
            message = self._read()
            if message["type"] == "response" and message["request_seq"] == number:
                assert message["success"], message
                return message.get("body", {})
        raise TimeoutError

    def _read(self) -> dict[str, Any]:
        length = 0
        while line := self._file.readline().strip():
            name, _, value = line.partition(b":")
            if name == b"Content-Length":
                length = int(value)
        if not length:
            raise EOFError("the debugger's other end is gone")
        message = json.loads(self._file.read(length))
        if message["type"] == "event":
            self._events.append(message)
        return message

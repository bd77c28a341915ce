"""Stands between a process and its terminal: text and colours go through, all else is shown escaped."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable
from typing import Any

from workbench.machine.terminal_text import only_colours, plain_text


class SafeStream:
    """A text stream that lets nothing through but text and its colours."""

    def __init__(self, raw: Any) -> None:
        self.raw = raw

    def write(self, text: str) -> int:
        self.raw.write(only_colours(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)


def guard_terminal() -> None:
    """From now on nothing that this process prints does more to a terminal than show text in colours.

    For good, since the traceback of what ends the process is printed last of all. What a program of its own writes to
    the terminal, and native code, does not come by here.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and not isinstance(stream, SafeStream):
            setattr(sys, name, SafeStream(stream))
    # Where nobody sets up logging, as here, all records go through this one.
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_OneLine())


class _OneLine(logging.Formatter):
    """A record of a logger is one line, whatever names are in it, and its traceback behind it."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return plain_text(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:
        return plain_text(super().formatException(ei), "\n\t")

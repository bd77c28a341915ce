"""What can happen to a session or a review, apart from what a worker says (`protocol.messages.Event`), and what follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from workbench.page.command import Command


@dataclass(frozen=True)
class Asked:
    """A page, a script or an agent asks for a command."""

    command: Command
    page: str = ""
    """Name of the page that asks; empty for none."""


@dataclass(frozen=True)
class Then:
    """Effect: let this event happen next."""

    event: Any


@dataclass(frozen=True)
class Later:
    """Effect: let this event happen after some seconds. `apply` ignores it if it has lost its sense by then."""

    seconds: float
    event: Any

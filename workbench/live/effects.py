"""Events of a session or a review that do not come from a worker, and effects that schedule an event."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from workbench.page.command import Command


@dataclass(frozen=True)
class Asked:
    """Event: a page, a script or an agent sends a command."""

    command: Command
    page: str = ""
    """Name of the page that sends it; empty for none."""


@dataclass(frozen=True)
class Then:
    """Effect: handle this event next."""

    event: Any


@dataclass(frozen=True)
class Later:
    """Effect: handle this event after `seconds`. `apply` ignores the event if it is outdated by then."""

    seconds: float
    event: Any

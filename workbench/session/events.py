"""Events that several states of a session are changed by."""

from __future__ import annotations

from dataclasses import dataclass

from workbench.commands.command import Command


@dataclass(frozen=True)
class Asked:
    """A page asks for something."""

    command: Command
    page: str = ""
    """Name of the page; empty if no page asked."""

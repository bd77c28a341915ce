"""What can happen to a session or a review, apart from what a worker says (`protocol.messages.Event`), and what follows."""

from __future__ import annotations

from dataclasses import dataclass

from workbench.commands.command import Command


@dataclass(frozen=True)
class Asked:
    """A page, a script or an agent asks for a command."""

    command: Command
    page: str = ""
    """Name of the page that asks; empty for none."""


@dataclass(frozen=True)
class Ask:
    """Effect: the session asks itself for a command."""

    command: Command

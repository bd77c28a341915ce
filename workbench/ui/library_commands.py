"""What can be done with the table of recordings from the keyboard, and with those that are selected in it.

What is done with recordings is a button over the table and a command with a key, made from one description, so that
neither is without the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from viser._messages import HotkeyKey, KeyModifier  # the types of add_command's arguments (viser 1.1.1)

from workbench.ui.commands import Command
from workbench.ui.library_list import RANGE, LibraryList


@dataclass(frozen=True)
class Action:
    """Something to be done with the selected recordings."""

    label: str
    hint: str
    run: Callable[[tuple[str, ...]], None]
    most: int | None = None
    """Recordings that it can take at once."""
    named: str = ""
    """Its name among the commands; empty leaves it to the buttons."""
    key: HotkeyKey | None = None
    modifier: KeyModifier | None = None


def walking(listed: LibraryList) -> list[Command]:
    """To go through the table and select in it."""

    def move(by: int, held: int = 0) -> Callable[[], None]:
        return lambda: listed.move(by, held)

    return [
        Command("The next recording of the table", move(1), "arrowdown"),
        Command("The recording before it", move(-1), "arrowup"),
        Command("Select the next recording too", move(1, RANGE), "arrowdown", "shift"),
        Command("Select the one before it too", move(-1, RANGE), "arrowup", "shift"),
        Command("The next page of recordings", lambda: listed.turn(1), "pagedown"),
        Command("The page of recordings before it", lambda: listed.turn(-1), "pageup"),
        Command("Select this recording, or no longer", listed.toggle_cursor, "X"),
        Command("Select all recordings that are listed", listed.select_all, "A", "cmd/ctrl"),
    ]


def acting(actions: Sequence[Action], run: Callable[[Action], None]) -> list[Command]:
    """What is done with the selected ones."""
    return [
        Command(action.named, lambda action=action: run(action), action.key, action.modifier)
        for action in actions
        if action.named
    ]

"""Commands of a page with their keys and their names in the command palette (Ctrl+K)."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from typing import Any

import viser
from viser._messages import HotkeyKey, KeyModifier  # the types of add_command's arguments (viser 1.1.1)

from workbench.ui.widgets.click_targets import in_turn

_NAMES = {
    "space": "Space",
    "arrowleft": "←",
    "arrowright": "→",
    "arrowup": "↑",
    "arrowdown": "↓",
    "pageup": "Page up",
    "pagedown": "Page down",
    "home": "Home",
    "end": "End",
    "enter": "Enter",
    "escape": "Escape",
    "delete": "Delete",
}


@dataclass(frozen=True)
class Command:
    """An entry of the palette; its key works while no text field has the focus.

    A slider that has the focus takes the arrow keys too, so commands on arrows ask `Control.took_the_key` first, or
    one press counts twice.
    """

    label: str
    run: Callable[[], None]
    key: HotkeyKey | None = None
    modifier: KeyModifier | None = None
    registered: Callable[[viser.CommandHandle], None] | None = None
    """Called with its handle, which can disable the command."""

    @property
    def key_name(self) -> str:
        """As the page shows it: ``Space``, ``Shift R``."""
        if self.key is None:
            return ""
        name = _NAMES.get(self.key, self.key)
        held = [word.removeprefix("cmd/").capitalize() for word in (self.modifier or "").split("+") if word]
        return " ".join([*held, name])

    @property
    def combination(self) -> str:
        """As the page's scripts compare it: ``arrowdown``, ``cmd/ctrl+a``."""
        return "+".join(part for part in (self.modifier, (self.key or "").lower()) if part)


def register(server: viser.ViserServer, commands: Sequence[Command]) -> None:
    """Put the commands into the palette of every page."""
    for command in commands:
        handle = server.gui.add_command(
            command.label,
            hotkey=command.key,
            modifier=command.modifier,
        )
        handle.on_trigger(_triggered(command.run))
        if command.registered is not None:
            command.registered(handle)


def _triggered(run: Callable[[], None]) -> Callable[[viser.CommandEvent], Coroutine[Any, Any, None]]:
    async def triggered(event: viser.CommandEvent) -> None:
        await in_turn(event.client, run)

    return triggered

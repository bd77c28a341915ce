"""Commands of a page with their keys and their names in the command palette (Ctrl+K)."""

from __future__ import annotations

import json
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from typing import Any

import viser
from viser._messages import HotkeyKey, KeyModifier  # the types of add_command's arguments (viser 1.1.1)

from workbench.machine.kept_choices import close_hints, kept_choices
from workbench.ui.widgets.click_targets import Presses, in_turn
from workbench.ui.widgets.templates import render

_LAST = 2e6
"""viser's order of elements: after all others of the panel."""
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
    buttons: tuple[str, ...] = ()
    """Labels, or their first words, of the buttons that do the same: their tooltips name the key (``key_help.js``)."""
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
    """Put the commands into the palette of every page, and their keys where ``key_help.js`` finds them. Call it in no
    container."""
    names = {button: command.key_name for command in commands if command.key for button in command.buttons}
    server.gui.add_html(render("all_keys", commands=commands, buttons=json.dumps(names)), order=_LAST)
    for command in commands:
        handle = server.gui.add_command(
            command.label,
            hotkey=command.key,
            modifier=command.modifier,
        )
        handle.on_trigger(_triggered(command.run))
        if command.registered is not None:
            command.registered(handle)


def add_hints(server: viser.ViserServer) -> None:
    """Four hints in the present container, until a person closes them for good."""
    if kept_choices().hints_closed:
        return
    hints = server.gui.add_html("")

    def close() -> None:
        hints.visible = False
        close_hints()

    hints.content = render("hints", close=Presses(server).id_of("close the hints", lambda _: close()))


def _triggered(run: Callable[[], None]) -> Callable[[viser.CommandEvent], Coroutine[Any, Any, None]]:
    async def triggered(event: viser.CommandEvent) -> None:
        await in_turn(event.client, run)

    return triggered

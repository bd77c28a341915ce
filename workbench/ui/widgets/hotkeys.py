"""Commands of a page with their keys and their names in the command palette (Ctrl+K)."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import viser
from viser._messages import HotkeyKey, KeyModifier  # the types of add_command's arguments (viser 1.1.1)

from workbench.machine.kept_choices import close_hints, kept_choices
from workbench.ui.server.viser_private import places
from workbench.ui.widgets.click_targets import Presses, in_turn
from workbench.ui.widgets.templates import render

_LAST = 2e6
"""viser's order of elements: after all others of the panel."""
_NAMES = {
    "space": "Space",
    "arrowleft": "Left arrow",
    "arrowright": "Right arrow",
    "arrowup": "Up arrow",
    "arrowdown": "Down arrow",
    "pageup": "Page Up",
    "pagedown": "Page Down",
    "home": "Home",
    "end": "End",
    "enter": "Enter",
    "escape": "Esc",
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
    about: str = ""
    """Below its label in the palette, which looks for words in it too."""
    tab: str = ""
    """The tab that is opened before it runs, on the page that asked."""
    fold: str = ""
    """Likewise the fold."""

    @property
    def key_name(self) -> str:
        """As the page and the docs show it: ``Space``, ``Shift+R``."""
        if self.key is None:
            return ""
        name = _NAMES.get(self.key, self.key)
        held = [word.removeprefix("cmd/").capitalize() for word in (self.modifier or "").split("+") if word]
        return "+".join([*held, name])

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
        handle = add(server, command)
        if command.registered is not None:
            command.registered(handle)
    for tab, fold in places(server):
        label, about = (fold, f"in {tab}" if tab else "") if fold else (f"{tab} tab", "")
        add(server, Command(label, lambda: None, about=about, tab=tab, fold=fold))


def add(server: viser.ViserServer, command: Command) -> viser.CommandHandle:
    """Put one command into the palette of every page."""
    # viser shows the key's name of the browser behind it, which `key_help.js` takes away.
    about = command.about or command.key_name
    handle = server.gui.add_command(
        command.label, description=about or None, hotkey=command.key, modifier=command.modifier
    )
    shown = _Shown()

    async def triggered(event: viser.CommandEvent) -> None:
        if event.client is not None and (command.tab or command.fold):
            shown.show(event.client, command)
        await in_turn(event.client, command.run)

    handle.on_trigger(triggered)
    return handle


class _Shown:
    """Opens the tab and the fold of a command; keeps, by page, the element that did so last."""

    def __init__(self) -> None:
        self._by_page: dict[int, viser.GuiHtmlHandle] = {}

    def show(self, client: viser.ClientHandle, command: Command) -> None:
        before = self._by_page.pop(client.client_id, None)
        if before is not None:
            before.remove()
        html = render("open_tab", tab=command.tab, fold=command.fold)
        self._by_page[client.client_id] = client.gui.add_html(html)


def add_hints(server: viser.ViserServer) -> None:
    """Four hints in the present container, until a person closes them for good."""
    if kept_choices().hints_closed:
        return
    hints = server.gui.add_html("")

    def close() -> None:
        hints.visible = False
        close_hints()

    hints.content = render("hints", close=Presses(server).id_of("close the hints", lambda _: close()))

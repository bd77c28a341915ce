"""The commands of a page: its keys, their list (?), and its command palette (Ctrl+K)."""

from __future__ import annotations

import json
from collections.abc import Collection

import viser

from workbench.machine.kept_choices import kept_choices
from workbench.page.command import Command, CommandList, key_in_words
from workbench.page.commands import CloseHints, ShowTab
from workbench.page.door.viser_private import places
from workbench.page.widgets.templates import render
from workbench.page.widgets.visitors import Visitors

_LAST = 2e6
"""Order of the elements in viser's panel: after all others."""


def with_key(kind: type[Command], hint: str = "") -> str:
    """A hint that names the key: ``Reset all envs (Shift+R)``."""
    key = key_in_words(kind.key)
    return f"{hint or kind.help()} ({key})" if key else hint or kind.help()


def key_rows(commands: CommandList, kinds: Collection[type[Command]]) -> list[tuple[str, str]]:
    """Key and help of those that have a key, in the order of the list of commands."""
    return [(key_in_words(kind.key), kind.help()) for kind in commands if kind.key and kind in kinds]


def register(
    server: viser.ViserServer, visitors: Visitors, kinds: Collection[type[Command]], contexts: str
) -> None:
    """Put these commands into the palette of every page, and their keys where ``input.js`` finds them. Call it in no
    container.

    Args:
        kinds: what the page does.
        contexts: whose keys always count, separated by spaces.
    """
    keys = [
        (key.key, key.context, key.command, key.repeats)
        for kind, key in visitors.commands.keys().items()
        if kind in kinds
    ]
    server.gui.add_html(
        render(
            "all_keys",
            rows=key_rows(visitors.commands, kinds),
            keys=json.dumps(keys),
            contexts=contexts,
        ),
        order=_LAST,
    )
    for kind in visitors.commands:
        if kind in kinds and kind.is_in_palette():
            add(server, visitors, kind.help(), kind(), key_in_words(kind.key))
    for tab, fold in places(server):
        label, about = (fold, f"in {tab}" if tab else "") if fold else (f"{tab} tab", "")
        add(server, visitors, label, ShowTab(tab=tab, fold=fold), about)


def add(
    server: viser.ViserServer, visitors: Visitors, label: str, command: Command, about: str = ""
) -> viser.CommandHandle:
    """Put one command into the palette of every page.

    Args:
        about: below its label; the palette looks for words in it too.
    """
    handle = server.gui.add_command(label, description=about or None)
    handle.on_trigger(visitors.on(command))
    return handle


def add_hints(server: viser.ViserServer) -> viser.GuiHtmlHandle:
    """Four hints in the present container, until a person closes them for good."""
    return server.gui.add_html("" if kept_choices().hints_closed else render("hints", close=CloseHints()))

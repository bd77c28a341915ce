"""Keys of a page, their list (?), and its command palette (Ctrl+K)."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence

import viser

from workbench.machine.preferences import preferences
from workbench.page.command import KEY_NAMES, SHORT_NAMES, Command, CommandList, key_in_words
from workbench.page.commands import CloseHints, ShowTab
from workbench.page.door.viser_private import places
from workbench.page.widgets.templates import render
from workbench.page.widgets.visitors import Visitors

_LAST = 2e6
"""Order value that puts elements after all others in viser's panel."""


def with_key(kind: type[Command], hint: str = "") -> str:
    """A hint that names the key: ``Reset all envs (Shift+R)``."""
    key = key_in_words(kind.key)
    return f"{hint or kind.help()} ({key})" if key else hint or kind.help()


def key_rows(
    commands: CommandList, kinds: Collection[type[Command]], names: Mapping[str, str] = KEY_NAMES
) -> dict[str, list[tuple[str, str]]]:
    """Key and help of each command that has a key, by the heading of its group."""
    groups = {
        heading: [
            (key_in_words(kind.key, names), kind.help()) for kind in group if kind.key and kind in kinds
        ]
        for heading, group in commands.groups.items()
    }
    return {heading: rows for heading, rows in groups.items() if rows}


def register(
    server: viser.ViserServer,
    visitors: Visitors,
    kinds: Collection[type[Command]],
    contexts: str,
    tabs: Sequence[str] = (),
) -> None:
    """Add these commands to the palette of every page, and their keys to the page for ``input.js``. Call it outside any
    container.

    Args:
        kinds: commands that the page carries out.
        contexts: contexts whose keys always work, separated by spaces.
        tabs: tabs outside the main panel.
    """
    keys = [
        (key.key, key.context, key.command, key.repeats)
        for kind, key in visitors.commands.keys().items()
        if kind in kinds
    ]
    server.gui.add_html(
        render(
            "all_keys",
            groups=key_rows(visitors.commands, kinds, SHORT_NAMES),
            keys=json.dumps(keys),
            contexts=contexts,
        ),
        order=_LAST,
    )
    for kind in visitors.commands:
        if kind in kinds and kind.is_in_palette():
            add(server, visitors, kind.help(), kind(), key_in_words(kind.key))
    for tab, fold in (*((tab, "") for tab in tabs), *places(server)):
        label, about = (fold, f"in {tab}" if tab else "") if fold else (f"{tab} tab", "")
        add(server, visitors, label, ShowTab(tab=tab, fold=fold), about)


def add(
    server: viser.ViserServer, visitors: Visitors, label: str, command: Command, about: str = ""
) -> viser.CommandHandle:
    """Add one command to the palette of every page.

    Args:
        about: text below the label, which the palette searches too.
    """
    handle = server.gui.add_command(label, description=about or None)
    handle.on_trigger(visitors.on(command))
    return handle


def add_hints(server: viser.ViserServer) -> viser.GuiHtmlHandle:
    """Add four hints to the present container, unless the user has closed them for good."""
    return server.gui.add_html("" if preferences().hints_closed else render("hints", close=CloseHints()))

"""Our own rows of buttons: the buttons of viser's groups cannot be disabled or given hints individually."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from workbench.page.command import Command
from workbench.page.widgets.keys_and_palette import with_key
from workbench.page.widgets.templates import render


@dataclass(frozen=True)
class Tool:
    name: str
    command: Command
    hint: str = ""
    """Tooltip; by default the command's help and key."""
    on: bool = False
    """Whether it is the chosen one of several."""
    off: bool = False
    """Whether it is disabled because it would do nothing."""
    style: Literal["button", "pill"] = "button"
    tone: Literal["", "main", "danger"] = ""
    """Tone: ``main`` for the most frequent action, ``danger`` for one that cannot be undone."""
    is_label: bool = False


@dataclass(frozen=True)
class Label:
    """Label of the following tools."""

    name: str
    hint: str
    is_label: bool = True


def tool(name: str, command: Command, off: bool = False, tone: Literal["", "main", "danger"] = "") -> Tool:
    """A button whose tooltip is the command's help and key."""
    return Tool(name, command, with_key(type(command)), off=off, tone=tone)


def tools_html(*rows: Sequence[Tool | Label]) -> str:
    return render("tools", rows=[row for row in rows if row])

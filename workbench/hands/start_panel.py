"""Shows the change of the file that gives a body another first pose, with its buttons."""

from __future__ import annotations

from pathlib import PurePath

from workbench.cameras.edit_panel import diff_lines
from workbench.hands.commands import DropStartChange, RevertStartChange, SaveStartChange
from workbench.hands.start_edit import IN_FILE, StartEdit
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Tool, tool

TONES = {"checked": "good", "refused": "warn", "mismatch": "bad"}


def start_edit_html(edit: StartEdit) -> str:
    """The change and its stage as HTML; empty without a change."""
    if edit.stage == "none":
        return ""
    source = edit.edit if edit.stage != "undone" else None
    tools = start_tools(edit)
    return render(
        "camera_writing",
        message=edit.message,
        tone=TONES.get(edit.stage, "plain"),
        about="",
        picture="",
        drawing=None,
        files=[
            (change.file, PurePath(change.file).name, diff_lines(change.diff))
            for change in (() if source is None else source.changes)
        ],
        folded=edit.stage in IN_FILE,
        notes=() if source is None else source.notes,
        snippet=edit.snippet,
        rows=[tools] if tools else [],
        new=edit.stage == "planned",
    )


def start_tools(edit: StartEdit) -> list[Tool]:
    """Buttons for the change."""
    if edit.stage == "planned" and edit.edit is not None:
        save = tool(f"Save to {edit.edit.names}", SaveStartChange(), tone="main")
        return [save, tool("Discard the change", DropStartChange())]
    if edit.stage in IN_FILE:
        return [tool("Revert in the file", RevertStartChange()), tool("Close", DropStartChange())]
    return [tool("Close", DropStartChange())] if edit.stage in ("refused", "undone") else []

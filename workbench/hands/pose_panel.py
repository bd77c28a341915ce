"""Shows the change of the file that gives a body another first pose, with its buttons."""

from __future__ import annotations

from pathlib import PurePath

from workbench.cameras.edit_panel import diff_lines
from workbench.hands.commands import DropPoseChange, RevertPoseChange, SavePoseChange
from workbench.hands.pose_edit import IN_FILE, PoseEdit
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import Tool, tool

MOODS = {"checked": "good", "refused": "warn", "mismatch": "bad"}


def pose_edit_html(edit: PoseEdit) -> str:
    """The change and its stage as HTML; empty without a change."""
    if edit.stage == "none":
        return ""
    source = edit.edit if edit.stage != "undone" else None
    tools = pose_tools(edit)
    return render(
        "camera_writing",
        message=edit.message,
        mood=MOODS.get(edit.stage, "plain"),
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


def pose_tools(edit: PoseEdit) -> list[Tool]:
    """Buttons for the change."""
    if edit.stage == "planned" and edit.edit is not None:
        save = tool(f"Save to {edit.edit.names}", SavePoseChange(), tone="main")
        return [save, tool("Discard the change", DropPoseChange())]
    if edit.stage in IN_FILE:
        return [tool("Revert in the file", RevertPoseChange()), tool("Close", DropPoseChange())]
    return [tool("Close", DropPoseChange())] if edit.stage in ("refused", "undone") else []

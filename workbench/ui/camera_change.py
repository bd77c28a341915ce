"""A change of the author's file, shown where it was asked for: the diff, and the buttons that make it or leave it.

A change is asked for in two places of the tab, at the top for the placement and at its end for adding and removing,
and a diff that opens a screen away from the button is not seen. So each place has a box of its own, and when what was
asked for comes into it, its last button is brought into sight.
"""

from __future__ import annotations

from pathlib import PurePath

import viser

from workbench.session.session import Session
from workbench.session.studio_view import Writing
from workbench.ui.arrival import Arrival
from workbench.ui.fragments import render
from workbench.ui.viser_seam import element_id

LEAVE, CLOSE = "Leave the file as it is", "Close"
MOODS = {"checked": "good", "undone": "plain", "refused": "warn", "mismatch": "bad"}
DONE = ("written", "checked", "mismatch")


class CameraChange:
    """One box in the present container."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        gui = server.gui
        self.arrival = Arrival()
        self._text = gui.add_html("", visible=False)
        self._write = gui.add_button("Write it", icon=viser.Icon.DEVICE_FLOPPY, color="green", visible=False)
        self._undo = gui.add_button(
            "Take it back out of the file", icon=viser.Icon.ARROW_BACK_UP, color="gray", visible=False
        )
        self._copy = gui.add_button(
            "Copy the task into my folder",
            icon=viser.Icon.COPY,
            visible=False,
            hint=f"A file of your own in {session.studio.file.folder}, under a name that is free; the page opens it.",
        )
        self._drop = gui.add_button(LEAVE, color="gray", visible=False)
        self._write.on_click(lambda _: session.studio.file.write())
        self._undo.on_click(lambda _: session.studio.file.undo_write())
        self._copy.on_click(lambda _: session.studio.file.copy_task())
        self._drop.on_click(lambda _: session.studio.file.drop_plan())

    def draw(self, writing: Writing, stale: bool, about: str = "", picture: str = "") -> None:
        """Show how far it is; a `Writing` of no stage and no message empties the box.

        Args:
            stale: the camera was moved since the plan was made.
            about: what else is to be said of the plan.
            picture: address of what the camera would see that is to be added.
        """
        stage = writing.stage
        self._text.visible = stage != "none" or bool(writing.message)
        self._copy.visible = writing.can_copy
        self._write.visible = stage == "planned" and not stale
        self._drop.visible = stage not in ("none", "written")
        self._undo.visible = stage in DONE
        name = "" if writing.edit is None else writing.edit.names
        self._drop.label = LEAVE if stage == "planned" else CLOSE
        self._write.label = f"Write it to {name}" if name else "Write it"
        new = self.arrival.just_came(writing if stage != "none" else None)
        self._text.content = writing_html(
            writing,
            stale,
            about if stage == "planned" else "",
            element_id(self._drop) if new else "",
            picture if stage == "planned" else "",
        )


def writing_html(
    writing: Writing, stale: bool, about: str = "", scroll_to: str = "", picture: str = ""
) -> str:
    """How far the change is; every value escaped.

    Args:
        scroll_to: id of the element that is to come into sight.
        picture: address of one.
    """
    edit, refusal = writing.edit, writing.refusal
    files = [] if edit is None or writing.stage == "undone" else edit.changes
    return render(
        "camera_writing",
        message="The camera was moved since: show the change again." if stale else writing.message,
        mood="warn" if stale else MOODS.get(writing.stage, "plain"),
        about=about,
        picture=picture,
        files=[(change.file, PurePath(change.file).name, diff_lines(change.diff)) for change in files],
        folded=writing.stage in DONE,
        notes=() if edit is None or writing.stage == "undone" else edit.notes,
        snippet="" if refusal is None else refusal.snippet,
        scroll_to=scroll_to,
    )


def diff_lines(diff: str) -> list[tuple[str, str]]:
    """Each line of a unified diff with its kind (``add``, ``del``, ``at``, ``same``), less the names of the files.

    The indentation that all of them have is left out: the panel is narrow.
    """
    kinds = {"+": "add", "-": "del", "@": "at"}
    lines = [(kinds.get(line[:1], "same"), line) for line in diff.splitlines()[2:]]
    code = [line[1:] for kind, line in lines if kind != "at" and line[1:].strip()]
    indent = min((len(line) - len(line.lstrip()) for line in code), default=0)
    return [(kind, line if kind == "at" else line[:1] + " " + line[1 + indent :]) for kind, line in lines]

"""The pose of the body that was clicked in the 3-D view of a review."""

from __future__ import annotations

import viser

from workbench.live.commands import SelectBody
from workbench.live.panels.inspect_panel import pose_rows
from workbench.page.command import Command
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.visitors import Visitor
from workbench.review.view import ReviewView


class ReviewBodyPanel(PagePart[ReviewView]):
    """Shows the selected body of the selected recording at the present state."""

    does = (SelectBody,)

    def __init__(self, server: viser.ViserServer) -> None:
        self.body = ""
        """Name of the selected body; empty for none."""
        self._html = server.gui.add_html("", visible=False)

    def draw(self, view: ReviewView) -> None:
        text = body_html(self.body, view)
        self._html.content, self._html.visible = text, bool(text)

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case SelectBody(body=body):
                self.select(body)

    def select(self, body: str) -> None:
        """Select the body with this name; empty for none."""
        self.body = body


def body_html(body: str, view: ReviewView) -> str:
    """Name, kind and pose of `body`, as HTML; empty if `body` is empty, or if the selected recording lacks
    the body."""
    chosen = view.chosen
    geometry = None if chosen is None else chosen.episode.geometry
    if chosen is None or geometry is None or chosen.episode.poses is None or body not in geometry.body_names:
        return ""
    row, state = geometry.body_names.index(body), view.states[view.selected]
    poses = pose_rows((body,), chosen.episode.poses[state, row : row + 1])
    return render(
        "inspect_body",
        name=body,
        about=geometry.body_kinds[row],
        pose=poses[0] if poses else None,
        clear=SelectBody(body=""),
    )

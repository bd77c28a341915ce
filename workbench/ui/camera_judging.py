"""What can be done with the selected camera beside placing it: judge it, compare, have placements suggested, take its
numbers elsewhere.

Each of these is a folder of its own, closed until somebody wants it. What runs in the background belongs to no single
one of them (only one thing runs at a time), so its progress and the button that stops it stand above them all.
"""

from __future__ import annotations

import viser
from numpy.typing import NDArray

from workbench.session.session import Session
from workbench.session.studio_view import Progress
from workbench.session.view import SessionView
from workbench.ui.camera_compare import CameraCompare
from workbench.ui.camera_export import CameraExport
from workbench.ui.camera_suggest import CameraSuggest
from workbench.ui.camera_verdict import CameraVerdict
from workbench.ui.fragments import render


class CameraJudging:
    """The folders in the present container, and what they draw in the view.

    Each works on `StudioView.selected`.
    """

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._progress: Progress | None = None
        self._bar = server.gui.add_html("", visible=False)
        self._stop = server.gui.add_button("Stop", icon=viser.Icon.PLAYER_STOP, visible=False)
        self._stop.on_click(lambda _: session.studio.stop())
        self._verdict = CameraVerdict(server, session)
        self._compare = CameraCompare(server, session)
        self._suggest = CameraSuggest(server, session)
        self._export = CameraExport(server, session)
        self._parts = (self._verdict, self._compare, self._suggest, self._export)

    def draw(self, view: SessionView) -> None:
        """Draw what is new."""
        running = view.studio.progress
        if running != self._progress:
            self._progress = running
            for handle in (self._bar, self._stop):
                handle.visible = running is not None
            if running is not None:
                self._bar.content = render(
                    "camera_progress",
                    what=running.what,
                    done=running.done,
                    total=running.total,
                    percent=f"{100 * running.done / max(1, running.total):.0f}",
                )
        for part in self._parts:
            part.draw(view)
        # Folders without a subject would be dead controls.
        there = view.studio.chosen is not None
        for part in self._parts:
            if part.folder.visible != there:
                part.folder.visible = there

    def draw_in_view(self, view: SessionView, offset: NDArray) -> None:
        """Draw the bounds of the eye.

        Args:
            offset: (3,) where the selected env stands in the view.
        """
        self._suggest.draw_in_view(view, offset)

"""What can be done with the selected camera beside placing it: judge it, compare, have placements suggested, take its
numbers elsewhere.

Each of these is a folder of its own, closed until somebody wants it.
"""

from __future__ import annotations

import viser
from numpy.typing import NDArray

from workbench.session.session import Session
from workbench.session.view import SessionView
from workbench.ui.camera_compare import CameraCompare
from workbench.ui.camera_export import CameraExport
from workbench.ui.camera_suggest import CameraSuggest
from workbench.ui.camera_verdict import CameraVerdict


class CameraJudging:
    """The folders in the present container, and what they draw in the view.

    Each works on `StudioView.selected`.
    """

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._verdict = CameraVerdict(server, session)
        self._compare = CameraCompare(server, session)
        self._suggest = CameraSuggest(server, session)
        self._export = CameraExport(server, session)
        self._parts = (self._verdict, self._compare, self._suggest, self._export)

    def draw(self, view: SessionView) -> None:
        """Draw what is new."""
        # Folders without a subject would be dead controls.
        there = view.studio.chosen is not None
        for part in self._parts:
            part.folder.visible = there
            part.draw(view)

    def draw_in_view(self, view: SessionView, offset: NDArray) -> None:
        """Draw the bounds of the eye.

        Args:
            offset: (3,) where the selected env stands in the view.
        """
        self._suggest.draw_in_view(view, offset)

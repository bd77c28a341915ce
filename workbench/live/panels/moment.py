"""Parts of the live page that show numbers of the shown moment."""

from __future__ import annotations

from workbench.live.view import SessionView
from workbench.page.widgets.parts import PagePart


class MomentPart(PagePart[SessionView]):
    """A part that is drawn together with all other `MomentPart` objects, from one view."""

    of_the_moment = True
    every = 0.2
    """Seconds between two drawings; numbers of many rows cannot be read faster."""

    def urgent(self, view: SessionView) -> object:
        # A step that the user requests is drawn at once.
        step = None if view.playing else view.step_serial
        return view.task_serial, view.state, view.playing, view.selected_env, view.timeline.shown, step

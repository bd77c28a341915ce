"""Parts of the live page that show numbers of the shown moment."""

from __future__ import annotations

from workbench.live.view import SessionView
from workbench.page.widgets.parts import PagePart


class MomentPart(PagePart[SessionView]):
    """Drawn with all others of its kind, from one view."""

    of_the_moment = True
    every = 0.2
    """Seconds between two drawings; numbers of many rows cannot be read faster."""

    def urgent(self, view: SessionView) -> object:
        # A person waits for a step that they ask for.
        step = None if view.playing else view.step_serial
        return view.task_serial, view.state, view.playing, view.selected_env, view.timeline.shown, step

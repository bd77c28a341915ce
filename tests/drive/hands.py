"""A `HandsPanel` without the rest of the page, and the edits of where episodes begin in a session."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.drive.live import StubSession
from tests.drive.panels import Panels
from tests.drive.scenes import running
from tests.drive.session import wait_until
from workbench.app.session import Session
from workbench.envs.scene.shapes import BodyKind
from workbench.hands.commands import RevertStartChange, SaveStartChange
from workbench.hands.panel import HandsPanel
from workbench.hands.start_edit import StartEdit

OFFSET = np.array([5.0, 0.0, 0.0])
MIDDLE = np.zeros(3)
PAGE = 3
EYE = OFFSET + [1.0, 0.0, 1.0]
"""Position of the page's camera in the view."""


class Hands:
    """A panel on its own, with `body` selected in env 1 of 3; `kind` replaces the body's kind."""

    def __init__(
        self, panels: Panels, body: str = "cube", playing: bool = False, kind: BodyKind | None = None
    ) -> None:
        self.session = StubSession()
        self.panel = HandsPanel(panels.server, self.session, lambda: body)  # type: ignore[arg-type]
        self.view = replace(running(3, selected_env=1), playing=playing)
        assert self.view.task is not None
        if kind is not None:
            geometry = self.view.task.geometry
            kinds = dict(zip(geometry.body_names, geometry.body_kinds, strict=True)) | {body: kind}
            task = replace(self.view.task, geometry=replace(geometry, body_kinds=tuple(kinds.values())))
            self.view = replace(self.view, task=task)
        assert self.view.task is not None and self.view.step is not None
        self.session.shown, self.poses = self.view, self.view.step.poses
        self.geometry = self.view.task.geometry
        self.pose = self.poses[1, self.geometry.body_names.index(body)]
        self.redraw()

    def redraw(self) -> np.ndarray:
        """Draw; returns the poses as drawn."""
        moved = self.panel.moved(self.geometry, self.poses)
        self.panel.draw_in_view(self.view, moved, OFFSET)
        self.panel.draw(self.view)
        return moved

    def drag(self, *ends: np.ndarray, grabbed: np.ndarray = MIDDLE, lifts: bool = False) -> None:
        """Drag from `grabbed`, relative to the body's origin, through `ends`, in the env's frame."""
        start = self.pose[:3] + grabbed + OFFSET
        phases = ["start", *["update"] * (len(ends) - 1)]
        for phase, end in zip(phases, ends, strict=True):
            self.panel.drag(PAGE, phase, start, end + OFFSET, EYE, lifts)  # type: ignore[arg-type]


def edit_reaches(session: Session, *stages: str) -> StartEdit:
    """Wait until the edit of the start is at one of these stages."""
    return wait_until(session, lambda v: v.of(StartEdit).stage in stages, " or ".join(stages)).of(StartEdit)


def save_planned_edit(session: Session) -> None:
    """Save the edit of the start that is being planned, and wait until a run has shown its effect."""
    planned = edit_reaches(session, "planned", "refused")
    assert planned.stage == "planned", planned.message
    session.do(SaveStartChange())
    done = edit_reaches(session, "checked", "mismatch", "refused")
    assert done.stage == "checked", done.message


def revert_edit(session: Session) -> None:
    session.do(RevertStartChange())
    wait_until(
        session, lambda v: v.of(StartEdit).stage == "undone" and not v.of(StartEdit).writing, "the old text"
    )

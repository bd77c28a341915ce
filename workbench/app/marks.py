"""Marks that are visible on every tab: recording, saving of the past, a camera moved by hand, findings, flagged envs."""

from __future__ import annotations

import time

import numpy as np
import viser

from workbench.app.session import Session
from workbench.cameras.commands import PutMovedCamerasBack, ShowCameraChange
from workbench.cameras.events import CameraChosen, EditWanted
from workbench.cameras.studio_panel import TAB as CAMERAS
from workbench.cameras.view import EditRequest, StudioView
from workbench.checks.commands import ShowChecks
from workbench.checks.panel import TAB as CHECKS
from workbench.checks.panel import findings_mark
from workbench.envs.camera_data import CameraKey
from workbench.live.env_commands import ShowFirstFlagged
from workbench.live.history.env_table import EnvRows
from workbench.live.panels.env_panel import first_flagged, mask
from workbench.live.view import SessionView
from workbench.page.command import Command
from workbench.page.commands import ShowTab
from workbench.page.widgets.open_tabs import OpenTabs
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import counted, render
from workbench.page.widgets.visitors import Visitor
from workbench.record.commands import StopRecording
from workbench.record.panel import envs_in_words
from workbench.record.state import RecordingStatus

EPISODES = "Episodes"


class Marks(PagePart[SessionView]):
    """The row of marks between the status line and the tabs. The marks are not part of the status line, whose
    frequent redraws would replace a mark while it is pressed.

    Args:
        server: The page.
        session: The session.
        tabs: Opens the tab that a mark is about.
    """

    every = 0.25

    does = (ShowCameraChange, ShowChecks)

    def __init__(self, server: viser.ViserServer, session: Session, tabs: OpenTabs) -> None:
        self._session, self._tabs = session, tabs
        self._html = server.gui.add_html("")

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ShowCameraChange():
                self._show_change(visitor)
            case ShowChecks():
                self._tabs.open(visitor, CHECKS)

    def urgent(self, view: SessionView) -> object:
        recording = view.of(RecordingStatus)
        saves = recording.saving.progress is not None
        return (
            recording.active,
            recording.env_idx,
            recording.waiting,
            recording.episodes,
            saves,
            moved_cameras(view),
        )

    def draw(self, view: SessionView) -> None:
        flagged = None if view.env_table is None else flagged_text(view.env_table)
        self._html.content = render(
            "marks",
            rec=recording_mark(view),
            moved=moved_mark(view),
            saving=ShowTab(tab=EPISODES) if view.of(RecordingStatus).saving.progress is not None else None,
            findings=findings_mark(view),
            checks=ShowChecks(),
            pages=view.pages,
            flagged=flagged and {"text": flagged[0], "hint": flagged[1], "press": ShowFirstFlagged()},
        )

    def _show_change(self, visitor: Visitor) -> None:
        """Show how the file would change; nothing is written until the user confirms."""
        moved = moved_cameras(self._session.view())
        if not moved:
            return
        self._session.dispatch(CameraChosen(moved[0]))
        self._session.dispatch(EditWanted(EditRequest("edit", moved[0])))
        self._tabs.open(visitor, CAMERAS)


def moved_cameras(view: SessionView) -> tuple[CameraKey, ...]:
    """The cameras whose pose differs from their pose in the task's file."""
    return tuple(camera.key for camera in view.of(StudioView).cameras if camera.moved)


def moved_mark(view: SessionView) -> dict[str, object] | None:
    """The mark of moved cameras; None if all are as in the file."""
    moved = [name for _, name in moved_cameras(view)]
    if not moved:
        return None
    names, one = ", ".join(moved), len(moved) == 1
    what = "camera moved" if one else "cameras moved"
    hint = f"{names} {'differs' if one else 'differ'} from the pose in the file, in every env and recording."
    return {
        "what": what,
        "names": names,
        "undo": PutMovedCamerasBack(),
        "save": ShowCameraChange(),
        "hint": hint,
    }


def recording_mark(view: SessionView) -> dict[str, object] | None:
    """The mark of a recording; None while none runs."""
    recording = view.of(RecordingStatus)
    if not recording.active:
        return None
    count = 1 if view.task is None else view.task.num_envs
    # Nothing here may change with each step: a redraw would replace the element during a press.
    hint = f"Recording {envs_in_words(recording.env_idx)}."
    if recording.waiting:
        whose = "its" if recording.waiting == 1 else "their"
        hint += f" Recording of {counted(recording.waiting, 'env')} starts at {whose} next reset."
    if view.selected_env not in recording.env_idx:
        hint += f" The selected env {view.selected_env} is not recorded."
    every = len(recording.env_idx) == count > 1
    return {
        "envs": f"all {count} envs" if every else envs_in_words(recording.env_idx, 2),
        "waiting": recording.waiting,
        "all_wait": recording.waiting == len(recording.env_idx),
        "episodes": recording.episodes,
        "since": time.strftime("%H:%M", time.localtime(recording.since)),
        "stop": StopRecording(),
        "hint": hint,
    }


def flagged_text(rows: EnvRows) -> tuple[str, str] | None:
    """(label, hint) with the number of flagged envs and the reason why the first one is flagged; None if no
    env is flagged."""
    count = int(np.count_nonzero(mask(rows, "flagged")))
    env = first_flagged(rows)
    if env is None:
        return None
    outlier = (rows.outliers.get(env) or rows.last.outliers[env])[0]
    when = f"step {outlier.step}" + ("" if env in rows.outliers else " of the previous episode")
    envs = "" if rows.num_envs == 1 else f"{count} of {rows.num_envs} envs "
    hint = f"In env {env}, {when}: {outlier.text}. Click to see it; the table of envs (B) lists all."
    return f"⚑ {envs}flagged: {outlier.reason}", hint

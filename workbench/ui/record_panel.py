"""The Episodes tab: start and stop recording, what is being written, and how to open it."""

from __future__ import annotations

import shlex

import viser

from workbench.session.view import RecordingStatus, SessionView
from workbench.ui.fragments import render

THIS_ENV, ALL_ENVS = "the selected env", "all envs"


class RecordPanel:
    """A button that records, and its state.

    Args:
        server: The page.
        start: Asks the session to record these envs; None records all.
        stop: Asks the session to stop.
    """

    def __init__(self, server: viser.ViserServer, start, stop) -> None:
        self._start, self._stop = start, stop
        self._selected_env = 0
        self._active = False
        self._html_drawn = ""
        self._which = server.gui.add_dropdown("Record", (THIS_ENV, ALL_ENVS), initial_value=THIS_ENV)
        self._button = server.gui.add_button("Record", icon=viser.Icon.PLAYER_RECORD, color="red")
        self._status = server.gui.add_html("")
        self._button.on_click(lambda _: self.toggle())

    def toggle(self) -> None:
        """Start if nothing is recorded, stop if something is."""
        if self._active:
            self._stop()
        elif self._which.value == ALL_ENVS:
            self._start(None)
        else:
            self._start((self._selected_env,))

    def draw(self, view: SessionView) -> None:
        recording = view.recording
        self._selected_env, self._active = view.selected_env, recording.active
        label = "Stop recording" if recording.active else "Record"
        if self._button.label != label:
            self._button.label = label
            self._button.icon = viser.Icon.PLAYER_STOP if recording.active else viser.Icon.PLAYER_RECORD
        can_record = view.task is not None and view.state != "stopped"
        self._button.disabled = not can_record and not recording.active
        self._which.disabled = recording.active or not can_record
        self._which.visible = view.task is None or view.task.num_envs > 1
        html = recording_html(recording)
        if html != self._html_drawn:
            self._html_drawn = html
            self._status.content = html


def recording_html(recording: RecordingStatus) -> str:
    envs = ""
    if recording.active:
        numbers = ", ".join(str(env) for env in recording.env_idx[:6])
        more = f" and {len(recording.env_idx) - 6} more" if len(recording.env_idx) > 6 else ""
        envs = f"env{'s' if len(recording.env_idx) != 1 else ''} {numbers}{more}"
    return render(
        "recording",
        active=recording.active,
        envs=envs,
        steps=recording.steps,
        written=recording.episodes_written,
        folder=recording.folder,
        last_file=recording.last_file,
        command=None if recording.last_file is None else f"rerun {shlex.quote(recording.last_file)}",
        problem=recording.problem,
    )

"""The Episodes tab: record from now on, record the next episode, or keep the past one."""

from __future__ import annotations

import shlex

import viser

from workbench.recording.reader.reading import recovered_text
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.session.record.live import RecordingStatus
from workbench.ui.live.moment import MomentPart
from workbench.ui.widgets.templates import counted, render

THIS_ENV, ALL_ENVS = "the selected env", "all envs"
RECORD, NEXT, SAVE = "Record", "Record the next episode", "Save what I just saw"
SAVE_BEFORE = "Save the previous episode"
STOP, STOP_WAITING, STOP_SAVING = "Stop recording", "Stop waiting", "Stop saving"


class RecordPanel(MomentPart):
    """Three buttons, each of which also stops what it began, and their state in words.

    *Record* begins a fresh episode, since one without its reset cannot be replayed; *Record the next episode* waits for a
    reset; *Save what I just saw* makes a recording of the past.
    """

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._session = session
        self._button = server.gui.add_button(
            RECORD,
            icon=viser.Icon.PLAYER_RECORD,
            hint="Reset and record every episode until it is stopped (Shift+C)",
        )
        self._which = server.gui.add_dropdown("Envs", (THIS_ENV, ALL_ENVS), initial_value=THIS_ENV)
        self._next = server.gui.add_button(
            NEXT,
            icon=viser.Icon.PLAYER_TRACK_NEXT,
            color="gray",
            hint="Wait for the next reset and record that one episode",
        )
        self._save = server.gui.add_button(
            SAVE,
            icon=viser.Icon.HISTORY,
            color="gray",
            hint="Record after the fact: the episode at the shown moment (Shift+K)",
        )
        self._before = server.gui.add_button(
            SAVE_BEFORE,
            icon=viser.Icon.PLAYER_TRACK_PREV,
            color="gray",
            visible=False,
            hint="The episode before the shown one",
        )
        self._about = server.gui.add_html("")
        self._status = server.gui.add_html("")
        self._button.on_click(lambda _: self.toggle())
        self._next.on_click(lambda _: session.start_recording(self._envs, next_episode=True))
        self._save.on_click(lambda _: self.save())
        self._before.on_click(lambda _: session.save_past(self._envs, before=True))

    @property
    def _envs(self) -> tuple[int, ...] | None:
        return None if self._which.value == ALL_ENVS else (self._session.view().selected_env,)

    def toggle(self) -> None:
        """Start or stop recording."""
        if self._session.view().recording.active:
            self._session.stop_recording()
        else:
            self._session.start_recording(self._envs)

    def save(self) -> None:
        """Start or stop keeping the past episode."""
        if self._session.view().recording.saving.progress is not None:
            self._session.past_saver.stop()
        else:
            self._session.save_past(self._envs)

    def key(self, view: SessionView) -> object:
        return view.recording, view.timeline, view.step_serial

    def urgent(self, view: SessionView) -> object:
        recording = view.recording
        stand = recording.active, recording.waiting, recording.saving.progress is None
        return super().urgent(view), self._which.value, *stand, view.timeline.moments == 0

    def draw(self, view: SessionView) -> None:
        recording, saving = view.recording, view.recording.saving.progress is not None
        waits = recording.active and recording.waiting == len(recording.env_idx)
        self._button.label = STOP_WAITING if waits else STOP if recording.active else RECORD
        self._button.icon = viser.Icon.PLAYER_STOP if recording.active else viser.Icon.PLAYER_RECORD
        self._save.label = STOP_SAVING if saving else SAVE
        self._save.icon = viser.Icon.PLAYER_STOP if saving else viser.Icon.HISTORY
        can_record = view.task is not None and view.state != "stopped"
        self._button.disabled = not can_record and not recording.active
        # Disabled, not hidden: the next button would move under the pointer.
        self._next.disabled = not can_record or recording.active
        self._save.disabled = view.timeline.moments == 0 and not saving
        self._which.disabled = not can_record
        self._which.visible = view.task is None or view.task.num_envs > 1
        about = what_saving_means(view, self._which.value == ALL_ENVS)
        self._about.content = render("note", text=about) if about and not saving else ""
        self._before.visible = has_one_before(view) and not saving
        self._status.content = recording_html(recording)


def runs_since(view: SessionView) -> int | None:
    """Steps of the selected env's episode up to the shown moment, if it still runs there; else None."""
    step, env = view.step, view.selected_env
    if step is None or view.timeline.moments == 0 or env >= len(step.elapsed_steps):
        return None
    if step.terminated[env] or step.truncated[env] or not step.elapsed_steps[env]:
        return None
    return int(step.elapsed_steps[env])


def has_one_before(view: SessionView) -> bool:
    """Whether the history has steps before a running episode."""
    steps, past = runs_since(view), view.timeline
    return steps is not None and past.tick - past.first_tick > steps


def what_saving_means(view: SessionView, all_envs: bool) -> str:
    """Which episode *Save what I just saw* takes, if it is a running one; else empty."""
    steps = runs_since(view)
    if steps is None or view.task is None:
        return ""
    if view.timeline.shown is not None:
        return f"{SAVE}: the whole episode around the shown moment."
    count = counted(steps, "step")
    if view.task.num_envs == 1:
        return f"{SAVE}: this episode, {count}."
    if all_envs:
        return f"{SAVE}: all envs, their running episodes (env {view.selected_env}: {count})."
    return f"{SAVE}: env {view.selected_env}, this episode, {count}."


def recording_html(recording: RecordingStatus) -> str:
    return render(
        "recording",
        recording=recording,
        envs=envs_in_words(recording.env_idx),
        recovered=recovered_text(recording.recovered),
        command=recording.last_file and f"workbench view {shlex.quote(recording.last_file)}",
    )


def envs_in_words(env_idx: tuple[int, ...], most: int = 6) -> str:
    """``envs 0, 3 and 5 more``."""
    numbers = ", ".join(str(env) for env in env_idx[:most])
    more = f" and {len(env_idx) - most} more" if len(env_idx) > most else ""
    return f"env{'s' if len(env_idx) != 1 else ''} {numbers}{more}"

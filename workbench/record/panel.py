"""The Episodes tab: record from now on, record the next episode, or save a past one."""

from __future__ import annotations

import shlex

import viser

from workbench.episodes.reader.reading import recovered_text
from workbench.live.panels.moment import MomentPart
from workbench.live.panels.run_panel import ENVS
from workbench.live.view import SessionView
from workbench.page.widgets.fields import choice
from workbench.page.widgets.keys_and_palette import with_key
from workbench.page.widgets.templates import counted, render
from workbench.page.widgets.tools import Tool, tool, tools_html
from workbench.record.commands import (
    ChooseRecordedEnvs,
    RecordNextEpisode,
    SavePreviousEpisode,
    ToggleRecording,
    ToggleSavePast,
)
from workbench.record.state import RecordingStatus

RECORD_HINT = "Reset and record every episode until you stop it"
SAVE_HINT = "Make a recording of the episode that contains the shown moment"
RECORD, NEXT, SAVE = "Record", "Record the next episode", "Save what I just saw"
SAVE_BEFORE = "Save the previous episode"
REC = "REC"
STOP, STOP_WAITING, STOP_SAVING = "Stop recording", "Stop waiting", "Stop saving"


def record_tool(view: SessionView) -> Tool:
    """The transport's button that starts and stops recording."""
    recording = view.of(RecordingStatus)
    off = not recording.active and (view.task is None or view.state == "stopped")
    hint = with_key(ToggleRecording, STOP if recording.active else RECORD_HINT)
    return Tool(REC, ToggleRecording(), hint, on=recording.active, off=off)


class RecordPanel(MomentPart):
    """The buttons that record and save episodes, and a status text.

    *Record* begins a new episode, because an episode without its reset cannot be replayed. *Record the next
    episode* waits for a reset. *Save what I just saw* makes a recording of the past. *Record* also stops a
    recording, and *Save what I just saw* also stops a save.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._record = server.gui.add_html("")
        self._which = choice(server, "Envs", ChooseRecordedEnvs, "envs", ENVS, "selected")
        self._others = server.gui.add_html("")
        self._about = server.gui.add_html("")
        self._status = server.gui.add_html("")

    def key(self, view: SessionView) -> object:
        return view.of(RecordingStatus), view.timeline, view.step_serial

    def urgent(self, view: SessionView) -> object:
        recording = view.of(RecordingStatus)
        stand = recording.active, recording.waiting, recording.saving.progress is None
        return super().urgent(view), recording.chosen, *stand, view.timeline.moments == 0

    def draw(self, view: SessionView) -> None:
        recording, saving = view.of(RecordingStatus), view.of(RecordingStatus).saving.progress is not None
        waits = recording.active and recording.waiting == len(recording.env_idx)
        can_record = view.task is not None and view.state != "stopped"
        record = STOP_WAITING if waits else STOP if recording.active else RECORD
        off = not can_record and not recording.active
        hint = with_key(ToggleRecording, RECORD_HINT)
        self._record.content = tools_html([Tool(record, ToggleRecording(), hint, off=off, tone="main")])
        self._which.show(recording.chosen, off=not can_record)
        self._which.visible = view.task is None or view.task.num_envs > 1
        # Disable the button, and do not hide it: without it, the next button would move under the pointer.
        following = tool(NEXT, RecordNextEpisode(), off=not can_record or recording.active)
        save = Tool(
            STOP_SAVING if saving else SAVE,
            ToggleSavePast(),
            with_key(ToggleSavePast, SAVE_HINT),
            off=view.timeline.moments == 0 and not saving,
        )
        before = [tool(SAVE_BEFORE, SavePreviousEpisode())] if has_one_before(view) and not saving else []
        self._others.content = tools_html([following], [save], before)
        about = what_saving_means(view, recording.chosen == "all")
        self._about.content = render("note", text=about) if about and not saving else ""
        self._status.content = recording_html(recording)


def runs_since(view: SessionView) -> int | None:
    """Steps of the selected env's episode up to the shown moment; None if the episode has no step yet, or has
    ended at that moment."""
    step, env = view.step, view.selected_env
    if step is None or view.timeline.moments == 0 or env >= len(step.elapsed_steps):
        return None
    if step.terminated[env] or step.truncated[env] or not step.elapsed_steps[env]:
        return None
    return int(step.elapsed_steps[env])


def has_one_before(view: SessionView) -> bool:
    """Whether the history has steps before the selected env's running episode."""
    steps, past = runs_since(view), view.timeline
    return steps is not None and past.tick - past.first_tick > steps


def what_saving_means(view: SessionView, all_envs: bool) -> str:
    """Text on what *Save what I just saw* would save; empty if the shown episode has no step or has ended."""
    steps = runs_since(view)
    if steps is None or view.task is None:
        return ""
    if view.timeline.shown is not None:
        return f"{SAVE}: the whole episode around the shown moment."
    count = counted(steps, "step")
    if view.task.num_envs == 1:
        return f"{SAVE}: this episode, {count}."
    if all_envs:
        return f"{SAVE}: the running episodes of all envs (env {view.selected_env}: {count})."
    return f"{SAVE}: this episode of env {view.selected_env}, {count}."


def recording_html(recording: RecordingStatus) -> str:
    return render(
        "recording",
        recording=recording,
        envs=envs_in_words(recording.env_idx),
        recovered=recovered_text(recording.recovered),
        command=recording.last_file and f"workbench view {shlex.quote(recording.last_file)}",
    )


def envs_in_words(env_idx: tuple[int, ...], most: int = 6) -> str:
    """Text with at most `most` numbers, such as ``envs 0, 3 and 5 more``."""
    numbers = ", ".join(str(env) for env in env_idx[:most])
    more = f" and {len(env_idx) - most} more" if len(env_idx) > most else ""
    return f"env{'s' if len(env_idx) != 1 else ''} {numbers}{more}"

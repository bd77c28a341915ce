"""The Episodes tab: what can be recorded or saved, and the commands of its buttons."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from tests.drive.live import Live
from tests.drive.scenes import running
from workbench.live.past import TimelineView
from workbench.live.process.background_jobs import JobProgress
from workbench.record.commands import (
    ChooseRecordedEnvs,
    RecordNextEpisode,
    SavePreviousEpisode,
    ToggleRecording,
    ToggleSavePast,
)
from workbench.record.panel import NEXT, RECORD, SAVE, SAVE_BEFORE, STOP, STOP_SAVING, STOP_WAITING
from workbench.record.saving_state import SaveStatus
from workbench.record.state import RecordingStatus

PAST = TimelineView(0, 40, None, 0, 40, 40, moments=41)


def test_possible_commands_are_offered_and_sent_for_the_chosen_envs(live_page: Live) -> None:
    def show(recording: RecordingStatus | None = None, past: TimelineView = PAST, **changes: Any) -> None:
        live_page.show(
            running(3, selected_env=1, recording=recording or RecordingStatus(), timeline=past, **changes)
        )

    tab = live_page.part("Episodes")
    show(past=replace(PAST, moments=0))
    assert tab.button(SAVE).command is None and tab.button(RECORD).command is not None
    show()
    tab.press(RECORD)
    tab.press(NEXT)
    tab.press(SAVE)
    tab.press(SAVE_BEFORE)
    tab.set("Envs", "all envs")
    assert live_page.asked == [
        ToggleRecording(),
        RecordNextEpisode(),
        ToggleSavePast(),
        SavePreviousEpisode(),
        ChooseRecordedEnvs(envs="all"),
    ]
    live_page.asked.clear()
    show(past=replace(PAST, first_tick=33, first=33))
    assert not tab.shows(SAVE_BEFORE), "all seven steps belong to this episode"
    show(RecordingStatus(True, (1,), 1e9, waiting=1))
    tab.press(STOP_WAITING)
    show(RecordingStatus(True, (1,), 1e9))
    assert tab.button(NEXT).command is None
    tab.press(STOP)
    show(RecordingStatus(saving=SaveStatus(progress=JobProgress("drawing", 1, 2))))
    assert not tab.shows(SAVE_BEFORE)
    tab.press(STOP_SAVING)
    assert live_page.asked == [ToggleRecording(), ToggleRecording(), ToggleSavePast()]
    show(RecordingStatus(chosen="all"))
    assert tab.field("Envs").value == "all envs"
    show(task=None)
    assert tab.button(RECORD).command is None

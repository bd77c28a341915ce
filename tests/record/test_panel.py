"""The Episodes tab: what can be recorded or saved, and the commands of its buttons."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

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
from workbench.record.panel import (
    NEXT,
    RECORD,
    SAVE,
    SAVE_BEFORE,
    STOP,
    STOP_SAVING,
    STOP_WAITING,
    envs_in_words,
    has_one_before,
    record_tool,
    runs_since,
    what_saving_means,
)
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


def test_what_would_be_saved_is_that_of_the_selected_env_and_the_shown_moment() -> None:
    view = running(3, selected_env=1, timeline=PAST)
    assert view.step is not None
    step = replace(view.step, elapsed_steps=np.array([4, 9, 0], np.int32))
    view = replace(view, step=step)
    assert (
        runs_since(view) == 9
        and "9" in what_saving_means(view, False)
        and "env 1" in what_saving_means(view, False)
    )
    texts = {
        what_saving_means(view, False),
        what_saving_means(view, True),
        what_saving_means(replace(view, timeline=replace(PAST, shown=30)), False),
    }
    assert len(texts) == 3
    other = replace(view, settings=replace(view.settings, selected_env=0))
    assert runs_since(other) == 4 and has_one_before(other)
    assert not has_one_before(replace(other, timeline=replace(PAST, first_tick=36)))
    assert has_one_before(replace(other, timeline=replace(PAST, first_tick=35)))
    no_step = replace(view, settings=replace(view.settings, selected_env=2))
    assert (
        runs_since(no_step) is None and not what_saving_means(no_step, False) and not has_one_before(no_step)
    )
    for ended in ("terminated", "truncated"):
        for env, runs in ((1, None), (0, 9)):
            mask = np.arange(3) == env
            assert runs_since(replace(view, step=replace(step, **{ended: mask}))) == runs
    assert runs_since(replace(view, timeline=replace(PAST, moments=0))) is None
    alone = running(1, timeline=PAST)
    assert "env" not in what_saving_means(alone, False) and "7" in what_saving_means(alone, False)


def test_the_transport_starts_and_stops_a_recording() -> None:
    view = running(3)
    active = replace(view, features={**view.features, RecordingStatus: RecordingStatus(True, (0,))})
    assert (record_tool(view).on, record_tool(view).off) == (False, False)
    assert (record_tool(active).on, record_tool(active).off) == (True, False)
    assert record_tool(replace(view, state="stopped")).off and record_tool(replace(view, task=None)).off
    assert not record_tool(replace(active, state="stopped")).off, "it can still be stopped"
    words = [envs_in_words(envs) for envs in ((3,), (0, 2), tuple(range(9)))]
    assert words[0] == "env 3" and "0, 2" in words[1] and "3 more" in words[2] and "6" not in words[2]

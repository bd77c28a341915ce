"""Recording, saving and rescoring as state machines: any sequence of events and commands, and the order of effects."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.scenes import camera, description, step_of, table_scene
from tests.drive.session import DEATH, moment
from workbench.app.state import Effect, SessionEvent, State, apply
from workbench.cameras.state import first_studio
from workbench.live.effects import Asked, Then
from workbench.live.events import (
    EnvsReset,
    FileSaved,
    LoadDone,
    Now,
    RunEffect,
    Send,
    VersionLoaded,
    WorkerDied,
)
from workbench.live.messages import Loaded, Reset, SetCapture, Settings
from workbench.live.messages import ReloadReport as Report
from workbench.live.process.background_jobs import JobProgress, StoppedBy
from workbench.live.process.supervisor import End
from workbench.live.run import first_run
from workbench.live.timeline_commands import StopRescoring
from workbench.page.command import Command, Refused
from workbench.record import state as of_recording
from workbench.record.commands import (
    ChooseRecordedEnvs,
    RecordNextEpisode,
    SavePreviousEpisode,
    SaveSolved,
    StopRecording,
    ToggleRecording,
    ToggleSavePast,
)
from workbench.record.gather import Finished
from workbench.record.saving_state import (
    BeginSaving,
    EndSaving,
    EpisodesKept,
    EpisodesSaved,
    KeptEpisodes,
    SaveFailed,
    SaveProgressed,
    SaveRequest,
    SaveWanted,
    request_of,
)
from workbench.record.state import (
    BeginEpisodes,
    EndEpisodes,
    EpisodeEnded,
    EpisodesEnded,
    EpisodesRecovered,
    EpisodeWritten,
    LiveRecording,
    RecordEffect,
    RecordingStatus,
    RecordingWanted,
    RunningEpisodes,
    StepRecorded,
    TakeStep,
)
from workbench.rescore import state as of_rescoring
from workbench.rescore.state import BeginRescoring, EndRescoring, RescoreEffect, RescoreView, RescoringUpdate
from workbench.solve.state import RunningEpisode, Solving
from workbench.task.description import TaskOptions

ENVS = 3
NOW = Now(5.0, 1e9)


def loaded(
    level: Any = None, hash: str = "a", envs: int = ENVS, carried: tuple[str, ...] = ()
) -> VersionLoaded:
    """An event: the worker has loaded a version, the first one if `level` is None."""
    geometry, poses = table_scene(envs)
    first = step_of(poses, success=np.zeros(envs, bool))
    task = replace(description(geometry, (camera(),)), source_hash=hash)
    report = None if level is None else Report(level, "", carried)
    return VersionLoaded(Loaded(task, first, {}, report, None), True)


def stepped(elapsed: int, jumped: tuple[int, ...] = ()) -> SessionEvent:
    return moment(np.full(ENVS, elapsed, np.int32), jumped, number=elapsed)


RESET, STEP = stepped(0, (0, 1, 2)), stepped(1)
COMMANDS: list[Command] = [
    ToggleRecording(),
    StopRecording(),
    RecordNextEpisode(),
    ToggleSavePast(),
    SavePreviousEpisode(),
    SaveSolved(),
    ChooseRecordedEnvs(envs="all"),
    ChooseRecordedEnvs(envs="selected"),
    StopRescoring(),
]
numbers, envs = st.integers(0, 3), st.lists(st.integers(0, ENVS - 1), unique=True).map(tuple)
EVENTS = st.one_of(
    st.sampled_from(COMMANDS).map(Asked),
    st.builds(
        loaded, st.sampled_from([None, "same", "patched", "rebuilt", "restarted"]), st.sampled_from("ab")
    ),
    st.builds(stepped, st.integers(0, 5), st.sampled_from([(), (), (1,), (0, 1, 2)])),
    st.builds(WorkerDied, st.builds(replace, st.just(DEATH), end=st.sampled_from(End)), st.just("")),
    st.sampled_from([LoadDone(), FileSaved(), EnvsReset()]),
    st.builds(RecordingWanted, st.none() | envs, st.booleans()),
    st.builds(SaveWanted, st.none() | envs.filter(bool), st.booleans()),
    st.builds(
        StepRecorded,
        numbers,
        st.just(0),
        envs,
        st.builds(RunningEpisodes, numbers, numbers, numbers),
        st.none() | st.text(min_size=1, max_size=5),
    ),
    st.builds(EpisodeEnded, st.booleans()),
    st.builds(EpisodeWritten, st.builds(Finished, numbers, numbers)),
    st.builds(EpisodesRecovered, st.just(("a.rrd",)), st.none() | st.just("no folder")),
    st.builds(SaveProgressed, numbers, st.just(JobProgress("drawing", 1, 2))),
    st.builds(EpisodesSaved, numbers, st.text(max_size=5)),
    st.builds(SaveFailed, numbers, st.text(max_size=5)),
    st.builds(
        RescoringUpdate,
        numbers,
        st.builds(RescoreView, st.sampled_from(["loading", "rescoring", "done", "failed"]), done=numbers),
    ),
)


def first() -> State:
    run = first_run("push.py", TaskOptions(ENVS), 2**20, Settings())
    return State(run, LiveRecording("recordings"), first_studio(None))


AppliedEvent = tuple[State, SessionEvent, State, list[Effect]]
"""The state before, the event, the state after it, and the effects."""


def apply_filtered(state: State, event: SessionEvent) -> tuple[State, list[Effect]]:
    """Return the state after an event, and the effects for these features and the run."""
    state, effects = apply(state, event, NOW)
    return state, [
        effect for effect in effects if isinstance(effect, RecordEffect | RescoreEffect | RunEffect)
    ]


def apply_all(happened: list[SessionEvent]) -> list[AppliedEvent]:
    """Apply the events in order; a refused event changes nothing."""
    state, steps = first(), []
    for event in happened:
        before = state
        effects: list[Effect] = []
        try:
            state, effects = apply_filtered(state, event)
        except Refused as reason:
            assert str(reason)
        steps.append((before, event, state, effects))
    return steps


def after(*happened: SessionEvent) -> tuple[State, list[Effect]]:
    """Return the state after the last event, and the effects of that event."""
    return apply_all(list(happened))[-1][2:]


@given(st.lists(EVENTS, max_size=25))
def test_any_sequence_is_deterministic_and_records_only_what_was_requested(
    happened: list[SessionEvent],
) -> None:
    steps, again = apply_all(happened), apply_all(happened)
    for (before, event, state, effects), (_, _, other, _) in zip(steps, again, strict=True):
        assert (state.recording, state.rescoring) == (other.recording, other.rescoring)
        recording, status = state.recording, state.recording.status(state.run)
        assert status.active == bool(recording.env_idx) and status.saving.failed in (False, True)
        for effect in effects:
            match effect:
                case TakeStep():
                    assert before.recording.env_idx and event is effect.stepped
                case BeginEpisodes():
                    assert isinstance(event, Asked | RecordingWanted | LoadDone)
                    assert (effect.number, effect.env_idx) == (recording.number, recording.env_idx)
                case BeginSaving():
                    assert isinstance(event, Asked | SaveWanted) and effect.what.episodes
                    assert status.saving.progress is not None
                case BeginRescoring():
                    assert isinstance(event, VersionLoaded) and effect.past is state.rescoring.past
        if before.recording.env_idx and not recording.env_idx:
            assert EndEpisodes() in effects


def test_envs_that_a_smaller_version_lacks_are_no_longer_recorded() -> None:
    all_envs = Asked(ChooseRecordedEnvs(envs="all")), Asked(ToggleRecording())
    state, effects = after(loaded(), *all_envs, RESET, loaded("rebuilt", "b", envs=2), LoadDone())
    assert state.recording.env_idx == (0, 1) and Then(EnvsReset((0, 1))) in effects
    last = RecordingWanted((2,))
    state, effects = after(loaded(), last, RESET, loaded("rebuilt", "b", envs=2), LoadDone())
    assert not state.recording.env_idx and effects == []


def test_only_a_worker_that_was_handed_over_is_recorded_again() -> None:
    for end in End:
        died = WorkerDied(replace(DEATH, end=end), "")
        state, _ = after(loaded(), RESET, Asked(ToggleRecording()), died, loaded(), LoadDone())
        assert bool(state.recording.env_idx) == (end is End.HANDED_OVER)


def test_envs_are_reset_after_their_capture_was_requested() -> None:
    state, effects = after(loaded(), Asked(ChooseRecordedEnvs(envs="all")), Asked(ToggleRecording()))
    assert effects[1:] == [Send(SetCapture((0, 1, 2), from_reset=True)), Then(EnvsReset())]
    _, effects = apply_filtered(state, EnvsReset())
    assert effects == [Send(Reset(None, state.run.seed))]


def test_steps_that_wait_for_the_disk_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(of_recording, "MAX_PENDING_BYTES", 1)
    state, effects = after(loaded(), Asked(ToggleRecording()), RESET)
    assert (
        effects == [EndEpisodes(), Send(SetCapture(()))]
        and state.recording.problem
        and not state.recording.env_idx
    )


def test_late_events_of_an_older_recording_or_job_change_only_the_waiting_bytes() -> None:
    state, _ = after(loaded(), RESET, STEP, Asked(ToggleRecording()), Asked(RecordNextEpisode()))
    assert state.recording.number == 2
    changed, effects = apply_filtered(state, StepRecorded(1, 10, (), RunningEpisodes(1, 1, 1), "it failed"))
    assert effects == [] and changed.recording == replace(state.recording, waiting_bytes=-10)
    state, _ = after(loaded(), RESET, STEP, SaveWanted((0,)), SaveFailed(1, "it failed"), SaveWanted((1,)))
    late = RescoringUpdate(1, RescoreView("done"))
    for event in (EpisodesSaved(1, "saved"), SaveFailed(1, "it failed"), late):
        assert apply_filtered(state, event) == (state, [])
    state, _ = apply_filtered(state, EpisodesSaved(2, "saved"))
    assert state.recording.status(state.run).saving.message == "saved"


def test_episodes_are_saved_once_they_are_solved_and_one_job_at_a_time() -> None:
    state, _ = after(loaded(), RESET, STEP)
    with pytest.raises(Refused):
        apply_filtered(state, Asked(SaveSolved()))
    solved = Solving(episodes={env: RunningEpisode(solved_at=1) for env in (0, 2)})
    state, (begin,) = apply_filtered(replace(state, solving=solved), Asked(SaveSolved()))
    assert isinstance(begin, BeginSaving) and [one.env for one in begin.what.episodes] == [0, 2]
    with pytest.raises(Refused):
        apply_filtered(state, Asked(SaveSolved()))


def test_kept_episodes_are_saved_one_after_another_and_a_stop_counts_those_that_are_lost() -> None:
    success = moment(np.full(ENVS, 1, np.int32), success=(1,), number=1)
    state, _ = after(loaded(), RESET, success)
    begun: list[int] = []

    def tell(event: SessionEvent) -> KeptEpisodes:
        nonlocal state
        state, effects = apply_filtered(state, event)
        begun.extend(effect.what.episodes[0].env for effect in effects if isinstance(effect, BeginSaving))
        return state.recording.status(state.run).kept

    for env in range(ENVS):
        what = request_of(state.run, (env,), kept=True)
        assert isinstance(what, SaveRequest)
        tell(EpisodesKept(what))
    assert tell(SaveWanted((0,))).waiting == ENVS and begun == [0], "a save in between waits"
    assert tell(SaveFailed(1, "full")) == KeptEpisodes(0, 0, 2, 1, "full")
    assert tell(EpisodesSaved(2, "saved")) == KeptEpisodes(1, 1, 1, 1, "full")
    assert begun == [0, 1, 2]
    stopped = tell(Asked(ToggleSavePast()))
    assert (stopped.saved, stopped.waiting, stopped.failed) == (1, 0, 2) and "1 kept episode" in stopped.why
    assert tell(EpisodesSaved(3, "late")) == stopped and begun == [0, 1, 2]


def test_a_rescoring_stopped_by_a_save_restarts_if_the_version_stays_the_same() -> None:
    begun = loaded(), RESET, STEP, loaded("patched", "b")
    state, effects = after(*begun)
    assert any(isinstance(effect, BeginRescoring) for effect in effects)
    assert (state.rescoring.view.state, state.rescoring.view.total) == ("loading", 1)
    state, effects = after(*begun, FileSaved())
    assert effects[0] == EndRescoring() and state.rescoring.view.stopped_by is StoppedBy.SAVE
    state, effects = after(*begun, FileSaved(), loaded("same", "b"))
    assert state.rescoring.view.state == "loading" and isinstance(effects[0], BeginRescoring)
    state, effects = after(*begun, loaded("rebuilt", "c"))
    assert state.rescoring.view.state == "none" and effects[0] == EndRescoring()
    state, _ = after(*begun, Asked(StopRescoring()))
    assert state.rescoring.view.stopped_by is StoppedBy.USER
    with pytest.raises(Refused):
        apply_filtered(state, Asked(StopRescoring()))


def test_an_episode_saved_from_the_past_does_not_count_as_recorded() -> None:
    state, _ = after(loaded(), Asked(ToggleRecording()), EpisodeEnded(live=True), EpisodeEnded(live=False))
    assert (state.recording.episodes, state.recording.being_written) == (1, 2)


def test_a_recording_ends_env_by_env_and_is_saved_once_its_files_are_written() -> None:
    state, effects = after(loaded(), RESET, RecordingWanted(next_episode=True))
    number = state.recording.number
    assert [type(one) for one in effects] == [BeginEpisodes, Send], "no env is reset"
    assert effects[0].one_each and effects[1] == Send(SetCapture((0, 1, 2), from_reset=True))  # type: ignore[union-attr]

    def tell(event: SessionEvent) -> list[Effect]:
        nonlocal state
        state, effects = apply_filtered(state, event)
        return effects

    def shown() -> RecordingStatus:
        return state.recording.status(state.run)

    assert (shown().active, shown().waiting, shown().since, shown().saved) == (True, 3, NOW.wall, None)
    tell(stepped(0, (0, 2)))
    assert tell(StepRecorded(number, 5, (0, 1, 2), RunningEpisodes(2, 7, 300))) == []
    assert (shown().waiting, shown().steps, shown().bytes_written) == (1, 7, 300)
    assert tell(StepRecorded(number, 0, (2, 1), RunningEpisodes(1, 4, 200))) == [
        Send(SetCapture((1, 2), from_reset=True))
    ]
    assert (shown().env_idx, shown().waiting, shown().steps) == ((1, 2), 1, 4)
    tell(EpisodeEnded(live=True))
    tell(EpisodeWritten(Finished(1, 1000, None, None)))
    assert (shown().episodes, shown().being_written, shown().episodes_written) == (1, 0, 1)
    assert shown().bytes_written == 1200 and shown().saved is None
    assert tell(StepRecorded(number, 0, (), RunningEpisodes())) == [
        Send(SetCapture((), from_reset=True)),
        EndEpisodes(),
    ]
    tell(EpisodeEnded(live=True))
    tell(EpisodesEnded(number - 1))
    assert not state.recording.ended and not shown().active
    tell(EpisodesEnded(number))
    assert shown().saved is None, "its last file is being written"
    tell(EpisodeWritten(Finished(2, 2000)))
    assert (shown().saved, shown().waiting, shown().bytes_written) == (2, 0, 2000)
    tell(Asked(ToggleRecording()))
    assert (shown().saved, shown().episodes, shown().env_idx) == (None, 0, (0,)), "the chosen env"
    begun = state.recording.number
    tell(Asked(StopRecording()))
    tell(EpisodesEnded(begun))
    assert shown().saved == 0, "the files of the recording before do not count"
    tell(Asked(ChooseRecordedEnvs(envs="all")))
    assert tell(Asked(RecordNextEpisode()))[0] == BeginEpisodes(begun + 1, state.run.task, (0, 1, 2), True)  # type: ignore[arg-type]
    assert tell(StepRecorded(begun + 1, 0, (0, 1, 2), RunningEpisodes(), "the disk is full")) == [
        EndEpisodes(),
        Send(SetCapture(())),
    ]
    assert shown().problem == "the disk is full" and not shown().active
    tell(EpisodesRecovered(("a.rrd",), None))
    assert shown().recovered == ("a.rrd",) and shown().problem == "the disk is full"
    tell(Asked(RecordNextEpisode()))
    assert shown().problem is None


@pytest.mark.parametrize("one_each", [False, True])
@pytest.mark.parametrize(
    ("level", "carried", "put_back"),
    [
        ("patched", (), True),
        ("rebuilt", (), False),
        ("rebuilt", ("cube",), True),
        ("restarted", (), False),
    ],
)
def test_after_a_load_the_envs_are_reset_only_if_they_lost_their_place(
    level: str, carried: tuple[str, ...], put_back: bool, one_each: bool
) -> None:
    begun = loaded(), RESET, RecordingWanted((0, 2), next_episode=one_each), RESET, STEP
    state, effects = after(*begun, loaded(level, "b", carried=carried))
    assert EndEpisodes() in effects and not state.recording.env_idx and not state.recording.ended
    ended, _ = apply_filtered(state, EpisodesEnded(state.recording.number))
    assert not ended.recording.ended, "it goes on"
    state, effects = apply_filtered(state, LoadDone())
    begin, capture, *_ = effects
    assert isinstance(begin, BeginEpisodes) and begin.task.source_hash == "b"
    assert capture == Send(SetCapture((0, 2), from_reset=True)), "a reset would lose the current moment"
    assert begin.env_idx == (0, 2) == state.recording.env_idx and begin.one_each == one_each
    assert state.recording.since == NOW.wall
    assert (Then(EnvsReset((0, 2))) in effects) == (not put_back and not one_each)
    again, effects = apply_filtered(state, LoadDone())
    assert again.recording == state.recording


def test_a_load_without_a_change_does_not_end_a_recording() -> None:
    state, effects = after(loaded(), RESET, Asked(ToggleRecording()), RESET, loaded("same"), LoadDone())
    assert state.recording.env_idx == (0,) and effects == []


def test_what_is_not_saved_yet_is_counted_and_a_failure_stays_named() -> None:
    """The text is asked for when the server ends."""
    success = moment(np.full(ENVS, 1, np.int32), success=(1,), number=1)
    state, _ = after(loaded(), RESET, success, SaveWanted(None))
    saving = state.recording.saving
    assert saving.unsaved == ENVS and str(ENVS) in saving.text
    state, _ = apply_filtered(state, SaveProgressed(1, JobProgress("drawing", 4, 9)))
    assert "drawing" in state.recording.saving.text and "4" in state.recording.saving.text
    stale, _ = apply_filtered(state, SaveProgressed(7, JobProgress("late", 1, 1)))
    assert stale.recording.saving == state.recording.saving
    assert saving.running is not None
    for name in ("ended", "succeeded"):
        assert [getattr(one, name) for one in saving.running.episodes] == [False, True, False]
    state, _ = apply_filtered(state, SaveWanted((2,)))
    assert state.recording.saving.unsaved == ENVS + 1
    state, (begin,) = apply_filtered(state, SaveFailed(1, "the disk is full"))
    assert isinstance(begin, BeginSaving) and [one.env for one in begin.what.episodes] == [2]
    status = state.recording.status(state.run).saving
    assert (status.failed, status.message) == (True, "the disk is full") and status.progress is not None
    state, _ = apply_filtered(state, EpisodesSaved(2, "saved"))
    status = state.recording.status(state.run).saving
    assert (status.failed, status.message, status.progress) == (False, "saved", None)
    assert not state.recording.saving.text
    same, _ = apply_filtered(state, loaded("same"))
    assert same.recording.saving.status.message == "saved"
    other, _ = apply_filtered(state, loaded("patched", "b"))
    assert not other.recording.saving.status.message
    state, (begin,) = apply_filtered(state, SaveWanted((0,)))
    assert isinstance(begin, BeginSaving) and not state.recording.saving.status.message
    state, _ = apply_filtered(state, SaveWanted((1,)))
    state, effects = apply_filtered(state, Asked(ToggleSavePast()))
    assert effects == [EndSaving()] and state.recording.saving.status.message
    assert state.recording.saving.status.progress is None and not state.recording.saving.requests


def test_every_command_of_these_features_is_handled() -> None:
    taken = of_recording.DOES | of_rescoring.DOES
    assert {type(command) for command in COMMANDS} == taken

"""The state of the review after events and commands, with recordings that differ in length and events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.drive.episodes import made
from tests.review.recordings import after, recording, three, with_opened
from workbench.episodes.episode import BrokenFile
from workbench.live import timeline_commands as timeline
from workbench.live.commands import TogglePlay
from workbench.live.effects import Asked
from workbench.page.command import Command, Refused
from workbench.review import commands as review
from workbench.review.panel import unaligned_text
from workbench.review.state import (
    FIRST_SHOWN_SECONDS,
    MAX_OPEN,
    BeginReading,
    CheckFiles,
    FilesChecked,
    FileStamp,
    Listed,
    Open,
    OpenFirst,
    ProblemFound,
    ReadingEnded,
    RecordingNotRead,
    RecordingRead,
    ReviewState,
    SceneUpdate,
    advanced,
    apply,
    next_position_in,
)


def positions(state: ReviewState, command: Command, times: int, now: float = 0.0) -> list[int]:
    """The position after each of so many times."""
    found = []
    for _ in range(times):
        state = after(state, command, now=now)
        found.append(state.view.position)
    return found


SUCCESS = review.AlignRecordings(at="first success")


def test_when_aligned_all_show_the_event_and_one_without_it_its_start() -> None:
    state = after(three(), timeline.Seek(step=5), SUCCESS)
    view = state.view
    assert (view.anchors, view.first, view.last) == ((4, 7, 0), -7, 6)
    assert view.position == 1, "the selected recording stays at its state"
    assert view.states == (5, 8, 1)
    assert "C" in unaligned_text(view) and "A" not in unaligned_text(view) and "B" not in unaligned_text(view)
    assert not unaligned_text(three().view)
    of_b = after(three(), review.SelectRecording(id="b"), timeline.Seek(step=5), SUCCESS).view
    assert of_b.position == -2 and of_b.states[1] == 5
    back = after(state, review.AlignRecordings(at="start")).view
    assert (back.anchors, back.first, back.last, back.position) == ((0, 0, 0), 0, 12, 5)
    with pytest.raises(Refused):
        after(state, review.AlignRecordings(at="first fail"))


def test_events_of_all_recordings_are_visited_in_both_directions() -> None:
    state = after(three(), SUCCESS, timeline.GoToFirst())
    assert positions(state, timeline.NextEvent(), 5) == [-4, 0, 6, 6, 6]
    state = after(state, timeline.GoToLast())
    assert positions(state, timeline.PreviousEvent(), 4) == [0, -4, -7, -7]
    many = with_opened(*(recording(str(at), 10, at + 1, at) for at in range(5)))
    many = after(many, review.SelectRecording(id="3"))
    assert positions(many, timeline.NextEvent(), 3) == [4, 10, 10], "only those of the selected one"
    assert positions(ReviewState(), timeline.NextEvent(), 1) == [0]


def test_recordings_are_selected_in_turn_and_the_position_stays() -> None:
    state, found = after(three(), timeline.Seek(step=3)), []
    for command in [review.NextRecording()] * 4 + [review.PreviousRecording()] * 3:
        state = after(state, command)
        found.append(state.view.selected)
    assert found == [1, 2, 0, 1, 0, 2, 1] and state.view.position == 3
    assert after(state, review.SelectRecording(id="c")).view.selected == 2
    assert after(ReviewState(), review.NextRecording(), review.PreviousRecording()).view.selected == 0
    for command in (
        review.SelectRecording(id="x"),
        review.CloseRecording(id="x"),
        review.SwapWithFirst(index=3),
    ):
        with pytest.raises(Refused):
            after(state, command)


@pytest.mark.parametrize(
    ("selected", "closed", "left"),
    [("a", "b", "a"), ("b", "a", "b"), ("b", "b", "c"), ("c", "c", "b"), ("c", "a", "c")],
)
def test_closing_a_recording_keeps_the_selected_one(selected: str, closed: str, left: str) -> None:
    state = after(three(), SUCCESS, review.SelectRecording(id=selected), review.CloseRecording(id=closed))
    assert state.view.chosen is not None and state.view.chosen.id == left
    assert state.view.align == "first success"
    assert [one.id for one in state.view.opened] == [one for one in "abc" if one != closed]
    assert state.view.opened_serial > three().view.opened_serial


def test_a_swap_keeps_the_selected_recording_the_position_and_the_alignment() -> None:
    state = after(three(), SUCCESS, timeline.Seek(step=-2), review.SelectRecording(id="b"))
    view = after(state, review.SwapWithFirst(index=1)).view
    assert [one.id for one in view.opened] == ["b", "a", "c"] and view.chosen is view.opened[0]
    assert (view.anchors, view.position, view.align) == ((7, 4, 0), -2, "first success")
    loading = replace(state, view=replace(state.view, loading="opening d"))
    with pytest.raises(Refused):
        after(loading, review.SwapWithFirst(index=1))


def test_playback_shows_each_state_for_its_time_and_ends_or_begins_again() -> None:
    state = with_opened(recording("a", 3))
    assert next_position_in(state, 5.0) > 60, "it does not play"
    state = after(state, review.ChoosePlaybackSpeed(speed=2.0), TogglePlay(), now=10.0)  # 40 states a second
    assert state.view.playing
    for elapsed, position, wait in ((0.0, 0, 0.025), (0.01, 0, 0.015), (0.03, 1, 0.02), (0.099, 3, 0.001)):
        shown = advanced(state, 10 + elapsed).view
        assert (shown.position, shown.playing) == (position, True)
        assert next_position_in(state, 10 + elapsed) == pytest.approx(wait, abs=1e-6)
    ended = advanced(state, 10.11)
    assert (ended.view.position, ended.view.playing) == (3, False)
    assert after(ended, TogglePlay(), now=11.0).view.position == 0, "it begins again"
    loop = after(state, review.LoopPlayback(on=True), now=10.0)
    again = advanced(advanced(loop, 10.099), 10.11)
    assert (again.view.position, again.view.playing) == (0, True)
    assert advanced(again, 10.11 + 0.06).view.position == 2
    assert after(loop, review.LoopPlayback(on=False), now=10.0).view.loop is False
    moved = after(state, timeline.Seek(step=1), now=10.05)
    assert moved.view.playing and advanced(moved, 10.05 + 0.03).view.position == 2
    slower = after(state, review.ChoosePlaybackSpeed(speed=0.5), now=10.03)
    assert advanced(slower, 10.03 + 0.11).view.position == 2
    for command, position in (
        (timeline.StepForward(), 2),
        (timeline.StepBack(), 0),
        (timeline.GoToLast(), 3),
        (timeline.PreviousEvent(), 0),
        (TogglePlay(), 1),
    ):
        paused = after(state, command, now=10.03).view
        assert (paused.position, paused.playing) == (position, False), command
    assert after(state, timeline.GoToFirst(), now=10.03).view.playing
    assert not after(with_opened(recording("a", 0)), TogglePlay()).view.playing


# --- opening --------------------------------------------------------------------------------------------


def row(name: str, minute: int | None = 0, **more: Any) -> Any:
    date = None if minute is None else datetime(2024, 1, 1, 0, minute, tzinfo=timezone.utc)
    written = 0.0 if date is None else date.timestamp()
    paths = (Path(f"{name}.json"),)
    return SimpleNamespace(
        **{
            "id": name,
            "name": f"file {name}",
            "date": date,
            "written": written,
            "problem": None,
            "paths": paths,
            **more,
        }
    )


def listed(rows: Sequence[Any], reading: str | None = None) -> Listed:
    return Listed(SimpleNamespace(rows=tuple(rows), reading=reading))  # type: ignore[arg-type]


def opening(state: ReviewState, event: Any, now: float = 0.0) -> tuple[ReviewState, BeginReading | None]:
    state, effects = apply(state, event, now)
    begun = [effect for effect in effects if isinstance(effect, BeginReading)]
    return state, begun[0] if begun else None


def test_recordings_are_read_oldest_first_and_those_that_are_gone_are_named() -> None:
    state, _ = apply(ReviewState(), listed([row("new", 5), row("old", 1), row("undated", None)]), 0.0)
    state, begun = opening(state, Open(("undated", "new", "gone", "old", "new"), library_stays=True))
    assert begun is not None and [one.id for one in begun.rows] == ["old", "new", "undated"]
    assert len(state.view.problems) == 1 and state.view.library_stays
    assert "file old" in state.view.loading and "3" in state.view.loading
    state, _ = apply(state, RecordingRead(begun.opening, recording("old", 3), {}), 0.0)
    assert "file new" in state.view.loading
    state, one = opening(state, Open(("new",)))
    assert one is not None and one.opening > begun.opening and not state.view.problems
    assert "file new" in state.view.loading and "1" not in state.view.loading and not state.view.library_stays
    late, _ = apply(state, RecordingRead(begun.opening, recording("new", 3), {}), 0.0)
    assert late == state, "a result of the opening before"
    many, _ = apply(ReviewState(), listed([row(str(at), at % 60) for at in range(MAX_OPEN + 2)]), 0.0)
    many, begun = opening(many, Open(tuple(str(at) for at in range(MAX_OPEN + 2))))
    assert begun is not None and len(begun.rows) == MAX_OPEN and str(MAX_OPEN) in many.view.problems[0]


def test_the_first_recordings_are_shown_while_others_are_read_and_nothing_moves_when_they_come() -> None:
    names = ("a", "b", "c", "d")
    state, _ = apply(ReviewState(), listed([row(name, at) for at, name in enumerate(names)]), 0.0)
    state, begun = opening(state, Open(names, state=2))
    assert begun is not None
    files = {Path("a.json"): FileStamp("a", (1, 1))}
    recordings = {name: recording(name, 8, minute=at) for at, name in enumerate(names)}
    shown = []
    for name, now in (("b", 0.1), ("a", FIRST_SHOWN_SECONDS), ("c", 2.9 * FIRST_SHOWN_SECONDS)):
        state, _ = apply(state, RecordingRead(begun.opening, recordings[name], files), now)
        shown.append([one.id for one in state.view.opened])
    assert shown == [[], ["b", "a"], ["b", "a"]], "the pause doubles"
    assert state.view.position == 2 and state.files == files
    slowly = review.ChoosePlaybackSpeed(speed=0.1)
    state = after(state, review.CloseRecording(id="b"), timeline.Seek(step=5), slowly, TogglePlay(), now=1.3)
    assert [one.id for one in state.view.opened] == ["a"]
    state, _ = apply(state, RecordingNotRead(begun.opening, "d", "d is broken"), 1.4)
    state, _ = apply(state, ReadingEnded(begun.opening, "too much memory"), 1.5)
    view = state.view
    assert [one.id for one in view.opened] == ["a", "c"], "in the order of time, without the closed one"
    assert (view.position, view.loading, view.not_opened) == (5, "", ("d",)) and view.chosen is view.opened[0]
    assert view.playing
    assert view.problems == ("d is broken", "too much memory") == state.problems
    state, again = opening(state, Asked(review.OpenAgain()))
    assert again is not None and [one.id for one in again.rows] == ["a", "c", "d"]
    assert not state.view.not_opened and not state.view.problems
    broken = replace(recordings["a"].episode, broken_files=(BrokenFile("a.h5", "is gone"),))
    state, _ = apply(state, RecordingRead(again.opening, replace(recordings["a"], episode=broken), {}), 2.0)
    assert any("a.h5" in problem for problem in state.view.problems)


def test_recordings_that_are_closed_while_others_are_read_stay_closed() -> None:
    state, _ = apply(ReviewState(), listed([row(name, at) for at, name in enumerate("abc")]), 0.0)
    state, begun = opening(state, Open(("a", "b", "c")))
    assert begun is not None
    for at, name in enumerate("ab"):
        state, _ = apply(state, RecordingRead(begun.opening, recording(name, 8, minute=at), {}), at * 1.0)
    state = after(state, review.CloseRecording(id="a"), review.CloseRecording(id="b"), now=1.1)
    assert state.view.chosen is None
    state, _ = apply(state, RecordingRead(begun.opening, recording("c", 8, minute=2), {}), 1.2)
    state, _ = apply(state, ReadingEnded(begun.opening), 1.3)
    assert [one.id for one in state.view.opened] == ["c"]


def test_the_first_recording_is_opened_once_it_is_listed_and_readable() -> None:
    state, begun = opening(ReviewState(), OpenFirst("newest"))
    assert begun is None
    rows = [row("old", 1), row("bad", 9, problem="no"), row("new", 5)]
    state, begun = opening(state, listed(rows, reading="12 of 20"))
    assert begun is None, "the list is not complete"
    state, begun = opening(state, listed(rows))
    assert begun is not None and [one.id for one in begun.rows] == ["new"] and state.view.library_stays
    _, begun = opening(state, listed(rows))
    assert begun is None
    state, _ = opening(ReviewState(), OpenFirst("newest"))
    for rows, wanted in (
        ([row("a")], None),
        ([row("a"), row("b", problem="no")], None),
        ([row("a"), row("b")], "b"),
    ):
        later, _ = opening(state, OpenFirst(Path("elsewhere/b.json")))
        _, begun = opening(later, listed(rows, reading="1 of 2"))
        assert (None if begun is None else begun.rows[0].id) == wanted
    bad, begun = opening(state, listed([row("bad", problem="no")]))
    assert begun is None and bad.first is None
    state, _ = apply(state, listed([row("a")], reading="1 of 2"), 0.0)
    state, _ = opening(state, Open(("a",)))
    state, begun = opening(state, listed([row("a"), row("new", 5)]))
    assert begun is None, "a person has opened another one"


def test_a_check_of_files_is_of_the_open_files_and_of_the_selected_task() -> None:
    state = three()
    assert state.view.chosen is not None
    info = state.view.chosen.episode.info
    checked = FilesChecked(state.files, ("a.json was deleted.",), info, "reward")
    for _ in range(2):
        state, _ = apply(state, checked, 0.0)
        assert state.view.problems == ("a.json was deleted.",) and state.view.changed_symbols == "reward"
    other, _ = apply(three(), replace(checked, files=dict(state.files), task_of=made(1).info), 0.0)
    assert not other.view.problems and not other.view.changed_symbols
    loading = replace(three(), view=replace(three().view, loading="opening"))
    assert not apply(loading, replace(checked, files=loading.files), 0.0)[0].view.problems
    state, effects = apply(state, Asked(review.NextRecording()), 0.0)
    assert effects == [CheckFiles()] and not state.view.changed_symbols, "it is about the other recording"
    state, effects = apply(state, Asked(timeline.StepForward()), 0.0)
    assert not effects
    state, _ = apply(state, ProblemFound("no disk"), 0.0)
    assert state.view.problems[-1] == "no disk"


def test_a_scene_belongs_to_its_recording_and_counts_once() -> None:
    state = three()
    bare = replace(state.view.opened[1].episode, geometry=None, poses=None)
    whole = state.view.opened[1]
    state = with_opened(state.view.opened[0], replace(whole, episode=bare), state.view.opened[2])
    serials = [state.view.opened_serial]
    for update in (
        SceneUpdate(0, "b", "made next", making=True),
        SceneUpdate(0, "x", "of a closed one"),
        SceneUpdate(0, "b", "", episode=whole.episode),
        SceneUpdate(0, "b", "not restored: cube"),
    ):
        state, _ = apply(state, update, 0.0)
        serials.append(state.view.opened_serial)
        of = {one.id: (one.scene, one.making) for one in state.view.opened}
        assert of["a"] == of["c"] == ("", False)
        if update.id == "b":
            assert of["b"] == (update.scene, update.making)
    assert serials == [serials[0]] * 3 + [serials[0] + 1] * 2
    assert state.view.opened[1].has_scene and state.view.opened[1].episode is whole.episode

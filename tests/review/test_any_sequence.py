"""Any sequence of commands and reading events gives states of a review that can be drawn and are reproducible."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.episodes import made
from workbench.app.review_page import ReviewTimeline, fixed_values
from workbench.episodes.row import LibraryRow
from workbench.library.folder import LibraryView
from workbench.live.commands import Step, TogglePlay
from workbench.live.effects import Asked
from workbench.live.timeline_commands import (
    GoToFirst,
    GoToLast,
    NextEvent,
    PreviousEvent,
    Seek,
    StepBack,
    StepForward,
)
from workbench.page.command import Command, Refused
from workbench.review.commands import (
    AlignRecordings,
    ChoosePlaybackSpeed,
    CloseRecording,
    LoopPlayback,
    NextRecording,
    OpenAgain,
    PreviousRecording,
    SelectRecording,
    SwapWithFirst,
)
from workbench.review.compare_panel import ReviewComparePanel
from workbench.review.curves_panel import ReviewCurves, ReviewNumbers
from workbench.review.panel import ReviewPanel
from workbench.review.scene_view import caption, review_scene
from workbench.review.state import (
    FilesChecked,
    FileStamp,
    Listed,
    Open,
    OpenFirst,
    ProblemFound,
    ReadingEnded,
    RecordingNotRead,
    RecordingRead,
    ReviewEvent,
    ReviewState,
    SceneUpdate,
    apply,
)
from workbench.review.view import Opened, ReviewView, find_events

EPISODES = {
    "a": made(10, success_from=7),
    "b": made(6, success_from=2, control_dt=0.1),
    "c": made(1),
    "d": made(4),
    "e": made(12, success_from=0),
}
WITHOUT_SCENE = {id: replace(one, geometry=None, poses=None) for id, one in EPISODES.items()}
ROWS = {
    id: LibraryRow(
        kind="workbench",
        id=id,
        name=f"{id}.rrd",
        place=(id, 0),
        paths=(Path(f"{id}.rrd"),),
        size=1,
        written=float(number),
        problem="cut off" if id == "d" else None,
    )
    for number, id in enumerate(EPISODES)
}
Happens = Callable[[ReviewState], ReviewEvent]
"""Makes an event for a given state."""


def read(id: str, late: int, scene: bool) -> Happens:
    episode = (EPISODES if scene else WITHOUT_SCENE)[id]
    opened = Opened(id, f"{id}.rrd", episode, find_events(episode))
    files = {Path(f"{id}.rrd"): FileStamp(id, (1, 1))}
    return lambda state: RecordingRead(state.opening.number - late, opened, files)


def scene(id: str, late: int, there: bool) -> Happens:
    episode = EPISODES[id] if there else None
    return lambda state: SceneUpdate(state.opening.number - late, id, "made", not there, episode)


def read_next(late: int, scene: bool) -> Happens:
    """The event that the next row of an opening was read."""

    def event(state: ReviewState) -> ReviewEvent:
        rows = state.opening.rows[state.opening.done :]
        return read(rows[0].id, late, scene)(state) if rows else ReadingEnded(state.opening.number - late)

    return event


ids, late = st.sampled_from(list(EPISODES)), st.sampled_from([0, 0, 0, 1])
commands: st.SearchStrategy[Command] = st.one_of(
    st.just(TogglePlay()),
    st.sampled_from([StepBack(), StepForward(), PreviousEvent(), NextEvent(), GoToFirst(), GoToLast()]),
    st.sampled_from([NextRecording(), PreviousRecording(), OpenAgain(), Step()]),
    st.builds(Seek, step=st.integers(-20, 20)),
    st.builds(SelectRecording, id=ids),
    st.builds(CloseRecording, id=ids),
    st.builds(SwapWithFirst, index=st.integers(1, 4)),
    st.builds(ChoosePlaybackSpeed, speed=st.floats(0.01, 900)),
    st.builds(LoopPlayback, on=st.booleans()),
    st.builds(AlignRecordings, at=st.sampled_from(["start", "first success", "first kiss"])),
)
happenings: st.SearchStrategy[Happens] = st.one_of(
    *[st.builds(lambda command: lambda state: Asked(command), commands)] * 4,
    st.builds(lambda ids, at: lambda state: Open(tuple(ids), at), st.lists(ids), st.integers(0, 9)),
    st.builds(read_next, late, st.booleans()),
    st.builds(read, ids, late, st.booleans()),
    st.builds(
        lambda id, late: lambda state: RecordingNotRead(state.opening.number - late, id, f"{id} is cut off."),
        ids,
        late,
    ),
    st.builds(lambda late: lambda state: ReadingEnded(state.opening.number - late), late),
    st.builds(scene, ids, late, st.booleans()),
    st.builds(
        lambda found: lambda state: FilesChecked(state.files, tuple(found)),
        st.lists(ids, max_size=2),
    ),
    st.builds(
        lambda ids: lambda state: Listed(LibraryView(1, tuple(ROWS[id] for id in ids))),
        st.lists(ids, unique=True),
    ),
    st.builds(lambda what: lambda state: OpenFirst(what), st.sampled_from([Path("b.rrd"), "newest"])),
    st.just(lambda state: ProblemFound("The disk is full.")),
)
opened: list[Happens] = [lambda state: Open(("a", "b", "e")), *[read_next(0, True)] * 4]
several = st.tuples(st.sampled_from([[], opened]), st.lists(happenings, min_size=5, max_size=30)).map(
    lambda two: two[0] + two[1]
)
sequences = several.flatmap(
    lambda some: st.lists(st.floats(0, 0.5), min_size=len(some), max_size=len(some)).map(
        lambda seconds: list(zip(some, seconds, strict=True))
    )
)
ALL_LISTED = apply(ReviewState(), Listed(LibraryView(1, tuple(ROWS.values()))), 0.0)[0]


def states_after(happened: list[tuple[Happens, float]]) -> list[ReviewState]:
    states, now = [ALL_LISTED], 0.0
    for event_in, seconds in happened:
        now += seconds
        event = event_in(states[-1])
        try:
            states.append(apply(states[-1], event, now)[0])
        except Refused as reason:
            assert str(reason)
    return states


def plain(state: ReviewState) -> object:
    """A comparable form of a state: two `Opened` are never equal."""
    opened = [(one.id, id(one.episode), one.scene, one.making) for one in state.view.opened]
    read = [one.id for one in state.opening.read]
    without = replace(state, view=replace(state.view, opened=()), opening=replace(state.opening, read=()))
    return opened, read, without


@pytest.fixture(scope="module")
def draw() -> Iterator[Callable[[ReviewView], None]]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    none = cast(Any, None)
    panel = ReviewPanel(server, none, lambda id, state: None, lambda: "")
    compare, timeline = ReviewComparePanel(server, none), ReviewTimeline(server, none)
    parts = panel, compare, timeline, ReviewNumbers(server), ReviewCurves(server)

    def draw(view: ReviewView) -> None:
        for part in parts:
            part.draw(view)
        for ghosts in (False, True):
            if (scene := review_scene(view.opened, ghosts)) is not None:
                assert len(scene.poses(view.states)) == len(view.opened)
        assert [caption(view, index)[0] for index in range(len(view.opened))] == [*"ABCDEFGHIJ"][
            : len(view.opened)
        ]

    yield draw
    server.stop()


@given(sequences)
def test_any_sequence_gives_drawable_and_reproducible_states(
    draw: Callable[[ReviewView], None], happened: list[tuple[Happens, float]]
) -> None:
    states = states_after(happened)
    for state in states:
        view = state.view
        assert view.first <= view.position <= view.last
        assert view.align in view.alignments and len(view.anchors) == len(view.opened)
        assert view.chosen is None or view.chosen.id in EPISODES
        assert not view.playing or view.last > view.first
    draw(states[-1].view)
    assert [plain(state) for state in states] == [plain(state) for state in states_after(happened)]


@pytest.mark.parametrize(("mode", "drawn"), [("dense", True), ("none", False)])
def test_only_a_task_with_a_reward_has_a_line_on_the_strip(mode: str, drawn: bool) -> None:
    episode = made(10, env_kwargs={"reward_mode": mode})
    opened = Opened("a", "a.rrd", episode, find_events(episode))
    files = {Path("a.rrd"): FileStamp("a", (1, 1))}
    happened: list[Happens] = [
        lambda state: Open(("a",)),
        lambda state: RecordingRead(state.opening.number, opened, files),
        read_next(0, False),
    ]
    view = states_after([(event, 0.0) for event in happened])[-1].view
    assert bool(fixed_values(view)["lines"]) is drawn

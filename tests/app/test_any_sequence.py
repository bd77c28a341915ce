"""Any commands and worker events in any order: the state can be drawn, and a page that opens later shows the same."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drive.live import Live
from tests.drive.panels import Clock
from tests.drive.session import BASE, FakeWorkerSession, fake_worker_session, seek_by
from workbench.cameras.commands import UndoCamera
from workbench.cameras.events import CameraPlaced
from workbench.cameras.view import StudioView
from workbench.live.commands import PauseRun, PlayRun, ReloadFile, SetSeed, Step
from workbench.live.events import MomentShown
from workbench.live.messages import CameraRequest, Loading, Status, TaskFailed
from workbench.live.panels.env_panel import TABLE
from workbench.live.timeline_commands import ContinueFromHere, UndoReset
from workbench.live.view import SessionView
from workbench.page.command import Refused
from workbench.page.commands import TellUnfolded
from workbench.record.state import RecordingStatus
from workbench.task.problem import Problem

PROBLEM = Problem("step", "KeyError: 'goal'", "push.py", 7, None, "Traceback")
Act = Callable[[FakeWorkerSession], object]


def act(name: str, do: Act) -> st.SearchStrategy[tuple[str, Act]]:
    return st.just((name, do))


def fails(kept: bool, at_run: bool) -> Act:
    return lambda fake: fake.tell(TaskFailed(PROBLEM, kept=kept, at_run=at_run))


def places(fake: FakeWorkerSession) -> None:
    """Move a camera, if there is one that can be moved."""
    camera = fake.view.of(StudioView).camera(BASE)
    if camera is not None and camera.now is not None:
        x, y, z = camera.now.position
        fake.session.dispatch(CameraPlaced(BASE, replace(camera.now, position=(x + 0.1, y, z))))


def undoes(fake: FakeWorkerSession) -> None:
    with suppress(Refused):
        fake.session.do(UndoCamera())


EVENTS = st.one_of(
    st.sampled_from(["same", "patched", "cameras", "rebuilt", "restarted"]).map(
        lambda level: (f"loaded {level}", lambda fake: fake.load(level))
    ),
    st.integers(1, 4).map(lambda count: (f"{count} steps", lambda fake: fake.step(count))),
    st.lists(st.integers(0, 2), unique=True, min_size=1).map(
        lambda envs: (f"reset of {envs}", lambda fake: fake.reset(envs))
    ),
    act("plays", lambda fake: fake.tell(Status(True, 20.0, 1.0))),
    act("is paused", lambda fake: fake.tell(Status(False, 0.0, 0.0))),
    act("is loading", lambda fake: fake.tell(Loading("importing"))),
    act("does not load", fails(True, False)),
    act("fails while it runs", fails(True, True)),
    act("dies", lambda fake: fake.die()),
)
COMMANDS = st.one_of(
    act("play", lambda fake: fake.session.do(PlayRun())),
    act("pause", lambda fake: fake.session.do(PauseRun())),
    act("step", lambda fake: fake.session.do(Step())),
    act("undo", lambda fake: fake.session.do(UndoReset())),
    act("go on from here", lambda fake: fake.session.do(ContinueFromHere(scope="all"))),
    st.integers(-20, 20).map(lambda by: (f"{by} along", lambda fake: seek_by(fake.session, by))),
    st.integers(-2, 40).map(lambda at: (f"seek {at}", lambda fake: fake.session.dispatch(MomentShown(at)))),
    st.integers(-1, 5).map(lambda env: (f"select {env}", lambda fake: fake.session.change(selected_env=env))),
    act(
        "watch a camera",
        lambda fake: fake.session.change(cameras=(CameraRequest("base_camera", "sensor", ("rgb",)),)),
    ),
    act("place a camera", places),
    act("undo a placement", undoes),
    st.integers(0, 9).map(lambda seed: (f"seed {seed}", lambda fake: fake.session.do(SetSeed(seed=seed)))),
    act("reload", lambda fake: fake.session.do(ReloadFile())),
)
SEQUENCES = st.lists(st.one_of(EVENTS, COMMANDS), min_size=1, max_size=25)


@contextmanager
def told_first() -> Iterator[FakeWorkerSession]:
    with (
        tempfile.TemporaryDirectory() as folder,
        fake_worker_session(Path(folder), task=f"{folder}/push.py") as fake,
    ):
        fake.load()
        fake.reset()
        yield fake


@contextmanager
def page() -> Iterator[Live]:
    live = Live(viser.ViserServer(host="127.0.0.1", port=0, verbose=False), Clock())
    live.page.do(TellUnfolded(panel=TABLE), live.visitor)  # folded, it is only drawn for a new task
    try:
        yield live
    finally:
        live.server.stop()


def draw(live: Live, fake: FakeWorkerSession) -> None:
    live.session.answers["look"] = fake.session.look
    live.show(fake.view, fake.session.env_rows())


def panels_of(live: Live) -> dict[str, object]:
    """Everything but the 3-D view, where the first drawn moment decides the spacing of the envs."""
    return {name: value for name, value in live.all_drawn().items() if not name.startswith("in the view")}


def plain(value: object) -> Any:
    """The comparable part of a value, without clock times and anything outside the state."""
    if isinstance(value, np.ndarray):
        return value.shape, value.astype(object).ravel().tolist().__repr__()
    if is_dataclass(value) and not isinstance(value, type):
        left_out = ("at",) if type(value).__name__ == "PastLoad" else ("printed", "vitals")
        return {
            one.name: plain(getattr(value, one.name)) for one in fields(value) if one.name not in left_out
        }
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, (tuple, list)):
        return [plain(one) for one in value]
    return repr(value)


def view_after(sequence: Sequence[tuple[str, Act]]) -> SessionView:
    with told_first() as told:
        for _, do in sequence:
            with suppress(Refused):
                do(told)
        return told.view


@pytest.mark.thorough
@settings(max_examples=30)
@given(SEQUENCES)
def test_the_same_sequence_gives_the_same_state(sequence: list[tuple[str, Act]]) -> None:
    first, again = (plain(view_after(sequence)) for _ in range(2))
    parts, again_parts = ({**view.pop("features"), **view} for view in (first, again))
    assert parts.keys() == again_parts.keys()
    for name, value in parts.items():
        # Each run has the task's file in another folder.
        if name not in ("task", str(RecordingStatus), "refused", "problem", "loads", str(StudioView)):
            assert value == again_parts[name], name


@pytest.mark.thorough
@settings(max_examples=12)
@given(SEQUENCES)
def test_a_page_that_opens_midway_shows_the_same_as_one_open_from_the_start(
    sequence: list[tuple[str, Act]],
) -> None:
    with told_first() as told, page() as there, page() as late:
        for _, do in sequence:
            with suppress(Refused):
                do(told)
            draw(there, told)
        draw(late, told)
        one, other = panels_of(there), panels_of(late)
        assert one.keys() == other.keys()
        assert {name: (value, other[name]) for name, value in one.items() if value != other[name]} == {}

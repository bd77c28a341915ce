"""The studio's state under any sequence of events is deterministic, valid and can be shown."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.cameras.studio_runs import FILE, loaded
from tests.drive.scenes import camera as scene_camera
from tests.drive.scenes import problem
from tests.drive.session import BASE, DEATH, PEOPLE, FakeWorkerSession, fake_worker_session
from workbench.cameras import events as of
from workbench.cameras.apply import apply
from workbench.cameras.commands import (
    CopyTask,
    DropCameraChange,
    PickPixel,
    PutMovedCamerasBack,
    RedoCamera,
    ResetCamera,
    RevertCameraChange,
    SaveCameraChange,
    ScalePreview,
    SelectCamera,
    StopMeasuring,
    UndoCamera,
    UsePlacement,
)
from workbench.cameras.edit_state import apply_to_edits
from workbench.cameras.state import Change, Edits, Studio, placed_cameras, view_of
from workbench.cameras.view import EditRequest, EditState, PickedPixel
from workbench.envs.camera_data import CameraKey, CameraSettings, Picture
from workbench.live.commands import Step
from workbench.live.effects import Asked
from workbench.live.events import FileSaved, MomentShown, Now, Send, VersionLoaded, WorkerDied
from workbench.live.messages import PlaceCamera, Placed, TaskFailed
from workbench.live.run import Run
from workbench.page.command import Command, Refused
from workbench.task.write_edits import SourceEdit

SETTINGS = CameraSettings((0.4, 0.0, 0.6), (1, 0, 0, 0), 1.0, None, 8, 6, 0.01, 10.0, "minimal")
EDIT = SourceEdit(FILE, "old", "new", (), SETTINGS)
NOTHING: CameraKey = ("sensor", "nothing")
ODD: CameraKey = ("sensor", "odd")
Happens = tuple[object, int, float]
"""(event, index into `runs`, seconds since the previous event)."""


@cache
def runs() -> tuple[Run, ...]:
    """Return runs: before a task is loaded, without and with the edit, at a past step, on a GPU, and without cameras."""
    found: list[Run] = []

    def note(fake: FakeWorkerSession) -> None:
        found.append(fake.session.look(lambda run: run))

    cameras = (
        replace(scene_camera(), settings=SETTINGS, mount="arm/hand"),
        replace(scene_camera("render_camera", "human"), settings=replace(SETTINGS, distance=0.5)),
        scene_camera("odd"),
    )
    with tempfile.TemporaryDirectory() as folder, fake_worker_session(Path(folder)) as fake:
        note(fake)
        for text in ("old", "new"):
            fake.load(cameras=cameras, file=FILE, source_files=(FILE,), source={FILE: text})
            fake.reset()
            fake.step(2)
            note(fake)
        fake.session.dispatch(MomentShown(1, env=2))
        note(fake)
        fake.load("rebuilt", cameras=cameras, backend="gpu")
        note(fake)
        fake.load("rebuilt", cameras=())
        note(fake)
    return tuple(found)


def requests(keys: st.SearchStrategy[CameraKey]) -> st.SearchStrategy[EditRequest]:
    what: Any = st.sampled_from(["edit", "add", "duplicate", "rename", "remove"])
    return st.builds(
        EditRequest, what, keys, st.sampled_from([None, SETTINGS]), st.sampled_from(["", "render_camera"])
    )


keys: st.SearchStrategy[CameraKey] = st.sampled_from([BASE, PEOPLE, ODD, NOTHING])
heights = st.integers(0, 4).map(lambda height: replace(SETTINGS, position=(0.4, 0.0, height / 4)))
settings = st.one_of(heights, st.sampled_from([replace(SETTINGS, near=math.nan), SETTINGS]))
pictures = keys.map(lambda key: Picture(key[1], key[0], 0, np.zeros(7, np.float32)))
corners = st.sampled_from([(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])
report: Any = SimpleNamespace(envs=(0, 1, 2), worst_first=lambda: [2, 0, 1])
words = st.sampled_from(["", "why", "Why."])
commands: st.SearchStrategy[Command] = st.one_of(
    st.sampled_from(
        [UndoCamera(), RedoCamera(), ResetCamera(), PutMovedCamerasBack(), StopMeasuring(), Step()]
    ),
    st.sampled_from([SaveCameraChange(), RevertCameraChange(), CopyTask(), DropCameraChange()]),
    keys.map(lambda key: SelectCamera(kind=key[0], name=key[1])),
    st.integers(-1, 2).map(lambda number: UsePlacement(number=number)),
    st.sampled_from([0.5, 1.0]).map(lambda scale: ScalePreview(scale=scale)),
    st.just(PickPixel(x=0.2, y=0.3)),
)


def offered(there: CameraSettings) -> Any:
    return SimpleNamespace(settings=there)


def found(request: EditRequest) -> st.SearchStrategy[of.PlanFound]:
    states = EditState("planned", request, EDIT), EditState("refused", request, can_copy=True)
    return st.sampled_from([of.PlanFound(request, state) for state in states])


plans = requests(keys).flatmap(found)
events: st.SearchStrategy[object] = st.one_of(
    commands.map(lambda command: Asked(command, "a page")),
    st.builds(of.CameraChosen, st.one_of(st.none(), keys)),
    st.builds(of.CameraPlaced, keys, settings, st.sampled_from([None, "key"]), st.just(1.0)),
    st.builds(
        of.MeasureWanted,
        st.sampled_from(["envs", "steps", "resets"]),  # type: ignore[arg-type]
        st.integers(-1, 2000),
    ),
    st.builds(of.SuggestionsWanted, st.just(("cube",)), corners, corners, st.integers(0, 3)),
    st.builds(of.ComparisonWanted, settings),
    st.sampled_from([of.SheetWanted(), of.StudioOpened(), of.Measuring(True), of.Measuring(False)]),
    st.builds(of.PreviewDrawn, pictures),
    st.sampled_from([of.EditFailed, of.FileNotChanged]).flatmap(lambda kind: words.map(kind)),
    st.builds(of.WorkFailed, st.sampled_from(["live", "preview", "new camera"]), words),  # type: ignore[arg-type]
    st.builds(of.ReportMade, st.just(report), keys, settings, st.integers(0, 2), st.just(())),
    st.lists(settings, max_size=2).map(lambda all: of.SuggestionsFound(tuple(map(offered, all)), ("cube",))),
    st.builds(of.PicturesCompared, pictures, pictures),
    st.builds(of.SheetPictureDrawn, pictures),
    keys.map(lambda key: of.PixelPicked(PickedPixel(key, 0, 0.0, 0.0, (0, 0), None, None, None))),
    st.builds(of.EditWanted, requests(keys)),
    plans,
    st.builds(of.NewCameraDrawn, requests(keys), st.one_of(st.none(), pictures)),
    st.sampled_from([of.FileChanged(), of.StudioClosed()]),
    st.sampled_from([None, Path(FILE)]).map(lambda file: of.TaskCopied(file, EditState())),
    st.sampled_from([None, "same", "cameras", "patched", "rebuilt"]).map(loaded),
    st.booleans().map(lambda at_run: TaskFailed(problem(), kept=True, at_run=at_run)),
    st.builds(Placed, keys, st.one_of(st.none(), settings), st.none(), why_not=words),
    st.sampled_from([FileSaved(), WorkerDied(DEATH, "")]),
)
sequences = st.lists(st.tuples(events, st.integers(0, 5), st.sampled_from([0.0, 2.0])), max_size=30)


def after(happened: list[Happens], see: Callable[[object, Studio, Change, Run], None]) -> Studio:
    """Apply all events and return the final state; `see` gets each event, the state before it, and the change."""
    studio, seconds = Studio(), 0.0
    for event, at, later in happened:
        run, seconds = runs()[at], seconds + later
        try:
            change = apply(studio, event, run, Now(seconds, 0.0))
        except Refused as reason:
            assert str(reason) and isinstance(event, Asked)
            continue
        see(event, studio, change, run)
        studio = change[0]
    return studio


def ignore(event: object, before: Studio, change: Change, run: Run) -> None:
    pass


@given(sequences)
def test_the_same_events_give_the_same_state_and_every_state_can_be_shown(happened: list[Happens]) -> None:
    def shows(event: object, before: Studio, change: Change, run: Run) -> None:
        view = view_of(change[0], run, None)
        assert {one.key for one in view.cameras if one.moved} <= {
            one.key for one in placed_cameras(change[0])
        }
        assert view_of(change[0], run, None).selected == view.selected == change[0].selected

    assert after(happened, shows) == after(happened, ignore)


@given(sequences)
def test_sent_cameras_match_the_current_placements(happened: list[Happens]) -> None:
    def sent(event: object, before: Studio, change: Change, run: Run) -> None:
        studio, effects = change
        requests = [effect.request for effect in effects if isinstance(effect, Send)]
        assert len(requests) == len({one.key for one in requests if isinstance(one, PlaceCamera)})
        for request in requests:
            assert isinstance(request, PlaceCamera)
            assert request.settings == studio.placements.placed.get(request.key)
        if isinstance(event, VersionLoaded) and run.task is not None:
            assert set(placed_cameras(studio)) <= set(requests)

    after(happened, sent)


@given(sequences)
def test_edits_run_one_at_a_time_and_none_after_the_close(happened: list[Happens]) -> None:
    ends = of.PlanFound, of.FileChanged, of.FileNotChanged, of.TaskCopied, of.EditFailed

    def one_by_one(event: object, before: Studio, change: Change, run: Run) -> None:
        studio, effects = change
        begun = [one for one in effects if isinstance(one, of.FindPlan | of.ChangeFile | of.CopyToFolder)]
        assert len(begun) <= (not before.edits.busy or isinstance(event, ends))
        assert not begun or (studio.edits.busy and not before.edits.closed)
        assert studio.edits.busy or not studio.edits.waiting

    after(happened, one_by_one)


@given(sequences)
def test_every_step_can_be_undone_until_none_is_left(happened: list[Happens]) -> None:
    studio, run, now = after(happened, ignore), runs()[1], Now(0.0, 0.0)
    while (placements := studio.placements).done:
        studio, effects = apply(studio, Asked(UndoCamera()), run, now)
        (step,) = placements.done[len(studio.placements.done) :]
        assert studio.placements.now(step.key) == step.before
        assert effects == [Send(PlaceCamera(step.key, studio.placements.placed.get(step.key)))]
    with pytest.raises(Refused):
        apply(studio, Asked(UndoCamera()), run, now)


@pytest.mark.parametrize("file", [Path("copy.py"), None])
def test_a_copy_of_the_task_has_none_of_the_edits_that_were_made_in_the_original(file: Path | None) -> None:
    """Else Revert would change the original, which is open no more."""
    done = (EditState("checked", edit=EDIT),)
    studio = Studio(edits=Edits(done=done, busy=True))
    copied, _ = apply_to_edits(studio, of.TaskCopied(file, EditState("refused")), cast(Any, None))
    assert (copied.edits.done, copied.edits.copied) == ((), file) if file else (done, None)

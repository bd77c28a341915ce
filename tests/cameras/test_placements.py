"""Cameras placed by hand: requests to the worker, steps of undo, and the distance to the target."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.scenes import camera as scene_camera
from tests.drive.session import BASE, FakeWorkerSession, camera, fake_worker_session, moved
from tests.drive.waiting import until
from workbench.cameras.commands import PickPixel, PutMovedCamerasBack, RedoCamera, ScalePreview, UndoCamera
from workbench.cameras.events import CameraChosen, CameraPlaced, EditWanted
from workbench.cameras.placements import Placements
from workbench.cameras.questions import RunCameras
from workbench.cameras.view import EditRequest, StudioView
from workbench.envs.camera_data import CameraSettings
from workbench.live.events import PagesCounted
from workbench.live.messages import PlaceCamera, Placed
from workbench.machine.processes.wire import Call
from workbench.page.command import Refused
from workbench.pictures.camera_conventions import LookAt, pose_from_look_at, target_of, with_pose
from workbench.record.state import RecordingWanted

pytestmark = pytest.mark.thorough

EYE, TARGET = (0.45, 0.0, 0.6), (0.08, 0.0, 0.2)
"""The target lies above the ground, so it cannot be found where the line of sight meets the ground."""
LENS = CameraSettings((0, 0, 0), (1, 0, 0, 0), 1.0, None, 128, 128, 0.01, 10.0, "minimal")
BARE = with_pose(LENS, pose_from_look_at(LookAt(EYE, TARGET)))
"""Settings from a file that names no target."""
FILE = replace(BARE, distance=math.dist(EYE, TARGET))
MOVED = replace(FILE, position=(0.45, 0.3, 0.6))
NOTHING = ("sensor", "nothing")


def at(height: float) -> CameraSettings:
    return replace(FILE, position=(0.45, 0.0, height))


def loaded(
    fake: FakeWorkerSession,
    settings: CameraSettings | None = FILE,
    level: str | None = None,
    mount: str | None = None,
) -> None:
    """Load a version whose camera has these settings, or no camera if None."""
    info = replace(scene_camera(), settings=settings, mount=mount)
    fake.load(level, cameras=() if settings is None else (info,), source_hash=str(settings))
    fake.reset()


@pytest.fixture
def one(fake: FakeWorkerSession) -> FakeWorkerSession:
    loaded(fake)
    fake.asked(object)
    return fake


def now(fake: FakeWorkerSession) -> CameraSettings:
    found = camera(fake.session, BASE).now
    assert found is not None
    return found


def looks_at(fake: FakeWorkerSession) -> object:
    return pytest.approx(target_of(now(fake)), abs=1e-6)


def test_a_placement_is_sent_to_the_worker_once(one: FakeWorkerSession) -> None:
    session = one.session
    session.dispatch(CameraPlaced(BASE, MOVED))
    session.dispatch(CameraPlaced(BASE, MOVED))
    assert one.asked(PlaceCamera) == [PlaceCamera(BASE, MOVED)]
    assert moved(one.view) == {BASE} and now(one) == MOVED
    for command, settings in ((UndoCamera(), None), (RedoCamera(), MOVED), (PutMovedCamerasBack(), None)):
        session.do(command)
        assert one.asked(PlaceCamera) == [PlaceCamera(BASE, settings)]
    session.dispatch(CameraPlaced(NOTHING, MOVED))
    assert (
        one.asked(PlaceCamera) == []
        and "there is no sensor camera nothing" in one.view.of(StudioView).problem
    )


def test_after_a_failed_placement_the_previous_one_is_sent_once(one: FakeWorkerSession) -> None:
    for height in (0.7, 0.8):
        one.session.dispatch(CameraPlaced(BASE, at(height)))
        one.asked(object)
        one.tell(Placed(BASE, at(height), None, why_not="it is far away"))
        assert (
            one.asked(PlaceCamera) == [PlaceCamera(BASE, None)]
            and "it is far away" in one.view.of(StudioView).problem
        )
        one.tell(Placed(BASE, None, None, why_not="nor can this"))
        assert one.asked(PlaceCamera) == [] and not moved(one.view)


def test_placements_are_sent_to_each_new_version_and_worker_until_the_file_changes_them(
    one: FakeWorkerSession,
) -> None:
    session = one.session
    session.dispatch(CameraChosen(BASE))
    session.dispatch(CameraPlaced(NOTHING, MOVED))
    assert one.view.of(StudioView).problem
    session.dispatch(CameraPlaced(BASE, MOVED))
    for level in ("patched", "rebuilt", None):
        one.asked(object)
        loaded(one, level=level)
        assert one.asked(PlaceCamera) == [PlaceCamera(BASE, MOVED)] and one.view.of(StudioView).problem == ""
        assert one.view.of(StudioView).selected == BASE
    loaded(one, at(0.9), "cameras")
    assert one.asked(PlaceCamera) == [PlaceCamera(BASE, None)] and now(one) == at(0.9)
    assert "base_camera" in one.view.of(StudioView).problem
    session.do(UndoCamera())
    assert now(one) == MOVED
    kept = one.session.kept_work()
    loaded(one, None, "cameras")
    assert one.view.of(StudioView).selected is None and one.view.of(StudioView).cameras == ()
    with fake_worker_session(Path("nowhere"), kept=kept) as later:
        loaded(later, at(0.9))
        assert later.asked(PlaceCamera) == [PlaceCamera(BASE, MOVED)]
        assert later.view.of(StudioView).selected == BASE and now(later) == MOVED


# --- undo -------------------------------------------------------------------------------------------

DRAG = object()
ONE_CAMERA = Placements({BASE: FILE})
Placing = tuple[int, object, float, float]
"""(height in mm, control, seconds since the previous call, the control's pause in seconds)."""
CALLS = st.lists(
    st.tuples(
        st.integers(500, 520),
        st.sampled_from([None, "key", DRAG]),
        st.sampled_from([0.0, 1.1, 1.3, 90.0]),
        st.sampled_from([1.2, math.inf]),
    ),
    max_size=12,
)


def placed(calls: list[Placing], first: Placements = ONE_CAMERA) -> Placements:
    seconds, placements = 0.0, first
    for height, control, after, pause in calls:
        seconds += after
        placements = placements.place(BASE, at(height / 1000), seconds, control, pause)
    return placements


@given(CALLS)
def test_changes_by_one_control_without_a_pause_are_one_step_of_undo(calls: list[Placing]) -> None:
    before: list[float] = []  # heights that undo restores
    seconds, was, last, last_control = 0.0, 0.6, -math.inf, None
    for height, control, after, pause in calls:
        seconds += after
        if height / 1000 == was:
            continue
        if control is None or control != last_control or seconds - last > pause:
            before.append(was)
        was, last, last_control = height / 1000, seconds, control
    placements, undone = placed(calls), []
    while placements.done:
        placements = placements.undo()
        undone.append(placements.now(BASE))
    assert undone == [at(height) for height in reversed(before)]


@given(CALLS, st.integers(0, 12))
def test_undo_and_redo_restore_every_step(calls: list[Placing], steps: int) -> None:
    last = placements = placed(calls)
    for _ in range(steps):
        placements = placements.undo()
    for _ in range(steps):
        placements = placements.redo()
    assert (placements.placed, placements.undone) == (last.placed, ())
    for _ in calls:
        placements = placements.undo()
    assert placements.placed == {} and placements.now(BASE) == FILE and placements.done == ()
    assert last == placed(calls), "undo and redo must not modify a value in place"


@given(CALLS, st.integers(500, 520), st.booleans())
def test_a_placement_survives_a_load_unless_the_file_changes_the_camera(
    calls: list[Placing], height: int, own: bool
) -> None:
    before, in_file = placed(calls), {BASE: at(height / 1000)}
    after, dropped = before.loaded(in_file, frozenset({BASE} if own else ()))
    was = before.placed.get(BASE)
    changed = was is not None and in_file[BASE] not in (FILE, was)
    assert dropped == ((BASE,) if changed and not own else ())
    if dropped:
        assert after.now(BASE) == in_file[BASE] and after.undo().now(BASE) == was
    else:
        assert after.now(BASE) == (in_file[BASE] if was is None else was)
    gone, _ = before.loaded({})
    assert (gone.placed, gone.done, gone.undone) == ({}, (), ())


def test_an_undone_step_can_be_redone_until_another_change(one: FakeWorkerSession) -> None:
    session = one.session

    def labels() -> tuple[str | None, str | None]:
        return one.view.of(StudioView).undo, one.view.of(StudioView).redo

    for command in (UndoCamera(), RedoCamera()):
        with pytest.raises(Refused):
            session.do(command)
    assert labels() == (None, None)
    session.dispatch(CameraPlaced(BASE, at(0.7), DRAG))
    assert labels() == ("moved base_camera", None)
    session.do(UndoCamera())
    assert labels() == (None, "moved base_camera") and now(one) == FILE
    session.do(RedoCamera())
    session.dispatch(CameraPlaced(BASE, at(0.8), DRAG))
    session.do(UndoCamera())
    assert now(one) == at(0.7), "a drag after a redo must be a new step"
    session.dispatch(CameraPlaced(BASE, at(0.9)))
    with pytest.raises(Refused):
        session.do(RedoCamera())
    assert now(one) == at(0.9) and labels() == ("moved base_camera", None)


# --- the distance to the target ---------------------------------------------------------------------


def test_the_target_comes_from_the_file_and_follows_its_changes(one: FakeWorkerSession) -> None:
    assert looks_at(one) == TARGET, "the target must not be on the ground"
    loaded(one, replace(FILE, distance=1.5 * math.dist(EYE, TARGET)), "cameras")
    assert looks_at(one) == tuple(np.add(EYE, 1.5 * np.subtract(TARGET, EYE)))


def test_a_moved_camera_keeps_its_distance_and_a_restored_one_the_files_target(
    one: FakeWorkerSession,
) -> None:
    session = one.session
    session.dispatch(CameraPlaced(BASE, replace(FILE, distance=0.2)))
    assert now(one).distance == 0.2 and not moved(one.view) and one.view.of(StudioView).undo is None, (
        "a new distance alone is not a placement"
    )
    session.dispatch(CameraPlaced(BASE, FILE))
    session.dispatch(CameraPlaced(BASE, MOVED))
    assert looks_at(one) == (0.08, 0.3, 0.2)
    session.dispatch(CameraPlaced(BASE, replace(MOVED, distance=2.0)))
    assert now(one).distance == 2.0
    session.do(UndoCamera())
    assert looks_at(one) == TARGET and not moved(one.view), "a new distance alone is not a step of undo"
    session.do(RedoCamera())
    assert now(one).distance == 2.0, "redo must restore the distance set there"


def test_without_a_target_in_the_file_the_ground_sets_the_distance(
    fake: FakeWorkerSession,
) -> None:
    loaded(fake, BARE)
    assert looks_at(fake) == (-0.105, 0, 0)
    fake.session.dispatch(CameraPlaced(BASE, replace(now(fake), position=(0.45, 0.0, 0.9))))
    assert looks_at(fake) == (-0.105, 0, 0.3)
    loaded(fake, replace(BARE, position=(0.45, 0.0, 0.9)), "cameras")
    assert looks_at(fake) == (-0.105, 0, 0.3) and not moved(fake.view), (
        "the distance stays once the file has the placement without a target"
    )


@pytest.mark.parametrize("forward", [(1.0, 0.0, 0.0), (0.0, 0.6, 0.8), (0.999, 0.0, -0.0447)])
def test_without_ground_nearby_the_target_is_one_metre_ahead(
    fake: FakeWorkerSession, forward: tuple[float, float, float]
) -> None:
    loaded(fake, with_pose(LENS, pose_from_look_at(LookAt(EYE, tuple(np.add(EYE, forward))))))
    assert now(fake).distance == 1.0


def test_a_mounted_cameras_distance_is_measured_to_the_envs_ground(fake: FakeWorkerSession) -> None:
    """The hand is upright, 0.5 m above the ground; the camera looks straight down from 0.1 m above the hand."""
    down = with_pose(LENS, pose_from_look_at(LookAt((0, 0, 0.1), (0, 0, 0))))
    loaded(fake, down, mount="arm/hand")
    assert now(fake).distance == pytest.approx(0.6)


# --- the file ---------------------------------------------------------------------------------------


@contextmanager
def opened(folder: Path) -> Iterator[tuple[FakeWorkerSession, Path]]:
    file = folder / "push.py"
    file.write_text('@register_env("Alone-v1")\nclass PushEnv:\n    """Nothing but a place."""\n')
    with fake_worker_session(folder / "recordings", str(file)) as fake:
        source = {str(file): file.read_text()}
        info = replace(scene_camera(), settings=FILE)
        fake.load(file=str(file), source_files=(str(file),), source=source, cameras=(info,))
        fake.reset()
        fake.asked(object)
        yield fake, file


@pytest.fixture
def with_file(tmp_path: Path) -> Iterator[tuple[FakeWorkerSession, Path]]:
    with opened(tmp_path) as file_session:
        yield file_session


def plan_waiting_for_worker(fake: FakeWorkerSession) -> Call:
    """Request a plan and return its question to the worker, for whose answer the plan waits."""
    fake.session.dispatch(EditWanted(EditRequest("add", ("human", "side"), FILE)))
    found: list[Any] = []

    def asked() -> bool:
        found.extend(call for call in fake.asked(Call) if isinstance(call.request, RunCameras))
        return bool(found)

    until(asked, "a question to the worker")
    return found[0]


def test_closing_a_session_ends_waiting_plans_and_starts_no_more(
    with_file: tuple[FakeWorkerSession, Path],
) -> None:
    told, file = with_file
    plan_waiting_for_worker(told)
    told.session.dispatch(EditWanted(EditRequest("edit", BASE, MOVED)))  # queued
    closing = threading.Thread(target=told.session.close)
    closing.start()
    closing.join(20)
    assert not closing.is_alive(), "the close waits for an answer that never comes"
    state = told.view.of(StudioView).edit_state
    assert state.stage == "refused" and state.request is not None and state.request.what == "add"
    told.session.dispatch(EditWanted(EditRequest("edit", BASE, MOVED)))
    assert told.asked(Call) == [] and told.view.of(StudioView).edit_state == state


def test_a_save_or_a_dead_worker_ends_a_waiting_plan_and_the_next_plan_asks_again(
    with_file: tuple[FakeWorkerSession, Path],
) -> None:
    told, file = with_file
    for end in (told.die, lambda: file.write_text(file.read_text() + "\n")):
        call = plan_waiting_for_worker(told)
        end()
        until(lambda: told.view.of(StudioView).edit_state.stage == "refused", "the end of the plan")
        assert "did not answer" in told.view.of(StudioView).edit_state.message
        assert plan_waiting_for_worker(told).number != call.number
        told.die()
        until(lambda: told.view.of(StudioView).edit_state.stage == "refused", "the end of the second")


def test_closing_a_session_leaves_no_thread(tmp_path: Path) -> None:
    before = set(threading.enumerate())
    with opened(tmp_path) as (told, _):
        session = told.session
        plan_waiting_for_worker(told)
        session.dispatch(PagesCounted(1))
        session.dispatch(CameraChosen(BASE))
        session.do(ScalePreview(scale=0.5))
        session.do(PickPixel(x=0.5, y=0.5))
        calls: list[Call] = []
        until(lambda: calls.extend(told.asked(Call)) or len(calls) == 2, "both questions")
        session.dispatch(RecordingWanted())
        told.reset()
        told.step(2)
        assert len(set(threading.enumerate()) - before) >= 5
    remaining = [thread.name for thread in set(threading.enumerate()) - before if thread.is_alive()]
    assert remaining == []
    assert session.wait(-1, 60.0) >= 0, "a waiting page must be woken"

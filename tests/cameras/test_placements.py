"""Cameras that are placed by hand: what is asked of the worker, what is one step of undo, and how far each looks."""

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
from tests.drive.session import BASE, Told, camera, moved, told_session
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
"""It looks at something above the ground, which a line of sight does not tell."""
LENS = CameraSettings((0, 0, 0), (1, 0, 0, 0), 1.0, None, 128, 128, 0.01, 10.0, "minimal")
BARE = with_pose(LENS, pose_from_look_at(LookAt(EYE, TARGET)))
"""As a file has it that names no target."""
FILE = replace(BARE, distance=math.dist(EYE, TARGET))
MOVED = replace(FILE, position=(0.45, 0.3, 0.6))
NOTHING = ("sensor", "nothing")


def at(height: float) -> CameraSettings:
    return replace(FILE, position=(0.45, 0.0, height))


def loaded(
    told: Told, settings: CameraSettings | None = FILE, level: str | None = None, mount: str | None = None
) -> None:
    """A version that says this of the camera; None if it has none."""
    info = replace(scene_camera(), settings=settings, mount=mount)
    told.load(level, cameras=() if settings is None else (info,), source_hash=str(settings))
    told.reset()


@pytest.fixture
def one(told: Told) -> Told:
    loaded(told)
    told.asked(object)
    return told


def now(told: Told) -> CameraSettings:
    found = camera(told.session, BASE).now
    assert found is not None
    return found


def looks_at(told: Told) -> object:
    return pytest.approx(target_of(now(told)), abs=1e-6)


def test_what_is_placed_is_asked_of_the_worker_and_what_stands_so_already_is_not(one: Told) -> None:
    session = one.session
    session.happen(CameraPlaced(BASE, MOVED))
    session.happen(CameraPlaced(BASE, MOVED))
    assert one.asked(PlaceCamera) == [PlaceCamera(BASE, MOVED)]
    assert moved(one.view) == {BASE} and now(one) == MOVED
    for command, settings in ((UndoCamera(), None), (RedoCamera(), MOVED), (PutMovedCamerasBack(), None)):
        session.do(command)
        assert one.asked(PlaceCamera) == [PlaceCamera(BASE, settings)]
    session.happen(CameraPlaced(NOTHING, MOVED))
    assert (
        one.asked(PlaceCamera) == []
        and "there is no sensor camera nothing" in one.view.of(StudioView).problem
    )


def test_one_that_could_not_be_placed_is_asked_for_where_it_stood_once_each_time(one: Told) -> None:
    for height in (0.7, 0.8):
        one.session.happen(CameraPlaced(BASE, at(height)))
        one.asked(object)
        one.tell(Placed(BASE, at(height), None, why_not="it is far away"))
        assert (
            one.asked(PlaceCamera) == [PlaceCamera(BASE, None)]
            and "it is far away" in one.view.of(StudioView).problem
        )
        one.tell(Placed(BASE, None, None, why_not="nor can this"))
        assert one.asked(PlaceCamera) == [] and not moved(one.view)


def test_placements_are_sent_again_to_each_version_and_worker_until_the_file_says_otherwise(
    one: Told,
) -> None:
    session = one.session
    session.happen(CameraChosen(BASE))
    session.happen(CameraPlaced(NOTHING, MOVED))
    assert one.view.of(StudioView).problem
    session.happen(CameraPlaced(BASE, MOVED))
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
    with told_session(Path("nowhere"), kept=kept) as later:
        loaded(later, at(0.9))
        assert later.asked(PlaceCamera) == [PlaceCamera(BASE, MOVED)]
        assert later.view.of(StudioView).selected == BASE and now(later) == MOVED


# --- undo ------------------------------------------------------------------------------------------------

DRAG = object()
ONE_CAMERA = Placements({BASE: FILE})
Placing = tuple[int, object, float, float]
"""Millimetres above the ground, the control, seconds since the call before, and the pause of the control."""
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
def test_what_one_control_does_without_a_pause_is_one_step_of_undo(calls: list[Placing]) -> None:
    before: list[float] = []  # heights to which undo goes
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
def test_undone_and_redone_every_step_is_where_it_was(calls: list[Placing], steps: int) -> None:
    last = placements = placed(calls)
    for _ in range(steps):
        placements = placements.undo()
    for _ in range(steps):
        placements = placements.redo()
    assert (placements.placed, placements.undone) == (last.placed, ())
    for _ in calls:
        placements = placements.undo()
    assert placements.placed == {} and placements.now(BASE) == FILE and placements.done == ()
    assert last == placed(calls), "no value is written into"


@given(CALLS, st.integers(500, 520), st.booleans())
def test_a_placement_stays_over_a_load_unless_the_file_says_otherwise_and_is_never_lost(
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


def test_what_was_taken_back_can_be_made_again_until_something_else_is_done(one: Told) -> None:
    session = one.session

    def labels() -> tuple[str | None, str | None]:
        return one.view.of(StudioView).undo, one.view.of(StudioView).redo

    for command in (UndoCamera(), RedoCamera()):
        with pytest.raises(Refused):
            session.do(command)
    assert labels() == (None, None)
    session.happen(CameraPlaced(BASE, at(0.7), DRAG))
    assert labels() == ("moved base_camera", None)
    session.do(UndoCamera())
    assert labels() == (None, "moved base_camera") and now(one) == FILE
    session.do(RedoCamera())
    session.happen(CameraPlaced(BASE, at(0.8), DRAG))
    session.do(UndoCamera())
    assert now(one) == at(0.7), "what was made again is whole: no drag goes on from it"
    session.happen(CameraPlaced(BASE, at(0.9)))
    with pytest.raises(Refused):
        session.do(RedoCamera())
    assert now(one) == at(0.9) and labels() == ("moved base_camera", None)


# --- how far it looks --------------------------------------------------------------------------------------


def test_the_target_is_the_one_that_the_file_gives_and_follows_it(one: Told) -> None:
    assert looks_at(one) == TARGET, "not where the line of sight meets the ground"
    loaded(one, replace(FILE, distance=1.5 * math.dist(EYE, TARGET)), "cameras")
    assert looks_at(one) == tuple(np.add(EYE, 1.5 * np.subtract(TARGET, EYE)))


def test_moved_it_looks_as_far_as_it_did_and_back_in_its_place_at_what_the_file_gives(one: Told) -> None:
    session = one.session
    session.happen(CameraPlaced(BASE, replace(FILE, distance=0.2)))
    assert now(one).distance == 0.2 and not moved(one.view) and one.view.of(StudioView).undo is None, (
        "no placement"
    )
    session.happen(CameraPlaced(BASE, FILE))
    session.happen(CameraPlaced(BASE, MOVED))
    assert looks_at(one) == (0.08, 0.3, 0.2)
    session.happen(CameraPlaced(BASE, replace(MOVED, distance=2.0)))
    assert now(one).distance == 2.0
    session.do(UndoCamera())
    assert looks_at(one) == TARGET and not moved(one.view), "no step of its own"
    session.do(RedoCamera())
    assert now(one).distance == 2.0, "as it was set there"


def test_without_a_target_in_the_file_it_looks_at_the_ground_and_moved_it_goes_on_to_look_so_far(
    told: Told,
) -> None:
    loaded(told, BARE)
    assert looks_at(told) == (-0.105, 0, 0)
    told.session.happen(CameraPlaced(BASE, replace(now(told), position=(0.45, 0.0, 0.9))))
    assert looks_at(told) == (-0.105, 0, 0.3)
    loaded(told, replace(BARE, position=(0.45, 0.0, 0.9)), "cameras")
    assert looks_at(told) == (-0.105, 0, 0.3) and not moved(told.view), (
        "the file has it now, without a target"
    )


@pytest.mark.parametrize("forward", [(1.0, 0.0, 0.0), (0.0, 0.6, 0.8), (0.999, 0.0, -0.0447)])
def test_where_the_ground_is_not_before_it_or_far_away_it_looks_a_metre_ahead(
    told: Told, forward: tuple[float, float, float]
) -> None:
    loaded(told, with_pose(LENS, pose_from_look_at(LookAt(EYE, tuple(np.add(EYE, forward))))))
    assert now(told).distance == 1.0


def test_the_ground_before_a_mounted_camera_is_that_of_the_env(told: Told) -> None:
    """The hand is 0.5 m above it and upright: the camera looks from 0.1 m above the hand straight to the ground."""
    down = with_pose(LENS, pose_from_look_at(LookAt((0, 0, 0.1), (0, 0, 0))))
    loaded(told, down, mount="arm/hand")
    assert now(told).distance == pytest.approx(0.6)


# --- the file ----------------------------------------------------------------------------------------------


@contextmanager
def opened(folder: Path) -> Iterator[tuple[Told, Path]]:
    file = folder / "push.py"
    file.write_text('@register_env("Alone-v1")\nclass PushEnv:\n    """Nothing but a place."""\n')
    with told_session(folder / "recordings", str(file)) as told:
        source = {str(file): file.read_text()}
        info = replace(scene_camera(), settings=FILE)
        told.load(file=str(file), source_files=(str(file),), source=source, cameras=(info,))
        told.reset()
        told.asked(object)
        yield told, file


@pytest.fixture
def with_file(tmp_path: Path) -> Iterator[tuple[Told, Path]]:
    with opened(tmp_path) as made:
        yield made


def asks(told: Told) -> Call:
    """A plan, for which the worker is asked what comes of it, and which waits for the answer."""
    told.session.happen(EditWanted(EditRequest("add", ("human", "side"), FILE)))
    found: list[Any] = []

    def asked() -> bool:
        found.extend(call for call in told.asked(Call) if isinstance(call.request, RunCameras))
        return bool(found)

    until(asked, "the worker being asked")
    return found[0]


def test_the_end_of_a_session_ends_what_waits_for_its_worker_and_begins_nothing_more(
    with_file: tuple[Told, Path],
) -> None:
    told, file = with_file
    asks(told)
    told.session.happen(EditWanted(EditRequest("edit", BASE, MOVED)))  # behind it
    closing = threading.Thread(target=told.session.close)
    closing.start()
    closing.join(20)
    assert not closing.is_alive(), "it waits for an answer that nobody gives"
    state = told.view.of(StudioView).edit_state
    assert state.stage == "refused" and state.request is not None and state.request.what == "add"
    told.session.happen(EditWanted(EditRequest("edit", BASE, MOVED)))
    assert told.asked(Call) == [] and told.view.of(StudioView).edit_state == state


def test_a_save_and_a_death_end_what_waits_for_the_worker_and_the_next_is_asked(
    with_file: tuple[Told, Path],
) -> None:
    told, file = with_file
    for end in (told.die, lambda: file.write_text(file.read_text() + "\n")):
        call = asks(told)
        end()
        until(lambda: told.view.of(StudioView).edit_state.stage == "refused", "the end of the plan")
        assert "did not answer" in told.view.of(StudioView).edit_state.message
        assert asks(told).number != call.number
        told.die()
        until(lambda: told.view.of(StudioView).edit_state.stage == "refused", "the end of the second")


def test_no_thread_of_a_session_is_left_when_it_is_closed_whatever_waited(tmp_path: Path) -> None:
    before = set(threading.enumerate())
    with opened(tmp_path) as (told, _):
        session = told.session
        asks(told)
        session.happen(PagesCounted(1))
        session.happen(CameraChosen(BASE))
        session.do(ScalePreview(scale=0.5))
        session.do(PickPixel(x=0.5, y=0.5))
        heard: list[Call] = []
        until(lambda: heard.extend(told.asked(Call)) or len(heard) == 2, "both questions")
        session.happen(RecordingWanted())
        told.reset()
        told.step(2)
        assert len(set(threading.enumerate()) - before) >= 5
    left = [thread.name for thread in set(threading.enumerate()) - before if thread.is_alive()]
    assert left == []
    assert session.wait(-1, 60.0) >= 0, "a page that waits is woken"

"""Cameras that are placed by hand: what is asked of the worker, what is one step of undo, and how far each looks."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.drive.session import BASE, Told, camera, moved, told_session
from tests.drive.waiting import until
from tests.ui.scenes import camera as scene_camera
from workbench.core.camera_data import CameraSettings
from workbench.core.cameras.conventions import LookAt, pose_from_look_at, target_of, with_pose
from workbench.machine.processes.wire import Call
from workbench.session.cameras import studio as of_studio
from workbench.session.cameras.view import EditRequest
from workbench.session.protocol.messages import PlaceCamera, Placed
from workbench.session.protocol.questions import RunCameras

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
    studio = one.session.studio
    studio.place(BASE, MOVED)
    studio.place(BASE, MOVED)
    assert one.asked(PlaceCamera) == [PlaceCamera(BASE, MOVED)] == list(studio.placed_cameras())
    assert moved(one.view) == {BASE} and now(one) == MOVED
    for do, settings in (
        (studio.undo, None),
        (studio.redo, MOVED),
        (lambda: studio.back_to_file(BASE), None),
    ):
        do()
        assert one.asked(PlaceCamera) == [PlaceCamera(BASE, settings)]
    studio.place(NOTHING, MOVED)
    assert one.asked(PlaceCamera) == [] and "there is no sensor camera nothing" in one.view.studio.problem
    with pytest.raises(ValueError, match="nothing"):
        studio.import_pose(NOTHING, "", None, None)
    with pytest.raises(ValueError, match="nothing"):
        studio.export([BASE, NOTHING], "json")


def test_one_that_could_not_be_placed_is_asked_for_where_it_stood_once_each_time(one: Told) -> None:
    for height in (0.7, 0.8):
        one.session.studio.place(BASE, at(height))
        one.asked(object)
        one.tell(Placed(BASE, at(height), None, why_not="it is far away"))
        assert (
            one.asked(PlaceCamera) == [PlaceCamera(BASE, None)]
            and "it is far away" in one.view.studio.problem
        )
        one.tell(Placed(BASE, None, None, why_not="nor can this"))
        assert one.asked(PlaceCamera) == [] and not moved(one.view)


def test_placements_are_sent_again_to_each_version_and_worker_until_the_file_says_otherwise(
    one: Told,
) -> None:
    studio = one.session.studio
    studio.select(BASE)
    studio.place(NOTHING, MOVED)
    assert one.view.studio.problem
    studio.place(BASE, MOVED)
    for level in ("patched", "rebuilt", None):
        one.asked(object)
        loaded(one, level=level)
        assert one.asked(PlaceCamera) == [PlaceCamera(BASE, MOVED)] and one.view.studio.problem == ""
        assert one.view.studio.selected == BASE
    loaded(one, at(0.9), "cameras")
    assert one.asked(PlaceCamera) == [PlaceCamera(BASE, None)] and now(one) == at(0.9)
    assert "base_camera" in one.view.studio.problem
    studio.undo()
    assert now(one) == MOVED
    kept = one.session.kept_work()
    loaded(one, None, "cameras")
    assert one.view.studio.selected is None and one.view.studio.cameras == ()
    with told_session(Path("nowhere"), kept=kept) as later:
        loaded(later, at(0.9))
        assert later.asked(PlaceCamera) == [PlaceCamera(BASE, MOVED)]
        assert later.view.studio.selected == BASE and now(later) == MOVED


# --- undo ------------------------------------------------------------------------------------------------

DRAG = object()
A_STEP_EACH = [0.62, 0.61, 0.6]
"""Heights of `FILE`, and of the first two of three placements."""


@pytest.mark.parametrize(
    ("calls", "heights"),
    [
        ([("key", 0.0, 1.2), ("key", 1.1, 1.2), ("key", 2.3, 1.2)], [0.6]),
        ([("key", 0.0, 1.2), ("key", 1.3, 1.2), ("key", 2.6, 1.2)], A_STEP_EACH),
        ([("key", 0.0, 1.2), ("position", 0.1, 1.2), ("key", 0.2, 1.2)], A_STEP_EACH),
        ([(DRAG, 0.0, math.inf), (DRAG, 90.0, math.inf), (object(), 90.1, math.inf)], [0.62, 0.6]),
        ([(None, 0.0, math.inf), (None, 0.0, math.inf), (None, 0.0, math.inf)], A_STEP_EACH),
    ],
    ids=["followed at once", "after a pause", "by turns", "a drag that rests", "nobody's"],
)
def test_what_one_hand_does_without_a_pause_is_one_step_of_undo(
    one: Told, calls: list[tuple[object, float, float]], heights: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    studio = one.session.studio
    for height, (hand, seconds, pause) in zip((0.61, 0.62, 0.63), calls, strict=True):
        monkeypatch.setattr(of_studio, "time", SimpleNamespace(monotonic=lambda seconds=seconds: seconds))
        studio.place(BASE, at(height), hand, pause)
    undone = []
    while one.view.studio.undo is not None:
        studio.undo()
        undone.append(now(one).position[2])
    assert undone == heights


def test_what_was_taken_back_can_be_made_again_until_something_else_is_done(one: Told) -> None:
    studio = one.session.studio

    def labels() -> tuple[str | None, str | None]:
        return one.view.studio.undo, one.view.studio.redo

    studio.undo()
    studio.redo()
    assert labels() == (None, None)
    studio.place(BASE, at(0.7), DRAG)
    assert labels() == ("moved base_camera", None)
    studio.undo()
    assert labels() == (None, "moved base_camera") and now(one) == FILE
    studio.redo()
    studio.place(BASE, at(0.8), DRAG)
    studio.undo()
    assert now(one) == at(0.7), "what was made again is whole: no drag goes on from it"
    studio.place(BASE, at(0.9))
    studio.redo()
    assert now(one) == at(0.9) and labels() == ("moved base_camera", None)


# --- how far it looks --------------------------------------------------------------------------------------


def test_the_target_is_the_one_that_the_file_gives_and_follows_it(one: Told) -> None:
    assert looks_at(one) == TARGET, "not where the line of sight meets the ground"
    loaded(one, replace(FILE, distance=1.5 * math.dist(EYE, TARGET)), "cameras")
    assert looks_at(one) == tuple(np.add(EYE, 1.5 * np.subtract(TARGET, EYE)))


def test_moved_it_looks_as_far_as_it_did_and_back_in_its_place_at_what_the_file_gives(one: Told) -> None:
    studio = one.session.studio
    studio.place(BASE, replace(FILE, distance=0.2))
    assert now(one).distance == 0.2 and not moved(one.view) and one.view.studio.undo is None, "no placement"
    studio.place(BASE, FILE)
    studio.place(BASE, MOVED)
    assert looks_at(one) == (0.08, 0.3, 0.2)
    studio.place(BASE, replace(MOVED, distance=2.0))
    assert now(one).distance == 2.0
    studio.undo()
    assert looks_at(one) == TARGET and not moved(one.view), "no step of its own"
    studio.redo()
    assert now(one).distance == 2.0, "as it was set there"


def test_without_a_target_in_the_file_it_looks_at_the_ground_and_moved_it_goes_on_to_look_so_far(
    told: Told,
) -> None:
    loaded(told, BARE)
    assert looks_at(told) == (-0.105, 0, 0)
    told.session.studio.place(BASE, replace(now(told), position=(0.45, 0.0, 0.9)))
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
    told.session.studio.file.plan(EditRequest("add", ("human", "side"), FILE))
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
    told.session.studio.file.plan(EditRequest("edit", BASE, MOVED))  # behind it
    closing = threading.Thread(target=told.session.close)
    closing.start()
    closing.join(20)
    assert not closing.is_alive(), "it waits for an answer that nobody gives"
    state = told.view.studio.edit_state
    assert state.stage == "refused" and state.request is not None and state.request.what == "add"
    told.session.studio.file.plan(EditRequest("edit", BASE, MOVED))
    assert told.asked(Call) == [] and told.view.studio.edit_state == state


def test_a_save_and_a_death_end_what_waits_for_the_worker_and_the_next_is_asked(
    with_file: tuple[Told, Path],
) -> None:
    told, file = with_file
    for end in (told.die, lambda: file.write_text(file.read_text() + "\n")):
        call = asks(told)
        end()
        until(lambda: told.view.studio.edit_state.stage == "refused", "the end of the plan")
        assert "did not answer" in told.view.studio.edit_state.message
        assert asks(told).number != call.number
        told.die()
        until(lambda: told.view.studio.edit_state.stage == "refused", "the end of the second")


def test_no_thread_of_a_session_is_left_when_it_is_closed_whatever_waited(tmp_path: Path) -> None:
    before = set(threading.enumerate())
    with opened(tmp_path) as (told, _):
        session = told.session
        asks(told)
        session.studio.select(BASE)
        session.studio.set_preview_scale(0.5)
        session.studio.draw_preview()
        session.studio.reports.pick(0.5, 0.5)
        heard: list[Call] = []
        until(lambda: heard.extend(told.asked(Call)) or len(heard) == 2, "both questions")
        session.start_recording()
        told.reset()
        told.step(2)
        assert len(set(threading.enumerate()) - before) >= 5
    left = [thread.name for thread in set(threading.enumerate()) - before if thread.is_alive()]
    assert left == []
    assert session.wait(-1, 60.0) >= 0, "a page that waits is woken"

"""A worker's cameras without its loop, with a real task and renderer and a manual clock."""

from __future__ import annotations

import mmap
import os
import pickle
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest

from tests.drive.render_device import RENDER_BACKEND, RENDER_DEVICE
from workbench.app.worker.questions import QUESTIONS
from workbench.cameras import worker as under_test
from workbench.cameras.questions import DrawCamera, MeasureCamera, RunCameras
from workbench.cameras.worker import WorkerCameras, run_cameras
from workbench.envs.camera_data import CameraKey, CameraSettings, Picture
from workbench.envs.rendering.drawing import CannotDraw
from workbench.live.messages import (
    CameraFailed,
    CameraRequest,
    CannotAnswer,
    DrawPast,
    Event,
    PastPictures,
    Pictures,
    PlaceCamera,
    Placed,
    TaskFailed,
)
from workbench.live.process.heartbeat import HeartbeatReader, HeartbeatWriter, Interrupts
from workbench.live.worker.connection import ServerConnection
from workbench.live.worker.guarded_task import GuardedTask
from workbench.live.worker.step_events import StepEvents
from workbench.machine.processes.wire import MessageSocket
from workbench.record.questions import CaptureMoment
from workbench.task.description import TaskOptions
from workbench.task.open import OpenedTask, open_task

pytestmark = pytest.mark.usefixtures("renderer")

BASE: CameraKey = ("sensor", "base_camera")
PEOPLE: CameraKey = ("human", "render_camera")
SENSOR, HUMAN = CameraRequest("base_camera", "sensor"), CameraRequest("render_camera", "human")
NOTHING = CameraRequest("nothing", "sensor")


@dataclass
class Clock:
    now: float = 1000.0
    tick: float = 0.0
    """Seconds by which every read advances the clock."""

    def monotonic(self) -> float:
        self.now += self.tick
        return self.now


class Desk:
    """A worker's cameras, and the events that the server receives from them."""

    def __init__(self, opened: OpenedTask, clock: Clock) -> None:
        ours, theirs = socket.socketpair()
        self.clock, self.server = clock, MessageSocket(ours, get_args(Event))
        heartbeat = os.memfd_create("pulse")
        os.ftruncate(heartbeat, mmap.PAGESIZE)
        self.heartbeat, interrupts = HeartbeatReader(heartbeat), Interrupts()
        line = ServerConnection(theirs.detach(), interrupts, QUESTIONS)
        self.guarded = GuardedTask(line, interrupts, HeartbeatWriter(heartbeat), StepEvents(), lambda: None)
        os.close(heartbeat)
        self.opened = self.guarded.opened = opened
        self.first: list[bool] = []
        self.cameras = WorkerCameras(self.guarded, self.first.append)

    def received(self) -> list[Any]:
        events = []
        while (event := self.server.receive(0.0)) is not None:
            events.append(event)
        return events

    def iterate(self) -> list[Any]:
        """Run one idle iteration of the loop and return the received events."""
        self.cameras.make(may_block=True)
        return self.received()

    def wait(self) -> float | None:
        return self.cameras.wait(self.clock.now)

    def placed(self, key: CameraKey, **changes: Any) -> CameraSettings:
        info = self.opened.description.camera(key)
        assert info is not None and info.settings is not None
        return replace(info.settings, **changes)


@pytest.fixture(scope="module")
def opened(renderer: None, task_file: Path) -> Iterator[OpenedTask]:
    small = task_file.with_name("small.py")
    small.write_text(task_file.read_text().replace("512", "64"))
    opened = open_task(
        str(small), TaskOptions(2, env_kwargs={"obs_mode": "rgb", "render_backend": RENDER_BACKEND})
    )
    yield opened
    opened.env.close()


@pytest.fixture
def desk(opened: OpenedTask, monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    clock = Clock()
    monkeypatch.setattr(under_test, "time", SimpleNamespace(monotonic=clock.monotonic))
    desk = Desk(opened, clock)
    yield desk
    for key in (BASE, PEOPLE):
        desk.cameras.place_now(desk.opened, PlaceCamera(key, None))
    desk.server.end.close()


def shown(events: list[Any]) -> list[CameraKey]:
    """Return the cameras whose pictures the only event holds."""
    (event,) = events
    assert isinstance(event, Pictures)
    return [(picture.kind, picture.camera) for picture in event.pictures]


def test_sensors_come_first_and_each_kind_is_sent_when_ready(desk: Desk) -> None:
    assert desk.wait() is None and desk.iterate() == [], "no page watches a camera"
    desk.cameras.watch(1, (HUMAN, NOTHING, SENSOR))
    assert desk.wait() == 0.0
    assert desk.iterate() == [] and desk.first == [False]
    assert shown(desk.iterate()) == [BASE] and desk.first == [False, True]
    (human,) = desk.iterate()
    assert [picture.env for picture in human.pictures] == [1] and shown([human]) == [PEOPLE]
    assert desk.wait() is None and desk.iterate() == [], "the pictures are current"
    assert desk.first == [False, True] and desk.heartbeat.read().doing == "drawing"


@pytest.mark.skipif(RENDER_DEVICE == "cuda", reason="a GPU draws exact pictures throughout")
def test_pictures_are_fast_during_motion_and_exact_at_rest(desk: Desk) -> None:
    def next_picture(*degree: str) -> Any:
        desk.iterate()
        (pictures,) = desk.iterate()
        assert not degree or (pictures.pictures[0].degree,) == degree
        return pictures.pictures[0].rgb.astype(int)

    desk.cameras.watch(0, (SENSOR,))
    exact = next_picture("exact")
    desk.cameras.watch(0, (SENSOR,), "auto")
    assert desk.wait() is None, "nothing moved, and the shown picture is exact"
    desk.cameras.scene_changed()
    desk.clock.now += 1.0
    next_picture()  # the meshes may have to be simplified first
    for thread in threading.enumerate():
        if thread.name == under_test.SIMPLIFYING:
            thread.join()
    desk.cameras.scene_changed()
    desk.clock.now += 1.0
    off = np.abs(next_picture("fast") - exact)
    assert off.any() and off.mean() < 2
    assert desk.wait() == pytest.approx(0.3)
    desk.clock.now += 0.31
    np.testing.assert_array_equal(next_picture("exact"), exact)
    assert desk.wait() is None, "nothing to draw until something moves again"


def test_the_last_waiting_placement_is_made_after_the_picture_and_drawn_first(
    desk: Desk,
) -> None:
    desk.cameras.watch(0, (SENSOR, HUMAN))
    desk.iterate()
    first, last = (desk.placed(PEOPLE, position=(0.5, 0.1 * k, 0.7)) for k in (1, 2))
    for settings in (first, last):
        desk.cameras.place(PlaceCamera(PEOPLE, settings))
    assert not desk.cameras.placing_due, "a picture is being drawn"
    assert shown(desk.iterate()) == [BASE]
    assert shown(desk.iterate()) == [PEOPLE]
    assert desk.cameras.placing_due
    desk.cameras.place_waiting()
    (placed,) = desk.received()
    assert isinstance(placed, Placed) and placed.settings == last and not placed.why_not
    assert not desk.cameras.placing_due and desk.wait() == 0.0, "the new picture must be drawn at once"
    assert desk.iterate() == []
    (pictures,) = desk.iterate()
    assert shown([pictures]) == [PEOPLE], "only the placed camera is drawn"
    assert np.allclose(pictures.pictures[0].pose[:3], last.position, atol=1e-5)
    assert desk.wait() != 0.0, "the other cameras wait for a pause"
    desk.clock.now += 1.0
    assert desk.iterate() == [] and shown(desk.iterate()) == [BASE]


def test_a_resized_sensor_changes_the_observation_and_a_missing_one_is_refused(
    desk: Desk,
) -> None:
    answer = desk.cameras.place_now(desk.opened, PlaceCamera(BASE, desk.placed(BASE, width=40, height=24)))
    assert answer.reshaped and answer.info is not None and (answer.info.width, answer.info.height) == (40, 24)
    assert desk.opened.env.obs["sensor_data"]["base_camera"]["rgb"].shape == (2, 24, 40, 3)
    wrong = desk.cameras.place_now(desk.opened, PlaceCamera(("sensor", "nothing"), desk.placed(BASE)))
    assert "nothing" in wrong.why_not and wrong.info is None


def test_a_past_step_is_drawn_after_waiting_placements_and_failures_are_sent(desk: Desk) -> None:
    there = desk.placed(BASE, position=(0.4, 0.1, 0.7))
    desk.cameras.watch(0, (SENSOR,))
    desk.iterate()
    desk.cameras.place(PlaceCamera(BASE, there))
    poses = desk.opened.first.poses[1]
    desk.cameras.draw_past(DrawPast(poses, 1, (SENSOR,), 7))
    placed, past = desk.received()
    assert isinstance(placed, Placed) and isinstance(past, PastPictures) and past.origin == 7
    assert np.allclose(past.pictures[0].pose[:3], there.position, atol=1e-5)
    desk.cameras.draw_past(DrawPast(poses, 1, (NOTHING,), 8))
    (failed,) = desk.received()
    assert isinstance(failed, TaskFailed) and "nothing" in failed.problem.message
    assert desk.iterate() == [] and shown(desk.iterate()) == [BASE], (
        "the interrupted picture must be drawn again"
    )


def test_hooks_of_an_edited_text_leave_no_attribute_on_the_running_env(opened: OpenedTask) -> None:
    file, env = str(opened.loaded.file), opened.env.env
    look = "pose = sapien_utils.look_at(eye=[0.45, 0, 0.6]"
    assert look in opened.loaded.source[file]
    text = opened.loaded.source[file].replace(
        look, "self.tried = [0.1, 0, 0.9]\n        pose = sapien_utils.look_at(eye=self.tried"
    )
    names = set(vars(env))
    found = run_cameras(opened, RunCameras(file, {file: text})).cameras[BASE].settings
    assert found is not None and found.position == pytest.approx((0.1, 0, 0.9))
    assert set(vars(env)) == names


def test_a_moment_is_captured_with_pictures_of_the_given_envs(desk: Desk) -> None:
    snapshot = pickle.dumps(desk.opened.env.snapshot())
    with_pictures = desk.cameras.capture(desk.opened, CaptureMoment(snapshot, (1,), pictures=True))
    assert {(picture.kind, picture.env) for picture in with_pictures.pictures} == {
        ("sensor", 1),
        ("human", 1),
    }
    without = desk.cameras.capture(desk.opened, CaptureMoment(snapshot, (1,), pictures=False))
    assert without.pictures == () and without.columns.keys() == with_pictures.columns.keys()


# --- answers to questions ------------------------------------------------------------------------------


def no_progress(done: int, total: int) -> None:
    pass


def test_a_scaled_picture_has_its_own_size_and_the_asked_modalities(desk: Desk) -> None:
    settings = desk.placed(BASE, width=60, height=40)

    def drawn(scale: float, *modalities: str, key: CameraKey = BASE, env: int = 1) -> Any:
        question = DrawCamera(key, settings, env, modalities, scale=scale)
        return desk.cameras.answer(desk.opened, question, no_progress)

    half = drawn(0.5, "rgb", "depth", "segmentation")
    assert (half.camera, half.kind, half.env) == ("base_camera", "sensor", 1)
    assert half.rgb.shape == (20, 30, 3) and half.depth.shape == half.segmentation.shape == (20, 30)
    assert np.allclose(half.pose, [*settings.position, *settings.quaternion], atol=1e-6)
    double = drawn(2.0)
    assert double.rgb.shape == (80, 120, 3) and double.depth is None and double.segmentation is None
    new = drawn(1.0, "rgb", key=("sensor", "new"))
    assert new.camera == "new" and new.rgb.shape == (40, 60, 3), "a camera that the env does not have"
    assert np.abs(new.rgb.astype(int)[1::2, 1::2] - half.rgb).mean() < 25, "the same view"
    for scale in (0.0, -1.0, 4.5):
        with pytest.raises(CannotAnswer):
            drawn(scale)
    with pytest.raises(CannotAnswer):
        desk.cameras.answer(desk.opened, DrawCamera(("sensor", "new"), None, 0), no_progress)
    with pytest.raises(CannotAnswer):
        drawn(0.5, env=2)
    assert desk.heartbeat.read().doing == "idle"


def test_a_picture_with_other_settings_leaves_the_camera_where_it_is(desk: Desk) -> None:

    def pose(settings: CameraSettings | None, env: int = 1, poses: Any = None) -> list[float]:
        question = DrawCamera(BASE, settings, env, ("rgb", "albedo"), poses)
        picture = desk.cameras.answer(desk.opened, question, no_progress)
        assert isinstance(picture, Picture) and picture.env == env and picture.rgb is not None
        return picture.pose[:3].tolist()

    there, other = (desk.placed(BASE, position=(0.4, y, 0.7)) for y in (0.1, 0.3))
    before = pose(None)
    assert pose(other) == pytest.approx(other.position) and pose(None) == pytest.approx(before)
    desk.cameras.place_now(desk.opened, PlaceCamera(BASE, there))
    assert pose(other) == pytest.approx(other.position) and pose(None) == pytest.approx(there.position)
    assert desk.cameras.placed == {BASE: there}
    with pytest.raises(CannotAnswer):
        desk.cameras.answer(desk.opened, DrawCamera(BASE, replace(other, near=20.0), 0), no_progress)
    assert pose(None) == pytest.approx(there.position), "after a failure too"


def test_an_env_is_measured_with_the_given_settings_and_poses(desk: Desk) -> None:

    def measured(settings: CameraSettings | None = None, env: int = 1, poses: Any = None) -> Any:
        return desk.cameras.answer(desk.opened, MeasureCamera(BASE, settings, env, poses), no_progress)

    (cube,) = measured().wanted_objects(["cube"])
    assert cube.pixels[0] > 0 and measured().envs == (1,)
    sky = desk.placed(BASE, quaternion=(0.7071067811865476, 0.0, -0.7071067811865476, 0.0))
    assert measured(sky).wanted_objects(["cube"])[0].pixels[0] == 0
    large = desk.placed(BASE, width=512, height=256)
    assert (measured(large).size, measured(large).measured_size) == ((512, 256), (256, 128))
    poses = desk.opened.first.poses[1].copy()
    poses[list(desk.opened.description.geometry.body_names).index("cube"), 2] += 50.0
    assert measured(poses=poses).wanted_objects(["cube"])[0].pixels[0] == 0
    with pytest.raises(CannotAnswer):
        measured(env=2)


def test_placements_are_put_back_or_forgotten_and_an_unknown_camera_is_told(desk: Desk) -> None:
    there = desk.placed(PEOPLE, position=(0.5, 0.2, 0.7))
    desk.cameras.place(PlaceCamera(PEOPLE, there))
    desk.cameras.place(PlaceCamera(("sensor", "gone"), there))
    desk.cameras.settle()
    first, second = desk.received()
    assert (first.key, first.settings, first.why_not) == (PEOPLE, there, "") and first.info.key == PEOPLE
    assert second.key == ("sensor", "gone") and second.why_not and second.settings == there
    assert desk.cameras.placed == {PEOPLE: there}
    desk.cameras.put_back()
    assert desk.cameras.placed == {PEOPLE: there}
    desk.cameras.place_now(desk.opened, PlaceCamera(PEOPLE, None))
    assert desk.cameras.placed == {}
    desk.cameras.place_now(desk.opened, PlaceCamera(PEOPLE, there))
    desk.cameras.forget_placed()
    assert desk.cameras.placed == {}


def test_a_placed_camera_is_drawn_again_and_one_that_cannot_be_drawn_is_no_longer_watched(desk: Desk) -> None:
    desk.cameras.watch(1, (SENSOR, HUMAN))
    for _ in range(3):
        desk.iterate()
    desk.clock.now += 1.0
    assert desk.wait() is None
    desk.cameras.failed(CannotDraw("It hangs.", BASE, None))
    (failed,) = desk.received()
    assert isinstance(failed, CameraFailed) and failed.key == BASE and "It hangs." in failed.why
    desk.clock.now += 1.0
    assert desk.iterate() == [] and shown(desk.iterate()) == [PEOPLE]
    desk.clock.now += 1.0
    assert desk.wait() is None
    desk.cameras.watch(1, (SENSOR, HUMAN))
    assert desk.wait() is None, "nothing has changed"
    desk.cameras.watch(0, (SENSOR,))
    assert desk.wait() == 0.0 and desk.iterate() == []
    (pictures,) = desk.iterate()
    assert shown([pictures]) == [BASE] and pictures.pictures[0].env == 0
    desk.cameras.watch(7, (SENSOR,))
    assert desk.iterate() == []
    (pictures,) = desk.iterate()
    assert pictures.pictures[0].env == 1, "the last one, while the task has fewer envs"

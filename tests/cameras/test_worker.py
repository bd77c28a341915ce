"""A worker's cameras without its loop: a real task and renderer, and a clock that goes when the test says so."""

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
from workbench.cameras.worker import WorkerCameras
from workbench.envs.camera_data import CameraKey, CameraSettings
from workbench.live.messages import (
    CameraRequest,
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
    """By how much every look at it moves it on."""

    def monotonic(self) -> float:
        self.now += self.tick
        return self.now


class Desk:
    """A worker's cameras, and what the server hears of them."""

    def __init__(self, opened: OpenedTask, clock: Clock) -> None:
        ours, theirs = socket.socketpair()
        self.clock, self.server = clock, MessageSocket(ours, get_args(Event))
        heartbeat = os.memfd_create("pulse")
        os.ftruncate(heartbeat, mmap.PAGESIZE)
        self.heartbeat, interrupts = HeartbeatReader(heartbeat), Interrupts()
        line = ServerConnection(theirs.detach(), interrupts, QUESTIONS)
        self.held = GuardedTask(line, interrupts, HeartbeatWriter(heartbeat), StepEvents(), lambda: None)
        os.close(heartbeat)
        self.held.opened = opened
        self.first: list[bool] = []
        self.cameras = WorkerCameras(self.held, self.first.append)

    def heard(self) -> list[Any]:
        events = []
        while (event := self.server.receive(0.0)) is not None:
            events.append(event)
        return events

    def makes(self) -> list[Any]:
        """What is heard of one turn of the loop that has nothing else to do."""
        self.cameras.make(may_block=True)
        return self.heard()

    def wait(self) -> float | None:
        return self.cameras.wait(self.clock.now)

    def placed(self, key: CameraKey, **changes: Any) -> CameraSettings:
        assert self.held.opened is not None
        info = self.held.opened.description.camera(key)
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
    desk.held.opened = opened
    for key in (BASE, PEOPLE):
        desk.cameras.place_now(opened, PlaceCamera(key, None))
    desk.server.end.close()


def shown(events: list[Any]) -> list[CameraKey]:
    """Of the only event: the cameras that it has pictures of."""
    (event,) = events
    assert isinstance(event, Pictures)
    return [(picture.kind, picture.camera) for picture in event.pictures]


def test_sensors_come_first_and_each_kind_as_soon_as_it_is_there(desk: Desk) -> None:
    assert desk.wait() is None and desk.makes() == [], "nobody looks"
    desk.cameras.watch(1, (HUMAN, NOTHING, SENSOR))
    assert desk.wait() == 0.0
    assert desk.makes() == [] and desk.first == [False]
    assert shown(desk.makes()) == [BASE] and desk.first == [False, True]
    (human,) = desk.makes()
    assert [picture.env for picture in human.pictures] == [1] and shown([human]) == [PEOPLE]
    assert desk.wait() is None and desk.makes() == [], "they are of the moment that is"
    assert desk.first == [False, True] and desk.heartbeat.read().doing == "drawing"


@pytest.mark.skipif(RENDER_DEVICE == "cuda", reason="a GPU draws exact pictures throughout")
def test_pictures_are_fast_while_something_moves_and_exact_when_it_stands_still(desk: Desk) -> None:
    def next_picture(*degree: str) -> Any:
        desk.makes()
        (pictures,) = desk.makes()
        assert not degree or (pictures.pictures[0].degree,) == degree
        return pictures.pictures[0].rgb.astype(int)

    desk.cameras.watch(0, (SENSOR,))
    exact = next_picture("exact")
    desk.cameras.watch(0, (SENSOR,), "auto")
    assert desk.wait() is None, "nothing moved, and what is shown is exact"
    desk.cameras.scene_changed()
    desk.clock.now += 1.0
    next_picture()  # the meshes may have to be made first
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
    assert desk.wait() is None, "until something moves again"


def test_of_placements_that_wait_the_last_is_made_after_the_picture_and_its_picture_comes_first(
    desk: Desk,
) -> None:
    desk.cameras.watch(0, (SENSOR, HUMAN))
    desk.makes()
    first, last = (desk.placed(PEOPLE, position=(0.5, 0.1 * k, 0.7)) for k in (1, 2))
    for settings in (first, last):
        desk.cameras.place(PlaceCamera(PEOPLE, settings))
    assert not desk.cameras.placing_due, "a picture is under way"
    assert shown(desk.makes()) == [BASE]
    assert shown(desk.makes()) == [PEOPLE]
    assert desk.cameras.placing_due
    desk.cameras.place_waiting()
    (placed,) = desk.heard()
    assert isinstance(placed, Placed) and placed.settings == last and not placed.why_not
    assert not desk.cameras.placing_due and desk.wait() == 0.0, "without a pause"
    assert desk.makes() == []
    (pictures,) = desk.makes()
    assert shown([pictures]) == [PEOPLE], "alone"
    assert np.allclose(pictures.pictures[0].pose[:3], last.position, atol=1e-5)
    assert desk.wait() != 0.0, "the others when it rests"
    desk.clock.now += 1.0
    assert desk.makes() == [] and shown(desk.makes()) == [BASE]


def test_a_sensor_of_another_size_is_observed_in_it_and_one_that_is_not_there_is_not_placed(
    desk: Desk,
) -> None:
    opened = desk.held.opened
    assert opened is not None
    answer = desk.cameras.place_now(opened, PlaceCamera(BASE, desk.placed(BASE, width=40, height=24)))
    assert answer.reshaped and answer.info is not None and (answer.info.width, answer.info.height) == (40, 24)
    assert opened.env.obs["sensor_data"]["base_camera"]["rgb"].shape == (2, 24, 40, 3)
    wrong = desk.cameras.place_now(opened, PlaceCamera(("sensor", "nothing"), desk.placed(BASE)))
    assert "nothing" in wrong.why_not and wrong.info is None


def test_a_moment_of_the_past_is_drawn_after_what_waits_and_a_failure_is_told(desk: Desk) -> None:
    opened = desk.held.opened
    assert opened is not None
    there = desk.placed(BASE, position=(0.4, 0.1, 0.7))
    desk.cameras.watch(0, (SENSOR,))
    desk.makes()
    desk.cameras.place(PlaceCamera(BASE, there))
    poses = opened.first.poses[1]
    desk.cameras.draw_past(DrawPast(poses, 1, (SENSOR,), 7))
    placed, past = desk.heard()
    assert isinstance(placed, Placed) and isinstance(past, PastPictures) and past.origin == 7
    assert np.allclose(past.pictures[0].pose[:3], there.position, atol=1e-5)
    desk.cameras.draw_past(DrawPast(poses, 1, (NOTHING,), 8))
    (failed,) = desk.heard()
    assert isinstance(failed, TaskFailed) and "nothing" in failed.problem.message
    assert desk.makes() == [] and shown(desk.makes()) == [BASE], "the one that was left is made anew"


def test_a_moment_is_captured_with_pictures_of_the_envs_that_are_named(desk: Desk) -> None:
    opened = desk.held.opened
    assert opened is not None
    snapshot = pickle.dumps(opened.env.snapshot())
    with_pictures = desk.cameras.capture(opened, CaptureMoment(snapshot, (1,), pictures=True))
    assert {(picture.kind, picture.env) for picture in with_pictures.pictures} == {
        ("sensor", 1),
        ("human", 1),
    }
    without = desk.cameras.capture(opened, CaptureMoment(snapshot, (1,), pictures=False))
    assert without.pictures == () and without.columns.keys() == with_pictures.columns.keys()

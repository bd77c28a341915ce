"""Placing the chosen camera in the view, from a page over a real socket: drags of the handles, keys, and looking through it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
import pytest
import viser
import websockets.sync.client
from numpy.typing import ArrayLike
from websockets.sync.connection import Connection

from tests.drive.live import Live
from tests.drive.scenes import camera, running, table_scene
from tests.drive.tabs import camera_message, handshake
from tests.drive.waiting import until
from workbench.cameras.commands import (
    AddCamera,
    ChooseAxes,
    ChooseHandles,
    ChooseSnap,
    MoveCameraBack,
    MoveCameraDown,
    MoveCameraForward,
    MoveCameraLeft,
    MoveCameraRight,
    MoveCameraToView,
    MoveCameraUp,
    ToggleLookThrough,
    TurnCameraDown,
    TurnCameraLeft,
    TurnCameraRight,
    TurnCameraUp,
)
from workbench.cameras.events import CameraPlaced, EditWanted
from workbench.cameras.studio_panel import TAB
from workbench.cameras.view import StudioCamera, StudioView
from workbench.envs.camera_data import CameraSettings
from workbench.live.env_commands import ShowEnvs
from workbench.live.view import SessionView
from workbench.machine.loop import do, result_of
from workbench.page.command import Command
from workbench.page.commands import TellOpenTab
from workbench.page.scene.env_grid import lay_out
from workbench.page.widgets.visitors import Visitor
from workbench.pictures.camera_conventions import (
    LookAt,
    axes_of,
    compose,
    make_pose,
    pose_from_look_at,
    pose_of,
    quaternion_from_rpy,
    relative_to,
    target_of,
    with_pose,
)

ENVS, ENV = 4, 2
EYE, TARGET = (0.45, 0.12, 0.6), (0.06, -0.12, 0.13)
LENS = CameraSettings((0, 0, 0), (1, 0, 0, 0), 1.0, None, 80, 60, 0.01, 10.0, "minimal")
FILE = replace(with_pose(LENS, pose_from_look_at(LookAt(EYE, TARGET))), distance=math.dist(EYE, TARGET))
UNTURNED = (1.0, 0.0, 0.0, 0.0)
QUARTER = quaternion_from_rpy(0, 0, 90)
KEY = camera().key
MOUNT = make_pose((0.3, -0.2, 0.4), quaternion_from_rpy(10, 20, 130)).astype(np.float32)
OFFSET = lay_out(*table_scene(ENVS)).offsets[ENV].astype(np.float64)
VIEW = 800, 720
"""Width and height of the page's view."""


def chosen(
    now: CameraSettings = FILE, mount: np.ndarray | None = None, past: bool = False, refused: str = ""
) -> SessionView:
    info = replace(camera(), settings=FILE, mount=None if mount is None else "arm/hand", width=80, height=60)
    one = StudioCamera(KEY, info, now, now != FILE, mount, refused)
    view = running(ENVS, selected_env=ENV, studio=StudioView(cameras=(one,), selected=KEY))
    assert view.task is not None
    timeline = replace(view.timeline, shown=3) if past else view.timeline
    return replace(view, task=replace(view.task, cameras=(info,)), timeline=timeline)


@dataclass
class Page:
    live: Live
    socket: Connection
    client: viser.ClientHandle
    visitor: Visitor
    width: int = VIEW[0]

    def ask(self, command: Command) -> str:
        return result_of(self.live.visitors.ask(command, self.visitor))

    def stands(self, position: ArrayLike) -> None:
        """The user moves the view; returns when everything sent before has been handled."""
        at = np.asarray(position, np.float64)
        self.width = VIEW[0] if self.width != VIEW[0] else VIEW[0] + 1
        self.socket.send(camera_message(at.tolist(), self.width))
        until(lambda: self.client.camera.image_width == self.width, "the page's messages")
        do(lambda: None)

    def handle(self, name: str) -> Any:
        return self.client.scene.get_handle_by_name(f"/studio/{name}")

    def begin(self, name: str) -> None:
        self._send("DragStart", name)

    def move(self, name: str, position: ArrayLike, wxyz: ArrayLike = UNTURNED) -> None:
        numbers = {
            "position": tuple(map(float, np.asarray(position))),
            "wxyz": tuple(map(float, np.asarray(wxyz))),
        }
        self._send("Update", name, **numbers)

    def release(self, name: str) -> None:
        self._send("DragEnd", name)

    def _send(self, kind: str, name: str, **more: Any) -> None:
        owner = str(self.client.client_id)
        message = {
            "type": f"TransformControls{kind}Message",
            "name": f"/studio/{name}",
            "owner": owner,
            **more,
        }
        self.socket.send(msgspec.msgpack.encode(message))
        self.stands((9.0, 9.0, 9.0))

    def placed(self) -> list[CameraPlaced]:
        asked = [one for one in self.live.asked if isinstance(one, CameraPlaced)]
        self.live.asked.clear()
        return asked


@pytest.fixture(scope="module")
def connected(open_live: Live) -> Iterator[Page]:
    address, arguments = handshake(f"http://127.0.0.1:{open_live.server.get_port()}")
    with websockets.sync.client.connect(address, close_timeout=0.1, **arguments) as socket:
        socket.send(camera_message((9.0, 9.0, 9.0)))
        ours = {id(one) for one in open_live.visitors.all()}
        until(
            lambda: len(open_live.visitors.all()) > len(ours) and open_live.server.get_clients(), "the page"
        )
        (visitor,) = (one for one in open_live.visitors.all() if one is not open_live.visitor)
        yield Page(open_live, socket, visitor.client, visitor)


@pytest.fixture
def page(connected: Page) -> Page:
    """The page with its Cameras tab open and all envs in the view."""
    connected.ask(TellOpenTab(tab=TAB))
    for command in (
        ShowEnvs(all_envs=True),
        ChooseHandles(look_at=False),
        ChooseAxes(own=False),
        ChooseSnap(snap="none"),
    ):
        connected.live.do(command)
    connected.stands((9.0, 9.0, 9.0))
    connected.live.show(chosen())
    connected.live.asked.clear()
    return connected


def in_view(settings: CameraSettings, mount: np.ndarray | None = None) -> np.ndarray:
    pose = pose_of(settings) if mount is None else compose(mount, pose_of(settings))
    pose[:3] += OFFSET
    return pose


def assert_stands(settings: CameraSettings, pose: ArrayLike, mount: np.ndarray | None = None) -> None:
    """Assert that the camera is at this pose in the view."""
    wanted, found = np.asarray(pose), in_view(settings, mount)
    np.testing.assert_allclose(found[:3], wanted[:3], atol=1e-6)
    np.testing.assert_allclose(axes_of(found[3:]), axes_of(wanted[3:]), atol=1e-6)


@pytest.mark.parametrize("mount", [None, MOUNT], ids=["fixed", "mounted"])
@pytest.mark.parametrize("own", [False, True], ids=["world", "own"])
def test_a_dragged_camera_follows_the_handle_in_one_step_of_undo(page: Page, own: bool, mount: Any) -> None:
    page.live.do(ChooseAxes(own=own))
    page.live.show(chosen(mount=mount))
    pose, handle = in_view(FILE, mount), page.handle("camera")
    np.testing.assert_allclose(handle.position, pose[:3], atol=1e-6)
    np.testing.assert_allclose(handle.wxyz, pose[3:] if own else UNTURNED, atol=1e-6)
    page.begin("camera")
    assert page.placed() == []
    turned = make_pose((0, 0, 0), QUARTER)
    rolled = compose(pose, make_pose((0, 0, 0), quaternion_from_rpy(30, 0, 0)))
    for x in (0.1, 0.2):
        there = pose[:3] + [x, 0.0, -0.05]
        page.move("camera", there, rolled[3:] if own else QUARTER)
        wanted = rolled[3:] if own else compose(turned, make_pose((0, 0, 0), pose[3:]))[3:]
        assert_stands(now(page), [*there, *wanted], mount)
        page.live.show(chosen(now(page), mount))
        np.testing.assert_allclose(handle.position, there, err_msg="it is pulled from the pointer")
    page.release("camera")
    first, last = page.placed()
    assert first.control == last.control and first.pause == last.pause == math.inf and first.key == KEY
    assert last.settings.distance == pytest.approx(FILE.distance)
    page.live.show(chosen(FILE, mount))
    np.testing.assert_allclose(handle.position, pose[:3], atol=1e-6)
    page.begin("camera")
    page.move("camera", pose[:3] + [0.0, 0.0, 0.3], pose[3:] if own else UNTURNED)
    page.release("camera")
    (second,) = page.placed()
    assert_stands(second.settings, [*(pose[:3] + [0.0, 0.0, 0.3]), *pose[3:]], mount)
    assert second.control != first.control, "another drag is another step of undo"
    page.begin("camera")  # its release does not arrive
    page.begin("camera")
    page.move("camera", pose[:3] + [0.1, 0.0, 0.0], pose[3:] if own else UNTURNED)
    page.begin("camera")
    page.move("camera", pose[:3] + [0.2, 0.0, 0.0], pose[3:] if own else UNTURNED)
    page.release("camera")
    third, fourth = page.placed()
    assert third.control != fourth.control


def now(page: Page) -> CameraSettings:
    placed = [one for one in page.live.asked if isinstance(one, CameraPlaced)]
    return placed[-1].settings if placed else FILE


def test_a_snapped_drag_ends_on_the_grid_of_the_env_or_on_steps_of_the_camera(page: Page) -> None:
    page.live.do(ChooseSnap(snap="5 cm, 15°"))
    pose = in_view(FILE)
    page.begin("camera")
    page.move("camera", pose[:3] + [0.02, 0.0, -0.06], quaternion_from_rpy(0, 0, 20))
    page.release("camera")
    (placed,) = page.placed()
    np.testing.assert_allclose(placed.settings.position, [0.45, EYE[1], 0.55], atol=1e-6)
    turned = compose(make_pose((0, 0, 0), quaternion_from_rpy(0, 0, 15)), make_pose((0, 0, 0), pose[3:]))
    np.testing.assert_allclose(axes_of(placed.settings.quaternion), axes_of(turned[3:]), atol=1e-6)
    page.live.do(ChooseAxes(own=True))
    page.live.show(chosen())
    page.begin("camera")
    local = compose(pose, make_pose((0.06, -0.02, 0.08), UNTURNED))
    page.move("camera", local[:3], pose[3:])
    page.release("camera")
    (placed,) = page.placed()
    step = relative_to(pose_of(FILE), pose_of(placed.settings))
    np.testing.assert_allclose(step[:3], [0.05, 0.0, 0.1], atol=1e-6)
    assert placed.settings.quaternion == FILE.quaternion
    page.live.do(ChooseHandles(look_at=True))
    page.live.show(chosen())
    target = target_of(FILE) + OFFSET
    page.begin("target")
    page.move("target", target + [0.07, 0.0, 0.0])
    page.release("target")
    (placed,) = page.placed()
    assert_aims(placed.settings, pose[:3], [OFFSET[0] + 0.15, *target[1:]], None)


@pytest.mark.parametrize("mount", [None, MOUNT], ids=["fixed", "mounted"])
def test_dragging_the_eye_keeps_the_target_and_dragging_the_target_keeps_the_eye(
    page: Page, mount: Any
) -> None:
    page.live.do(ChooseHandles(look_at=True))
    page.live.show(chosen(mount=mount))
    assert [page.handle(name).visible for name in ("camera", "eye", "target")] == [False, True, True]
    eye = in_view(FILE, mount)[:3]
    target = in_view(replace(FILE, position=tuple(target_of(FILE).tolist())), mount)[:3]
    np.testing.assert_allclose(page.handle("eye").position, eye, atol=1e-6)
    np.testing.assert_allclose(page.handle("target").position, target, atol=1e-6)
    np.testing.assert_allclose(page.handle("line of sight").points, [[eye, target]], atol=1e-5)
    page.begin("eye")
    page.move("eye", eye + [0.1, 0.2, 0.1])
    page.live.show(chosen(now(page), mount))
    np.testing.assert_allclose(
        page.handle("line of sight").points, [[eye + [0.1, 0.2, 0.1], target]], atol=1e-5
    )
    page.release("eye")
    (placed,) = page.placed()
    assert_aims(placed.settings, eye + [0.1, 0.2, 0.1], target, mount)
    page.live.show(chosen(mount=mount))
    page.begin("target")
    page.move("target", target + [0.2, 0.0, -0.1])
    page.release("target")
    (placed,) = page.placed()
    assert_aims(placed.settings, eye, target + [0.2, 0.0, -0.1], mount)


def assert_aims(settings: CameraSettings, eye: ArrayLike, target: ArrayLike, mount: Any) -> None:
    """Assert eye and target in the view, and the target's distance."""
    pose, away = in_view(settings, mount), np.subtract(target, eye)
    np.testing.assert_allclose(pose[:3], np.asarray(eye), atol=1e-6)
    np.testing.assert_allclose(axes_of(pose[3:])[0], away / np.linalg.norm(away), atol=1e-6)
    assert settings.distance == pytest.approx(np.linalg.norm(away))


def test_a_refused_drag_ends_and_its_handle_returns_to_the_camera(page: Page) -> None:
    pose = in_view(FILE)
    page.begin("camera")
    page.move("camera", [5000.0, 0.0, 0.0])
    assert page.placed() == []
    page.live.again()
    np.testing.assert_allclose(page.handle("camera").position, pose[:3], atol=1e-6)


def test_handles_are_in_the_view_only_where_the_camera_can_be_dragged(page: Page) -> None:
    for view, there in (
        (chosen(), True),
        (chosen(past=True), False),
        (chosen(), True),
        (chosen(refused="it cannot"), False),
    ):
        page.live.show(view)
        assert page.handle("camera").visible is there
    page.live.show(chosen())
    page.begin("camera")
    page.ask(TellOpenTab(tab="Run"))
    page.live.again()
    assert page.handle("camera") is None, "there, a drag that should move the view would move the camera"
    page.ask(TellOpenTab(tab=TAB))
    page.live.again()
    assert page.handle("camera").visible


# --- keys --------------------------------------------------------------------------------------------

FORWARD, LEFT, UP = range(3)


@pytest.mark.parametrize(
    ("command", "axis", "metres"),
    [
        (MoveCameraForward(), FORWARD, 0.01),
        (MoveCameraBack(), FORWARD, -0.01),
        (MoveCameraLeft(), LEFT, 0.01),
        (MoveCameraRight(), LEFT, -0.01),
        (MoveCameraUp(), UP, 0.01),
        (MoveCameraDown(), UP, -0.01),
    ],
)
@pytest.mark.parametrize("look_at", [False, True])
def test_a_key_moves_the_camera_along_its_own_axis(
    page: Page, command: Command, axis: int, metres: float, look_at: bool
) -> None:
    page.live.do(ChooseHandles(look_at=look_at))
    page.live.do(command)
    (placed,) = page.placed()
    moved = np.subtract(placed.settings.position, FILE.position)
    np.testing.assert_allclose(moved, metres * axes_of(FILE.quaternion)[axis], atol=1e-9)
    if look_at:
        np.testing.assert_allclose(target_of(placed.settings), target_of(FILE), atol=1e-6)
    else:
        assert placed.settings.quaternion == FILE.quaternion
    assert placed.control and placed.pause < 10, "keys in quick succession are one step of undo"


@pytest.mark.parametrize(
    ("command", "axis", "sign"),
    [
        (TurnCameraLeft(), LEFT, 1),
        (TurnCameraRight(), LEFT, -1),
        (TurnCameraUp(), UP, 1),
        (TurnCameraDown(), UP, -1),
    ],
)
def test_a_key_turns_the_camera_by_a_degree_in_place(
    page: Page, command: Command, axis: int, sign: int
) -> None:
    page.live.do(command)
    (placed,) = page.placed()
    assert placed.settings.position == FILE.position
    axes = axes_of(FILE.quaternion)
    towards = axes_of(placed.settings.quaternion)[0] @ axes[axis]
    level = math.hypot(*axes[0][:2]) if axis == LEFT else 1.0  # it pans about the vertical
    assert towards == pytest.approx(sign * math.sin(math.radians(1)) * level, rel=1e-3)


def test_keys_move_no_camera_while_no_page_shows_it(page: Page) -> None:
    page.ask(TellOpenTab(tab="Run"))
    page.live.do(MoveCameraLeft())
    assert page.placed() == [] and page.live.client.notices.pop()
    page.ask(TellOpenTab(tab=TAB))
    page.live.show(chosen(refused="it cannot"))
    page.live.do(MoveCameraLeft())
    assert page.placed() == [] and page.live.client.notices.pop()


# --- the page's own viewpoint --------------------------------------------------------------------------


@pytest.mark.parametrize("mount", [None, MOUNT], ids=["fixed", "mounted"])
def test_a_camera_moves_to_the_view_of_the_page_that_asks(page: Page, mount: Any) -> None:
    page.live.show(chosen(mount=mount))
    at = OFFSET + [1.0, 2.0, 3.0]
    page.stands(at)
    assert page.ask(MoveCameraToView()) == ""
    (placed,) = page.placed()
    # The page's camera has OpenCV's axes: unturned, it looks along z, with its top towards -y.
    pose = in_view(placed.settings, mount)
    np.testing.assert_allclose(pose[:3], at, atol=1e-6)
    np.testing.assert_allclose(axes_of(pose[3:]), [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-6)


def test_an_added_camera_gets_the_view_of_the_page_that_asks_in_the_envs_frame(page: Page) -> None:
    page.stands(OFFSET + [1.0, 2.0, 3.0])
    assert page.ask(AddCamera(kind="human")) == ""
    (asked,) = page.live.asked
    assert isinstance(asked, EditWanted) and asked.request.settings is not None
    assert (asked.request.what, asked.request.key) == ("add", ("human", "render_camera"))
    np.testing.assert_allclose(asked.request.settings.position, [1.0, 2.0, 3.0], atol=1e-6)
    assert (asked.request.settings.width, asked.request.settings.height) == (512, 512)


def test_a_page_looks_through_the_camera_follows_it_and_returns(page: Page) -> None:
    at = np.array([4.0, 1.0, 2.0])
    page.stands(at)
    eye, scene = page.client.camera, page.live.server.scene
    before = [np.array(eye.position), np.array(eye.look_at), eye.fov]
    page.ask(ToggleLookThrough())
    page.live.again()
    assert_looks_through(page, FILE)
    assert np.allclose(eye.up_direction, [0, 0, 1]), "a level camera: a drag must not tilt the horizon"
    corners = scene.get_handle_by_name("/studio/border").points[:, 0]  # type: ignore[attr-defined]
    assert page.live.nodes("/cameras/") == [] and not page.handle("camera").visible
    depth = (corners - in_view(FILE)[:3]) @ axes_of(FILE.quaternion)[0]
    np.testing.assert_allclose(depth, depth[0], atol=1e-5)
    half = depth[0] * math.tan(0.5)
    np.testing.assert_allclose(
        (corners - in_view(FILE)[:3]) @ axes_of(FILE.quaternion)[2], [half, half, -half, -half], atol=1e-5
    )
    moved = replace(FILE, position=(0.5, 0.3, 0.7))
    page.live.show(chosen(moved))
    assert_looks_through(page, moved)
    for mount in (MOUNT, make_pose((0, 0, 1), MOUNT[3:]).astype(np.float32)):
        page.live.show(chosen(moved, mount))
        np.testing.assert_allclose(
            eye.position, in_view(moved, mount)[:3], atol=1e-5, err_msg="its mount moved"
        )
    page.live.show(chosen(moved))
    around = np.array(eye.position) + 0.5
    page.stands(around)
    page.live.again()
    np.testing.assert_allclose(eye.position, around, err_msg="the user may look around")
    assert page.live.nodes("/cameras/") == [] and not page.handle("camera").visible
    rolled = with_pose(FILE, compose(pose_of(FILE), make_pose((0, 0, 0), quaternion_from_rpy(40, 0, 0))))
    page.live.show(chosen(rolled))
    np.testing.assert_allclose(eye.up_direction, axes_of(rolled.quaternion)[2], atol=1e-6)
    page.ask(ToggleLookThrough())
    page.live.again()
    np.testing.assert_allclose(eye.position, before[0])
    np.testing.assert_allclose(eye.look_at, before[1], atol=1e-6)
    assert eye.fov == before[2] and np.allclose(eye.up_direction, [0, 0, 1])
    assert scene.get_handle_by_name("/studio/border") is None
    assert page.live.nodes("/cameras/") and page.handle("camera").visible


def assert_looks_through(page: Page, settings: CameraSettings) -> None:
    eye, pose = page.client.camera, in_view(settings)
    np.testing.assert_allclose(eye.position, pose[:3], atol=1e-6)
    np.testing.assert_allclose(eye.look_at, target_of(settings) + OFFSET, atol=1e-6)
    # The picture fits between the bars at the lower and upper edge, and fills the height or the width.
    tall, aspect = math.tan(eye.fov / 2), page.width / VIEW[1]
    high = math.tan(0.5) / tall
    wide = high * (80 / 60) / aspect
    assert max(high, wide) == pytest.approx((VIEW[1] - 96) / VIEW[1], rel=1e-6)


@pytest.mark.parametrize("other", ["none", "another"])
def test_a_page_returns_to_its_view_when_another_camera_is_chosen(page: Page, other: str) -> None:
    page.stands([4.0, 1.0, 2.0])
    page.ask(ToggleLookThrough())
    page.live.again()
    assert_looks_through(page, FILE)
    view = chosen()
    (one,) = view.of(StudioView).cameras
    studio = (
        StudioView()
        if other == "none"
        else StudioView((replace(one, key=("human", "people")),), ("human", "people"))
    )
    page.live.show(replace(view, features={**view.features, StudioView: studio}))
    np.testing.assert_allclose(page.client.camera.position, [4.0, 1.0, 2.0])
    page.live.show(chosen())
    np.testing.assert_allclose(
        page.client.camera.position, [4.0, 1.0, 2.0], err_msg="it does not look through again"
    )

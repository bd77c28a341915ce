"""Numbers of the chosen camera that are shown and typed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from tests.drive.panels import Panels
from tests.drive.waiting import until
from tests.ui.scenes import camera
from workbench.core.camera_data import CameraSettings, differences
from workbench.core.cameras.conventions import (
    LookAt,
    axes_of,
    intrinsic_of,
    matrix3,
    pose_from_look_at,
    rpy_of,
    target_of,
    with_pose,
)
from workbench.session.live.session import Session
from workbench.ui.cameras.fields import AXES, FOV, INTRINSIC, RPY, WXYZ, CameraNumbers
from workbench.ui.cameras.pose_math import Placing

EYE, TARGET = (0.45123456, 0.0, 0.61), (0.08, 0.0, 0.2)
LENS = CameraSettings((0, 0, 0), (1, 0, 0, 0), 1.0123456, None, 128, 96, 0.0123456, 10.0, "minimal")
FILE = replace(with_pose(LENS, pose_from_look_at(LookAt(EYE, TARGET))), distance=math.dist(EYE, TARGET))
MATRIX = replace(FILE, fov=None, intrinsic=((100.123, 0.0, 64.0), (0.0, 90.0, 48.0), (0.0, 0.0, 1.0)))


@dataclass
class Desk:
    session: Session
    numbers: CameraNumbers
    panels: Panels
    two_handles: list[bool]

    @property
    def now(self) -> CameraSettings:
        camera = self.session.view().studio.chosen
        assert camera is not None and camera.now is not None
        return camera.now

    def draw(self) -> None:
        self.numbers.draw(self.session.view().studio.placeable)

    def types(self, label: str, value: object) -> CameraSettings:
        """Type it, and wait until it is taken."""
        self.draw()
        before = self.session.view().studio.serial
        self.panels.set(label, value)

        def taken() -> bool:
            self.draw()
            return self.session.view().studio.serial > before or bool(self.panels.client.notices)

        until(taken, f"{label} being taken")
        return self.now


@pytest.fixture
def desk(scripted_session: Callable[..., Session], panels: Panels, request: pytest.FixtureRequest) -> Desk:
    info = replace(camera(), settings=request.param)
    session, two_handles = scripted_session(1, camera=info), [False]
    session.studio.select(info.key)
    numbers = CameraNumbers(panels.server, Placing(session), look_at=lambda: two_handles[0])
    desk = Desk(session, numbers, panels, two_handles)
    desk.draw()
    return desk


def shown(desk: Desk, label: str) -> Any:
    return desk.panels.control(label).value


with_a_fov, with_a_matrix = (
    pytest.mark.parametrize("desk", [settings], indirect=True, ids=[name])
    for settings, name in ((FILE, "fov"), (MATRIX, "matrix"))
)


@with_a_fov
def test_all_is_shown_as_it_is_and_of_the_lens_and_the_orientation_one_way_to_say_it(desk: Desk) -> None:
    said = {
        label: shown(desk, label)
        for label in (
            "Position",
            "Looks at",
            "Degrees",
            "Vertical fov",
            "Radians",
            "Width, height",
            "Near, far",
        )
    }
    assert said == {
        "Position": (0.4512, 0.0, 0.61),
        "Looks at": (0.08, 0.0, 0.2),
        "Degrees": pytest.approx((0.0, 47.84, 180.0)),
        "Vertical fov": 58.0,
        "Radians": 1.0123,
        "Width, height": (128.0, 96.0),
        "Near, far": (0.0123, 10.0),
    }
    assert shown(desk, "Lens as") == FOV and shown(desk, "Shader") == "minimal"
    assert not any(desk.panels.shows(label) for label in ("fx, fy", "cx, cy", "w x y z", "Forward", "Up"))
    desk.panels.set("Rotation", WXYZ)
    desk.draw()
    assert desk.panels.shows("w x y z") and not desk.panels.shows("Degrees")
    assert [float(word) for word in shown(desk, "w x y z").split()] == pytest.approx(
        FILE.quaternion, abs=1e-6
    )
    desk.panels.set("Rotation", AXES)
    desk.draw()
    forward, left, up = axes_of(FILE.quaternion)
    assert shown(desk, "Forward") == pytest.approx(forward, abs=1e-4)
    assert shown(desk, "Up") == pytest.approx(up, abs=1e-4)
    assert f"{left[1]:.4f}" in desk.panels.html("Left:")
    desk.numbers.draw(None)
    assert not desk.panels.shows("Position") and not desk.panels.shows("Lens as")


@with_a_fov
def test_what_is_typed_is_taken_and_what_is_shown_beside_it_stays_to_the_last_digit(desk: Desk) -> None:
    now = desk.types("Position", (0.4512, 0.1, 0.61))
    assert now == replace(FILE, position=(EYE[0], 0.1, EYE[2]))
    assert now.distance == FILE.distance, "what it looks at goes along"
    now = desk.types("Looks at", (0.0, 0.1, 0.3))
    assert now.position == (EYE[0], 0.1, EYE[2])
    np.testing.assert_allclose(target_of(now), (0.0, 0.1, 0.3), atol=1e-9)
    turned = rpy_of(now.quaternion)
    now = desk.types("Degrees", (round(turned[0], 2), round(turned[1], 2), 90.0))
    np.testing.assert_allclose(rpy_of(now.quaternion), (*turned[:2], 90.0), atol=1e-9)
    now = desk.types("Width, height", (64.0, 48.0))
    assert (now.width, now.height, now.fov) == (64, 48, FILE.fov)
    assert desk.types("Near, far", (0.0123, 5.0)).near == FILE.near and desk.now.far == 5.0
    assert desk.types("Vertical fov", 90.0).fov == pytest.approx(math.pi / 2)
    assert desk.types("Radians", 1.1).fov == 1.1
    assert desk.types("Shader", "default").shader_pack == "default"
    assert not desk.panels.client.notices


@with_a_fov
def test_an_orientation_is_typed_as_a_quaternion_or_by_its_axes(desk: Desk) -> None:
    desk.panels.set("Rotation", WXYZ)
    assert desk.types("w x y z", "[0.5, 0.5, 0.5, 0.5]").quaternion == (0.5, 0.5, 0.5, 0.5)
    desk.panels.set("Rotation", AXES)
    desk.types("Forward", (0.0, 0.6, -0.8))
    forward, _, up = axes_of(desk.now.quaternion)
    np.testing.assert_allclose(forward, (0.0, 0.6, -0.8), atol=1e-9)
    np.testing.assert_allclose(up, (1.0, 0.0, 0.0), atol=1e-9)
    desk.types("Up", (0.0, 0.8, 0.6))
    forward, _, up = axes_of(desk.now.quaternion)
    np.testing.assert_allclose([forward, up], [(0.0, 0.6, -0.8), (0.0, 0.8, 0.6)], atol=1e-9)
    desk.panels.set("Rotation", RPY)
    desk.draw()
    assert desk.panels.shows("Degrees")


@with_a_matrix
def test_a_lens_that_is_a_matrix_is_typed_in_pixels_and_is_of_another_size_the_same_view(desk: Desk) -> None:
    assert shown(desk, "Lens as") == INTRINSIC and not desk.panels.shows("Vertical fov")
    assert shown(desk, "fx, fy") == (100.12, 90.0) and shown(desk, "cx, cy") == (64.0, 48.0)
    now = desk.types("fx, fy", (100.12, 95.0))
    assert now.intrinsic == ((100.123, 0.0, 64.0), (0.0, 95.0, 48.0), (0.0, 0.0, 1.0))
    now = desk.types("cx, cy", (60.0, 48.0))
    assert now.intrinsic == ((100.123, 0.0, 60.0), (0.0, 95.0, 48.0), (0.0, 0.0, 1.0))
    now = desk.types("Width, height", (256.0, 192.0))
    assert now.intrinsic == matrix3(np.diag([2.0, 2.0, 1.0]) @ [(100.123, 0, 60), (0, 95, 48), (0, 0, 1)])
    now = desk.types("Lens as", FOV)
    assert now.intrinsic is None and now.fov == pytest.approx(2 * math.atan(48 / 95))
    now = desk.types("Lens as", INTRINSIC)
    assert now.fov is None and intrinsic_of(now)[1, 1] == pytest.approx(190.0)


@pytest.mark.parametrize(
    ("label", "value", "why"),
    [
        ("Near, far", (3.0, 2.0), "less than far"),
        ("Width, height", (64.4, 48.0), "whole number"),
        ("Width, height", (128.4, 96.0), "whole number"),
        ("w x y z", "1 0 0", "four numbers"),
        ("w x y z", "one 1 0 0 0", "four numbers"),
        ("w x y z", "0 0 0 0", "zeros"),
        ("Looks at", EYE, "same point"),
        ("Forward", (0.0, 0.0, 0.0), "no length"),
    ],
)
@with_a_fov
def test_what_no_camera_has_is_refused_in_words(desk: Desk, label: str, value: Any, why: str) -> None:
    desk.panels.set("Rotation", {"w x y z": WXYZ, "Forward": AXES}.get(label, RPY))
    now = desk.types(label, value)
    assert why in desk.panels.client.notices[0]
    assert not differences(FILE, now)
